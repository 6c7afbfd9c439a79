"""Commands at the limits of numbers and names: a true result, or one sentence."""

import os
from pathlib import Path

import numpy as np
import pytest

from formats.image import write_image
from tests.cli.command_line import Run


@pytest.mark.parametrize("command", [["shade", "asset.h5", "--samples", "1"], ["render", "scene.toml", "sphere.ply"]])
def test_radiance_beyond_float32_is_refused(prtbake: Run, tmp_path: Path, command: list[str]) -> None:
    output, lights = tmp_path / "picture.exr", tmp_path / "lights.toml"
    write_image(tmp_path / "sky.exr", np.full((16, 32, 3), 3e38))
    lights.write_text('[[sky]]\nfile = "sky.exr"\n' * 8)
    outcome = prtbake(*command, "--light", lights, "--size", "8x8", "-o", output)
    assert (outcome.code, outcome.err.count("\n"), output.exists()) == (1, 1, False)
    assert "picture: expected radiance within ±3.403e+38, which float32 holds, found" in outcome.err


@pytest.mark.parametrize("eye", ["1e300,0,0", "0,2e30,0"])
@pytest.mark.parametrize("command", [["shade", "asset.h5"], ["render", "scene.toml", "sphere.ply"]])
def test_an_eye_beyond_all_scales_is_refused(prtbake: Run, tmp_path: Path, command: list[str], eye: str) -> None:
    outcome = prtbake(*command, "--light", "sky.exr", "--size", "4x4", "--eye", eye, "-o", tmp_path / "picture.exr")
    assert (outcome.code, outcome.err.count("\n")) == (1, 1)
    assert "camera: expected three numbers within ±1e+30 for eye" in outcome.err


def test_a_picture_without_the_object_says_so(prtbake: Run, tmp_path: Path) -> None:
    options = ["--light", "sky.exr", "--size", "4x4", "--spp", "2", "--eye", "1e9,0,0", "-o", tmp_path / "picture.exr"]
    outcome = prtbake("render", "scene.toml", "sphere.ply", *options)
    assert outcome.code == 0
    assert "the camera sees nothing of the object" in outcome.err


@pytest.mark.parametrize("suffix", [".exr", ".png", ".h5"])
def test_names_that_are_not_utf_8_are_refused(prtbake: Run, suffix: str) -> None:
    name = os.fsdecode(b"\xff") + suffix
    command = ["compress", "asset.h5", "-o"] if suffix == ".h5" else ["shade", "asset.h5", "--light", "sky.exr", "-o"]
    outcome = prtbake(*command, name)
    assert (outcome.code, outcome.err.count("\n")) == (1, 1)
    assert "expected names in UTF-8" in outcome.err
