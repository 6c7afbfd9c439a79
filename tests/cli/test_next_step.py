"""Commands end with the next one to type, which works with the user's own file names."""

import shlex
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from prt_bake.cli.shared.next_step import say_next_of_asset
from tests.cli.command_line import Run

SMALL = ("--rings", "1", "--sectors", "2", "--samples", "18")


def _next(err: str) -> list[str]:
    *_, last = err.splitlines()
    assert last.startswith("next: prtbake "), err
    return shlex.split(last)[2:]


def test_a_new_asset_is_shown(prtbake: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DISPLAY", "")
    line = _next(prtbake("bake", "model.pt", "sphere.ply", "-o", tmp_path / "my asset.h5", *SMALL).err)
    if all(map(find_spec, ("pyvista", "vtkmodules"))) and sys.platform == "linux":
        assert line == ["view", str(tmp_path / "my asset.h5"), "--screenshot", str(tmp_path / "my asset.png")]


def test_an_asset_is_shown_by_what_is_installed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "pyvista", None)
    say_next_of_asset(Path("a.h5"))
    line = _next(capsys.readouterr().err)
    assert line[:3] == ["shade", "a.h5", "--light"]
    assert Path(line[3]).is_file()
    assert line[4:] == ["-o", "a.png"]


def test_a_picture_that_exists_is_not_the_next_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "a.png").write_text("")
    say_next_of_asset(tmp_path / "a.h5")
    assert str(tmp_path / "a.png") not in _next(capsys.readouterr().err)


@pytest.mark.parametrize(
    ("line", "successor"),
    [
        ("check sphere.ply", "init sphere.ply --material jade --size 10cm"),
        ("check scene.toml", "train scene.toml -o scene.pt"),
        ("check model.pt", "bake model.pt MESH -o model.h5"),
        ("sample scene.toml --count 2 -o {}/s.h5", "train scene.toml --samples {}/s.h5 -o scene.pt"),
        ("render scene.toml sphere.ply --light sky.exr --size 4x4 --spp 2 -o {}/a.exr", "compare IMAGE {}/a.exr"),
    ],
)
def test_other_successors(prtbake: Run, tmp_path: Path, line: str, successor: str) -> None:
    outcome = prtbake(*line.format(tmp_path).split())
    assert outcome.code == 0
    assert _next(outcome.err) == successor.format(tmp_path).split()


def test_what_lies_beside_a_file_is_not_made_again(
    prtbake: Run, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("sphere.ply", "scene.toml"):
        (tmp_path / name).symlink_to(folder / name)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.pt").symlink_to(folder / "model.pt")
    assert _next(prtbake("check", "scene.toml").err)[:2] == ["bake", "scene.pt"]
    (tmp_path / "scene.h5").symlink_to(folder / "asset.h5")
    assert _next(prtbake("check", "scene.toml").err)[:2] == ["view", "scene.h5"]
