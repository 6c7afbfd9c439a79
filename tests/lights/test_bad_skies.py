"""Unusable and doubtful skies on the command line: one clear sentence each, and no silent black picture."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from formats.image import read_image, write_image
from tests.cli.command_line import Run

DRAW = np.random.default_rng(2)
SHADE = ("shade", "asset.h5", "--size", "16x12")


def cross(tall: bool = False, empty: float = 0.0) -> np.ndarray:
    """Six faces of 8 pixels, unfolded, on a background of `empty`."""
    image = np.full((24, 32, 3), empty, np.float32)
    for down, across in ((0, 1), (1, 0), (1, 1), (1, 2), (1, 3), (2, 1)):
        image[8 * down : 8 * down + 8, 8 * across : 8 * across + 8] = DRAW.random((8, 8, 3))
    return image.transpose(1, 0, 2) if tall else image


@pytest.mark.parametrize("shape", [(1, 1), (1, 2), (2, 4)])
@pytest.mark.parametrize("suffix", [".exr", ".hdr", ".png"])
def test_the_smallest_skies_work(prtbake: Run, tmp_path: Path, shape: tuple[int, int], suffix: str) -> None:
    path, output = tmp_path / f"sky{suffix}", tmp_path / "a.exr"
    write_image(path, np.full((*shape, 3), 0.25, np.float32))
    outcome = prtbake(*SHADE, "--light", path, "-o", output)
    assert (outcome.code, "prtbake: " in outcome.err) == (0, False), outcome.err
    np.testing.assert_allclose(read_image(output)[0, 0], 0.25, rtol=0.01)
    coefficients = prtbake("light", path)
    assert (coefficients.code, coefficients.err) == (0, "")
    assert abs(float(coefficients.out.splitlines()[1].split()[2]) - 0.25 * np.sqrt(4 * np.pi)) < 0.01


@pytest.mark.parametrize("light", ["moon:0,1,0", "sun;0,1,0.5", "sky.tif", "sky"])
def test_an_invalid_light_is_refused_with_the_accepted_forms(prtbake: Run, tmp_path: Path, light: str) -> None:
    for command in (
        (*SHADE, "-o", tmp_path / "a.png"),
        ("view", "asset.h5", "--screenshot", tmp_path / "a.png"),
        ("render", "scene.toml", "sphere.ply", "-o", tmp_path / "a.png"),
    ):
        outcome = prtbake(*command, "--light", light)
        assert outcome.code == 1
        assert f"{light}: is not a light; expected a lat-long sky (.exr, .hdr, .png or .jpg)" in outcome.err
        assert "sun:x,y,z[:r,g,b][:degrees] or sphere:x,y,z:radius[:r,g,b]" in outcome.err


def test_a_sky_with_nan_is_refused_with_the_option_that_repairs_it(prtbake: Run, tmp_path: Path) -> None:
    sky = np.ones((8, 16, 3), np.float32)
    sky[2, 3, 1] = np.nan
    path, output = tmp_path / "nan.exr", tmp_path / "a.png"
    write_image(path, sky)
    for command in (
        (*SHADE, "-o", output, "--light", path),
        ("view", "asset.h5", "--screenshot", output, "--light", path),
        ("render", "scene.toml", "sphere.ply", "-o", output, "--light", path),
        ("light", path),
    ):
        outcome = prtbake(*command)
        assert outcome.code == 1
        assert "repair the picture, or have it repaired as it is read (--mend; mend=True in Python)" in outcome.err
    checked = prtbake("check", path).out
    assert "repair the picture, or give --mend to `prtbake shade`, `view`, `render` or `light`" in checked
    # `bake` has no such option.
    bake = prtbake("bake", "model.pt", "sphere.ply", "-o", tmp_path / "a.h5", "--for-light", path)
    assert bake.code == 1
    assert "--mend" not in bake.err


@pytest.mark.parametrize("shape", [(48, 64), (64, 64), (9, 1), (30, 300), (48, 49)])
def test_another_shape_is_reported_and_used(prtbake: Run, tmp_path: Path, shape: tuple[int, int]) -> None:
    """A photograph of 4:3 is not a cross, since its corners are not empty."""
    path = tmp_path / "sky.exr"
    write_image(path, DRAW.random((*shape, 3)))
    for command in (("light", path), (*SHADE, "--light", path, "-o", tmp_path / "a.exr")):
        outcome = prtbake(*command)
        assert outcome.code == 0
        assert outcome.err.count("prtbake: ") == 1, outcome.err
        assert f"sky.exr: is {shape[1]}x{shape[0]} pixels, but a lat-long picture is twice as wide" in outcome.err


def test_a_shape_off_by_a_pixel_is_not_reported(prtbake: Run, tmp_path: Path) -> None:
    write_image(tmp_path / "sky.exr", DRAW.random((200, 401, 3)))
    assert prtbake("light", tmp_path / "sky.exr").err == ""


@pytest.mark.parametrize(
    "image",
    [
        cross(),
        cross(tall=True),
        cross(empty=1.0),
        cross(tall=True)[::-1],
        DRAW.random((48, 8, 3)),
        DRAW.random((8, 48, 3)),
    ],
)
def test_cube_maps_are_refused_with_advice(prtbake: Run, tmp_path: Path, image: np.ndarray) -> None:
    path = tmp_path / "sky.exr"
    write_image(path, image)
    render = ("render", "scene.toml", "sphere.ply", "--size", "8x8")
    for command in (("light", path), *((*c, "--light", path, "-o", tmp_path / "a.png") for c in (SHADE, render))):
        outcome = prtbake(*command)
        assert outcome.code == 1
        assert "is a cube map" in outcome.err
        assert "convert it" in outcome.err
        assert outcome.err.count("\n") == 1
    assert not (tmp_path / "a.png").exists()


def test_a_file_whose_header_says_cube_map_is_refused(prtbake: Run, tmp_path: Path) -> None:
    pixels = np.ones((8, 16), np.float32)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    for envmap, code in ((OpenEXR.ENVMAP_CUBE, 1), (OpenEXR.ENVMAP_LATLONG, 0)):
        OpenEXR.File({**header, "envmap": envmap}, dict.fromkeys("RGB", pixels)).write(str(tmp_path / "sky.exr"))
        for command in ("light", "check"):
            outcome = prtbake(command, tmp_path / "sky.exr")
            assert (outcome.code, "is a cube map" in outcome.out + outcome.err) == (code, code == 1)


@pytest.mark.parametrize("light", ["sky.exr", "lights.toml", "sun:0,1,0:0,0,0", "sphere:0,9,0:1:0,0,0"])
def test_a_black_light_is_reported(prtbake: Run, tmp_path: Path, light: str) -> None:
    write_image(tmp_path / "sky.exr", np.zeros((8, 16, 3)))
    write_image(tmp_path / "lit.exr", np.ones((8, 16, 3)))
    (tmp_path / "lights.toml").write_text('[[sky]]\nfile = "lit.exr"\ntint = [0, 0, 0]\n')
    given = light if ":" in light else tmp_path / light
    outcome = prtbake(*SHADE, "--light", given, "-o", tmp_path / "a.png")
    assert outcome.code == 0
    assert "black: it gives no light" in outcome.err
    if light == "sky.exr":
        assert "black: it gives no light" in prtbake("light", given).err


def spoil_nan(image: np.ndarray) -> None:
    image[5, 6, 1] = np.nan


def spoil_infinite(image: np.ndarray) -> None:
    image[5, 6] = np.inf


def spoil_negative(image: np.ndarray) -> None:
    image[5, 6, 2] = -0.25


@pytest.mark.parametrize("spoil", [spoil_nan, spoil_infinite, spoil_negative])
def test_bad_pixels_are_refused_or_repaired(prtbake: Run, tmp_path: Path, spoil: Callable[[np.ndarray], None]) -> None:
    image, path, output = DRAW.random((16, 32, 3)), tmp_path / "sky.exr", tmp_path / "a.exr"
    spoil(image)
    write_image(path, image)
    for command in (("light", path), (*SHADE, "--light", path, "-o", output)):
        refused = prtbake(*command)
        assert refused.code == 1
        assert "found 1 of 512 pixels" in refused.err
        assert "row 5, column 6" in refused.err
        repaired = prtbake(*command, "--mend")
        assert repaired.code == 0
        assert "sky.exr: repaired" in repaired.err
    assert np.isfinite(read_image(output)).all()


def test_alpha_is_ignored_and_luminance_is_grey(prtbake: Run, tmp_path: Path) -> None:
    """In EXR and in PNG."""
    grey = DRAW.random((8, 16)).astype(np.float32)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {"Y": grey, "A": np.zeros_like(grey)}).write(str(tmp_path / "y.exr"))
    OpenEXR.File(header, dict.fromkeys("RGBA", grey)).write(str(tmp_path / "rgba.exr"))
    outcomes = [prtbake("light", tmp_path / name) for name in ("y.exr", "rgba.exr")]
    assert [outcome.err for outcome in outcomes] == ["", ""]
    assert outcomes[0].out == outcomes[1].out
    codes = (255 * grey).astype(np.uint8)
    Image.fromarray(codes).convert("LA").save(tmp_path / "la.png")
    Image.fromarray(codes).save(tmp_path / "l.png")
    assert prtbake("light", tmp_path / "la.png").out == prtbake("light", tmp_path / "l.png").out
    OpenEXR.File(header, {"A": grey}).write(str(tmp_path / "a.exr"))
    refused = prtbake("light", tmp_path / "a.exr")
    assert refused.code == 1
    assert "has no colour" in refused.err


def test_a_truncated_sky_is_refused_in_one_sentence(prtbake: Run, tmp_path: Path) -> None:
    write_image(tmp_path / "whole.exr", DRAW.random((200, 400, 3)))
    (tmp_path / "cut.exr").write_bytes((tmp_path / "whole.exr").read_bytes()[:600_000])
    for command in (("light",), (*SHADE, "-o", tmp_path / "a.png", "--light")):
        outcome = prtbake(*command, tmp_path / "cut.exr")
        assert outcome.code == 1
        assert "truncated or damaged in row" in outcome.err
        assert outcome.err.count("\n") == 1


def test_a_sphere_light_works_in_shade_and_render(prtbake: Run, tmp_path: Path) -> None:
    lamp = "sphere:0,0,9:1:50,50,50"
    shown = prtbake(*SHADE, "--light", lamp, "-o", tmp_path / "a.exr")
    traced = prtbake(
        *("render", "scene.toml", "sphere.ply", "--size", "16x12", "--spp", 16),
        "--light",
        lamp,
        "-o",
        tmp_path / "b.exr",
    )
    for outcome in (shown, traced):
        assert outcome.code == 0
        assert f"light {lamp}: is taken as distant" in outcome.err
    assert read_image(tmp_path / "b.exr").max() > 0.0
    refused = prtbake(*SHADE, "--light", "sphere:0,0,1:1", "-o", tmp_path / "c.exr")
    assert refused.code == 1
    assert "reaches into the ball" in refused.err
