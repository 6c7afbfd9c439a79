"""Commands end with the next one to type, which works with the user's own file names."""

import shlex
import shutil
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from prt_bake import export_gltf
from prt_bake.cli.shared.next_step import say_next_of_asset, say_next_of_file
from tests.cli.command_line import Run
from tests.shading.test_picture import make_asset
from tests.shapes import ball

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


def test_a_scene_that_exists_is_not_the_next_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    ball(1).to_trimesh().export("a.obj")
    say_next_of_file("mesh", Path("a.obj"))
    assert "-o" not in _next(capsys.readouterr().err)
    Path("a.toml").write_text("")
    say_next_of_file("mesh", Path("a.obj"))
    assert _next(capsys.readouterr().err)[-2:] == ["-o", "a_2.toml"]


def test_an_exported_asset_becomes_a_page(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    export_gltf(make_asset(ball(1)), tmp_path / "a.glb")
    say_next_of_file("mesh", tmp_path / "a.glb")
    assert _next(capsys.readouterr().err) == ["export", str(tmp_path / "a.glb"), "-o", str(tmp_path / "a")]


@pytest.mark.parametrize("installed", [True, False])
def test_the_lights_and_options_of_the_user_are_kept(
    installed: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    if not installed:
        monkeypatch.setitem(sys.modules, "pyvista", None)
    say_next_of_asset(Path("a.h5"), "--reflection", lights=["my sky.hdr", "sun:0,1,0"])
    line = " ".join(_next(capsys.readouterr().err))
    assert "a.h5 --light my sky.hdr --light sun:0,1,0 --reflection" in line


def test_a_bake_for_one_eye_and_light_is_shown_from_there(prtbake: Run, tmp_path: Path) -> None:
    only = ("--for-light", "sky.exr", "--for-eye", "0,1,4.5")
    line = _next(prtbake("bake", "model.pt", "sphere.ply", "-o", tmp_path / "a.h5", *SMALL, *only).err)
    assert " ".join(line).startswith(f"view {tmp_path / 'a.h5'} --light sky.exr --eye 0.0,1.0,4.5")
    shown = prtbake(*line)
    assert (shown.code, shown.err) == (0, "")
    other = prtbake(*line[:2], "--light", "sky.hdr", "--eye", "0,1,5", "--screenshot", tmp_path / "b.png")
    assert "alone: the picture shows that light, not sky.hdr" in other.err
    assert "from other positions its colours are wrong" in other.err


def test_a_picture_is_turned_and_a_turntable_opened(prtbake: Run, tmp_path: Path) -> None:
    asset = tmp_path / "a.h5"
    prtbake("bake", "model.pt", "sphere.ply", "-o", asset, *SMALL)
    kept = ("--light", "sun:0,1,0", "--view", "left", "--up", "z", "--look-at", "0.1,0.0,0.0", "--fov", "25")
    kept += ("--rotate", "40", "--exposure", "-1")
    own = (*kept, "--size", "8x8")
    line = _next(prtbake("shade", asset, *own, "-o", tmp_path / "a.png").err)
    assert line[-2:] == ["-o", str(tmp_path / "a.webp")]
    turned = prtbake(*line, "--frames", "2")
    assert turned.code == 0, turned.err
    assert (tmp_path / "a.webp").is_file()
    assert " ".join(_next(turned.err)).startswith(f"view {asset} {' '.join(kept)}")


def test_files_that_exist_are_not_written_by_the_next_command(prtbake: Run, folder: Path, tmp_path: Path) -> None:
    mesh = tmp_path / "sphere.ply"
    shutil.copy(folder / "sphere.ply", mesh)
    made = tmp_path / "sphere.toml"
    assert prtbake("init", mesh, "--material", "jade", "-o", made).err.endswith(
        f"make {made} -o {tmp_path / 'sphere'}\n"
    )
    (tmp_path / "sphere").mkdir()
    again = prtbake("init", mesh, "--material", "jade", "-o", made, "--force")
    assert again.err.endswith(f"make {made} -o {tmp_path / 'sphere_2'}\n")


@pytest.mark.parametrize(
    ("line", "successor"),
    [
        ("check sphere.ply", "init sphere.ply --material jade --size 10cm"),
        ("check scene.toml", "train scene.toml -o scene.pt"),
        ("check model.pt", "bake model.pt MESH -o model.h5"),
        ("sample scene.toml --count 2 -o {}/s.h5", "train scene.toml --samples {}/s.h5 -o {}/scene.pt"),
    ],
)
def test_other_successors(prtbake: Run, tmp_path: Path, line: str, successor: str) -> None:
    outcome = prtbake(*line.format(tmp_path).split())
    assert outcome.code == 0
    assert _next(outcome.err) == successor.format(tmp_path, tmp_path).split()


def test_what_lies_beside_a_file_is_not_made_again(
    prtbake: Run, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("sphere.ply", "scene.toml"):
        (tmp_path / name).symlink_to(folder / name)
    assert _next(prtbake("check", tmp_path / "scene.toml").err)[-1] == str(tmp_path / "scene.pt")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.pt").symlink_to(folder / "model.pt")
    assert _next(prtbake("check", "scene.toml").err)[:2] == ["bake", "scene.pt"]
    (tmp_path / "scene.h5").symlink_to(folder / "asset.h5")
    assert _next(prtbake("check", "scene.toml").err)[:2] == ["view", "scene.h5"]
