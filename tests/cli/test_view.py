"""`prtbake view` without a display."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from formats.image import read_image, write_image
from formats.image.png import to_srgb
from prt_bake.preview.window import Window
from tests.cli.command_line import Run

COMMAND = ["view", "asset.h5", "--light", "sky.exr"]


@pytest.mark.parametrize(
    "options",
    [
        [],
        ["--rotate", 60, "--exposure", -1, "--eye", "2,3,1"],
        ["--up", "y", "--view", "left"],
        ["--suns", "plain"],
        ["--suns", "window"],
        ["--tone-map", "agx", "--exposure", 2],
        ["--light", "sun:0.3,0.2,1:4,1,1"],
    ],
)
@pytest.mark.filterwarnings("ignore:.*exposure of -1 EV")
def test_a_screenshot_equals_the_picture_of_shade(prtbake: Run, tmp_path: Path, options: list[object]) -> None:
    sky = np.random.default_rng(1).random((64, 128, 3)).astype(np.float32)
    sky[15, 80] = 2000.0  # a sun
    write_image(tmp_path / "sky.hdr", sky)
    light = ["--light", tmp_path / "sky.hdr", "--size", "64x48", *options]
    shot, shaded = tmp_path / "shot.png", tmp_path / "shade.png"
    outcome = prtbake("view", "asset.h5", *light, "--screenshot", shot)
    assert (outcome.code, outcome.err) == (0, "")
    assert outcome.out.startswith("asset.h5: error of the coefficients ")
    assert "64x48 pixels" in outcome.out
    assert prtbake("shade", "asset.h5", *light, "-o", shaded).code == 0
    off = 255.0 * np.abs(to_srgb(read_image(shot)) - to_srgb(read_image(shaded))).max(axis=2)
    assert np.median(off) <= 1.0
    assert (off > 3.0).mean() < 0.15  # edges of a ball of 80 faces


def test_a_reflection_that_cannot_be_shown_is_said(prtbake: Run, tmp_path: Path) -> None:
    shot = ["--reflection", "--size", "32x24", "--screenshot", tmp_path / "shot.png"]
    outcome = prtbake("view", "asset.h5", "--light", "sun:1,2,3", *shot)
    assert outcome.code == 0
    assert outcome.err.startswith("prtbake: asset.h5: no reflection: ")


def test_a_sphere_light_is_shown_as_by_shade(prtbake: Run, tmp_path: Path) -> None:
    light = ["asset.h5", "--light", "sphere:3,4,2:0.5:40,30,20", "--size", "64x48"]
    shot, shaded = tmp_path / "shot.png", tmp_path / "shade.png"
    outcome = prtbake("view", *light, "--screenshot", shot)
    assert (outcome.code, outcome.err.count("is taken as distant")) == (0, 1)
    assert prtbake("shade", *light, "-o", shaded).code == 0
    seen, expected = (to_srgb(read_image(path)) for path in (shot, shaded))
    assert np.median(255.0 * np.abs(seen - expected)[20:28, 28:36]) <= 1.0
    assert expected[20:28, 28:36].max() > 0.1


def test_the_size_is_that_of_the_reference(prtbake: Run, tmp_path: Path) -> None:
    write_image(tmp_path / "reference.exr", np.ones((30, 50, 3), np.float32))
    compare = ["--compare", tmp_path / "reference.exr", "--screenshot", tmp_path / "shot.png"]
    assert prtbake(*COMMAND, *compare).code == 0
    assert read_image(tmp_path / "shot.png").shape == (30, 50, 3)
    assert prtbake(*COMMAND, *compare, "--size", "20x10").code == 0
    assert read_image(tmp_path / "shot.png").shape == (10, 20, 3)


def test_the_default_light_is_the_shipped_sky(prtbake: Run, tmp_path: Path) -> None:
    assert prtbake("view", "asset.h5", "--size", "32x24", "--screenshot", tmp_path / "shot.png").code == 0
    assert read_image(tmp_path / "shot.png")[0].std() > 0.0


@pytest.mark.parametrize("display", [None, "", ":4711"])
def test_a_missing_display_is_reported(prtbake: Run, monkeypatch: pytest.MonkeyPatch, display: str | None) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    if display is not None:
        monkeypatch.setenv("DISPLAY", display)
    outcome = prtbake(*COMMAND)
    assert (outcome.code, len(outcome.err.splitlines())) == (1, 1)
    assert "no display" in outcome.err
    assert "--screenshot" in outcome.err


WITHOUT = """
import sys
sys.modules["pyvista"] = None
from prt_bake.cli.main import main
code = main(sys.argv[1:])
assert "torch" not in sys.modules
sys.exit(code)
"""


def test_without_pyvista_the_message_names_what_to_install(folder: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-c", WITHOUT, *COMMAND, "--screenshot", str(tmp_path / "shot.png")]
    ran = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert (ran.returncode, len(ran.stderr.splitlines())) == (1, 1)
    assert "pip install pyvista" in ran.stderr


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--eye", "0,0.1,0"], "inside the object"),
        (["--light", "none.exr"], "none.exr"),
        (["--light", "sphere.ply"], "sphere.ply"),
        (["--compare", "scene.toml"], "scene.toml"),
    ],
)
def test_errors_are_one_sentence(prtbake: Run, tmp_path: Path, options: list[str], message: str) -> None:
    outcome = prtbake("view", "asset.h5", *options, "--screenshot", tmp_path / "shot.png")
    assert (outcome.code, len(outcome.err.splitlines())) == (1, 1)
    assert message in outcome.err
    assert not (tmp_path / "shot.png").exists()


def test_a_sky_is_repaired_on_request(prtbake: Run, tmp_path: Path) -> None:
    sky = np.ones((8, 16, 3), np.float32)
    sky[2, 3, 1] = np.nan
    write_image(tmp_path / "nan.exr", sky)
    command = ["view", "asset.h5", "--light", tmp_path / "nan.exr", "--screenshot", tmp_path / "shot.png"]
    assert "nan.exr" in prtbake(*command).err
    mended = prtbake(*command, "--mend")
    assert mended.code == 0
    assert "repaired 1 values" in mended.err


def test_a_screenshot_of_another_kind_is_refused_at_once(prtbake: Run) -> None:
    assert "ends in .png" in prtbake(*COMMAND, "--screenshot", "shot.jpg").err


def test_the_window_is_shown(prtbake: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """The display is faked: the window is in memory, and its event loop ends at once."""
    from prt_bake.preview import window

    seen = []
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(window, "on_display", lambda _: True)
    monkeypatch.setattr(Window, "run", lambda self: seen.append(self))
    in_memory = window.open_plotter
    monkeypatch.setattr(window, "open_plotter", lambda width, height, *_: in_memory(width, height, True))
    assert prtbake(*COMMAND, "--light", "sky.hdr", "--size", "64x48").code == 0
    assert [source.name for source in seen[0].view.preview.lights] == ["sky.exr", "sky.hdr", "sky.exr + sky.hdr"]
