"""Warnings about input: one line each on standard error, once per command."""

import pytest
import typer

from formats.errors import warn
from prt_bake.cli import main as command_line


def test_a_warning_is_printed_once_as_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    app = typer.Typer()

    @app.command()
    def read() -> None:
        for _ in range(3):
            warn("sky.exr: two layers;\n  'beauty' was taken")
        warn("mesh.obj: normals were recomputed")

    monkeypatch.setattr(command_line, "_parser", lambda: app)
    assert command_line.main([]) == 0
    assert capsys.readouterr().err.splitlines() == [
        "prtbake: warning: sky.exr: two layers; 'beauty' was taken",
        "prtbake: warning: mesh.obj: normals were recomputed",
    ]
