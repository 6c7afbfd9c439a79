"""`prtbake view --browser`: the page of one asset, served until Ctrl-C."""

import json
import signal
import subprocess
import sys
import urllib.request
import webbrowser
from collections.abc import Iterator
from pathlib import Path

import pytest

from prt_bake.export.server import PageServer
from tests import ROOT
from tests.cli.command_line import Run
from tests.export.conftest import small_page

SERVE = """
import sys
from pathlib import Path
from prt_bake.export import site
site.PAGE = Path(sys.argv[1])
from prt_bake.cli.main import main
code = main(sys.argv[2:])
assert not {"torch", "pyvista"} & sys.modules.keys()
sys.exit(code)
"""


@pytest.fixture
def page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    return small_page(tmp_path, monkeypatch)


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """The addresses that the browser is asked to open; Ctrl-C follows as soon as the server runs."""
    addresses: list[str] = []

    def interrupted(self: PageServer) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(webbrowser, "open", addresses.append)
    monkeypatch.setattr(PageServer, "serve_forever", interrupted)
    return addresses


def test_the_page_is_served_until_ctrl_c(page: Path, folder: Path) -> None:
    command = [sys.executable, "-W", "error", "-c", SERVE, page, "view", "asset.h5", "--browser", "--light", "sky.exr"]
    environment = {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}  # without a display
    with subprocess.Popen(
        command, cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as running:
        assert running.stdout is not None
        address = running.stdout.readline().strip()
        assert address.startswith("http://127.0.0.1:")
        with urllib.request.urlopen(f"{address}site.json") as answered:
            described = json.load(answered)
        with urllib.request.urlopen(f"{address}{described['objects'][0]['file']}") as answered:
            assert answered.read() == (folder / "asset.h5").read_bytes()
        with urllib.request.urlopen(f"{address}{described['lights'][0]['file']}") as answered:
            assert answered.read().startswith(b"#?RADIANCE")
        running.send_signal(signal.SIGINT)
        _, errors = running.communicate(timeout=60)
    assert running.returncode == 130, errors
    assert errors.splitlines()[-1] == "prtbake: the page is open for this machine alone; Ctrl-C ends it"


def test_the_browser_is_opened_where_there_is_a_display(
    page: Path, prtbake: Run, opened: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    outcome = prtbake("view", "asset.h5", "--browser")
    assert (outcome.code, opened) == (130, [])
    assert "Ctrl-C ends it" in outcome.err
    monkeypatch.setenv("WAYLAND_DISPLAY", "wayland-0")
    assert prtbake("view", "asset.h5", "--browser").out.splitlines() == opened


@pytest.mark.parametrize(
    ("options", "code", "message"),
    [
        (["--browser", "--screenshot", "shot.png"], 2, "--screenshot: has no effect on the page of --browser"),
        (["--browser", "--view", "left"], 2, "--view: has no effect"),
        (["--port", 8000], 2, "add --browser"),
        (["--browser", "--light", "none.exr"], 1, "none.exr"),
        (["--browser", "--light", "sphere.ply"], 1, "sphere.ply: expected a picture"),
    ],
)
def test_errors_are_one_sentence(
    page: Path, prtbake: Run, opened: list[str], options: list[object], code: int, message: str
) -> None:
    outcome = prtbake("view", "asset.h5", *options)
    assert (outcome.code, opened) == (code, [])
    assert message in outcome.err


def test_other_files_than_assets_are_refused(page: Path, prtbake: Run, opened: list[str]) -> None:
    assert "sphere.ply: expected an asset" in prtbake("view", "sphere.ply", "--browser").err
    assert opened == []
