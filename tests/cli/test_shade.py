"""`prtbake shade`: pictures, layers, cameras, turntables and error pictures."""

import json
import re
import shlex
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from formats.asset import write_asset
from formats.image import read_image, read_layers
from formats.mesh import build_mesh
from prt_bake.shading.error_picture import error_colours, relative_errors
from prt_bake.shading.picture import Picture
from tests.cli.command_line import Run
from tests.shading.test_surface_reflection import glossy
from tests.shapes import ball


@pytest.fixture(scope="module")
def polished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An asset of index 1.5 and roughness 0.3 that is brighter under light from +x."""
    path = tmp_path_factory.mktemp("polished") / "polished.h5"
    asset = glossy(ball(3))
    asset.coefficients[:, :, 3] = 0.1
    write_asset(asset, path)
    return path


@pytest.mark.parametrize("suffix", [".png", ".exr"])
def test_shade_makes_a_picture(prtbake: Run, tmp_path: Path, suffix: str) -> None:
    output = tmp_path / f"picture{suffix}"
    outcome = prtbake("shade", "asset.h5", "--light", "sky.exr", "-o", output, "--size", "40x30", "--rotate", 30)
    assert outcome.code == 0
    assert "clamped" in outcome.out
    image = read_image(output)
    assert image.shape == (30, 40, 3)
    assert np.isfinite(image).all()
    np.testing.assert_allclose(image[0, 0], 1.0, atol=1e-3)
    # The model of the command's folder was not trained, and its asset has two rings of view bins.
    stated = (
        r"(?s).*\.(png|exr): error at least \d+\.\d% \(network unknown, bake \d+\.\d%, views unknown, "
        r"vertices \d+\.\d%, noise 0\.0%\)\n.*"
    )
    assert re.fullmatch(stated, outcome.out)
    if suffix == ".exr":
        stored = read_layers(output)
        assert json.loads(stored.attributes["prtbake.picture_error"])["network"] is None
        layers = stored.layers
        assert layers["error"][15, 20].min() > 0.0
        assert (layers["error"][0, 0].max(), layers["coverage"][0, 0], layers["coverage"][15, 20]) == (0.0, 0.0, 1.0)


@pytest.mark.parametrize("suffix", [".png", ".exr", ".hdr"])
def test_a_picture_names_its_command(prtbake: Run, tmp_path: Path, suffix: str) -> None:
    """A day later nobody knows of which asset and under which light it is."""
    picture = tmp_path / f"jade à gauche{suffix}"
    words = ("asset.h5", "--light", "sun:0.25,0.5,1:2,1.5,1:3", "--light", "sky.exr", "--rotate", "40", "--size", "8x6")
    assert prtbake("shade", *words, "-o", picture).code == 0
    lines = [line for line in prtbake("info", picture).out.splitlines() if line.startswith("command")]
    assert [line.split(maxsplit=1)[1] for line in lines] == (
        [] if suffix == ".hdr" else [shlex.join(["prtbake", "shade", *words, "-o", str(picture)])]
    )


def test_an_object_that_clips_is_remarked_where_it_clips(prtbake: Run, polished: Path, tmp_path: Path) -> None:
    bright = ["shade", polished, "--light", "sun:1,1,1:50,50,50", "--size", "20x15", "-o"]
    assert "brighter than white and is clipped; --exposure -" in prtbake(*bright, tmp_path / "a.png").err
    assert "brighter than white" not in prtbake(*bright, tmp_path / "b.png", "--tone-map", "agx").err
    assert "brighter than white" not in prtbake(*bright, tmp_path / "c.exr").err


def test_shade_takes_several_lights(prtbake: Run, tmp_path: Path) -> None:
    """The picture under a sky, a sun and a lights file is the sum of those under each, up to clamping."""
    (tmp_path / "lights.toml").write_text("[[directional]]\ndirection = [0, 1, 0]\nirradiance = [1, 0.5, 0.2]\n")
    given = ["sky.exr", "sun:0,0,1:2,2,2", str(tmp_path / "lights.toml")]
    pictures = []
    for number, lights in enumerate([[one] for one in given] + [given]):
        output = tmp_path / f"{number}.exr"
        options = [option for light in lights for option in ("--light", light)]
        options += ["--size", "16x12", "--view", "three-quarter-back"]
        assert prtbake("shade", "asset.h5", *options, "-o", output).code == 0
        pictures.append(read_image(output))
    # Negative radiance is clamped, so that the sum of the parts can be larger than the whole.
    separate = sum(pictures[:3])
    assert (pictures[3] <= separate + 1e-4).all()
    assert np.isclose(pictures[3], separate, rtol=1e-4).mean() > 0.7
    assert all(picture[6, 8].min() > 0.05 for picture in pictures[:2])
    none = prtbake("shade", "asset.h5", "--light", "sun:0,0,0", "-o", tmp_path / "x.png")
    assert none.code == 1
    assert "sun:0,0,0: direction: expected" in none.err


def test_reflection_is_optional_and_its_absence_is_reported(prtbake: Run, tmp_path: Path, polished: Path) -> None:
    options = ["--light", "sky.exr", "--size", "24x24", "-o"]
    plain = prtbake("shade", polished, *options, tmp_path / "plain.exr")
    assert "light reflected at its surface (index 1.5) is not shown; --reflection adds it" in plain.err
    shiny = prtbake("shade", polished, *options, tmp_path / "shiny.exr", "--reflection", "--layers", "all")
    assert (shiny.code, "prtbake: " in shiny.err) == (0, False), shiny.err
    unreflected, layered = read_image(tmp_path / "plain.exr"), read_layers(tmp_path / "shiny.exr")
    np.testing.assert_allclose(layered.image - layered.layers["reflection"], unreflected, atol=1e-6)
    assert set(layered.layers) == {
        *("position", "normal", "vertex", "radiance", "subsurface", "reflection", "error", "coverage")
    }
    assert "light reflected at the surface" in layered.attributes["prtbake.shows"]
    compared = prtbake("compare", tmp_path / "plain.exr", tmp_path / "shiny.exr").err
    assert "plain.exr does not: the figures include it" in compared
    matched = prtbake("shade", "asset.h5", *options, tmp_path / "matched.exr", "--reflection")
    assert "its index of refraction is 1, so its surface reflects nothing" in matched.err


def test_reflections_of_a_flat_shaded_mesh_show_its_faces_and_say_so(prtbake: Run, tmp_path: Path) -> None:
    flat = glossy(ball(2))
    write_asset(replace(flat, mesh=replace(flat.mesh, flat_shaded=True)), tmp_path / "flat.h5")
    options = ["--light", "sun:0,0,-1", "--size", "24x24", "--reflection"]
    pictures = []
    for number, further in enumerate(([], ["--normals", "face"], ["--normals", "vertex"])):
        output = tmp_path / f"{number}.exr"
        outcome = prtbake("shade", tmp_path / "flat.h5", *options, *further, "-o", output)
        assert outcome.code == 0
        assert ("flat shaded, so that reflections show its faces; --normals vertex" in outcome.err) == (number == 0)
        pictures.append(read_image(output))
    np.testing.assert_array_equal(pictures[0], pictures[1])
    assert np.abs(pictures[0] - pictures[2]).max() > 0.01


def test_cameras_of_every_kind(prtbake: Run, tmp_path: Path, polished: Path) -> None:
    shown = {}
    for name, options in {
        "fitted": [],
        "parallel": ["--orthographic"],
        "wide": ["--extent", 8],
        "offset": ["--eye", "0,0,6", "--look-at", "1,0,0", "--fov", 50],
    }.items():
        output = tmp_path / f"{name}.exr"
        arguments = ["--light", "sun:0,0,1", "-o", output, "--size", "32x32", *options]
        assert prtbake("shade", polished, *arguments).code == 0
        shown[name] = read_layers(output).layers["coverage"]
    assert shown["parallel"].mean() == pytest.approx(np.pi / 4 / 1.08**2, rel=0.02)
    assert shown["wide"].mean() == pytest.approx(np.pi / 64, rel=0.05)
    assert np.flatnonzero(shown["offset"].any(axis=0)).mean() < 14
    for wrong in (["--fov", 180], ["--extent", 0], ["--look-at", "1,2"]):
        assert prtbake("shade", polished, "--light", "sun:0,0,1", "-o", tmp_path / "x.png", *wrong).code == 2


def test_the_camera_stands_in_front_by_default(prtbake: Run, tmp_path: Path, polished: Path) -> None:
    """A sun behind the default camera is reflected into it; one on the other side is not."""
    shown = {}
    for side in ("default", "three-quarter", "three-quarter-back", "front", "right"):
        output = tmp_path / f"{side}.exr"
        chosen = [] if side == "default" else ["--view", side]
        options = ["--light", "sun:0.43,0.24,0.87", "--reflection", "--size", "16x16", "--layers", "all"]
        assert prtbake("shade", polished, *options, *chosen, "-o", output).code == 0
        shown[side] = read_layers(output).layers["reflection"]
    np.testing.assert_array_equal(shown["default"], shown["three-quarter"])
    assert shown["default"].sum() > 2.0 * shown["three-quarter-back"].sum()
    middle = {side: shown[side].sum(axis=(0, 2)) @ np.linspace(-1.0, 1.0, 16) for side in ("front", "right")}
    # From the front the sun stands on the right, from the right on the left.
    assert middle["front"] > 0.0 > middle["right"]


def test_a_transparent_picture_has_an_alpha_channel(prtbake: Run, tmp_path: Path, polished: Path) -> None:
    options = ["--light", "sky.exr", "--size", "24x24", "--transparent", "-o"]
    assert prtbake("shade", polished, *options, tmp_path / "a.png").code == 0
    stored = np.asarray(Image.open(tmp_path / "a.png"))
    assert stored.shape == (24, 24, 4)
    assert (stored[0, 0] == 0).all()
    assert stored[12, 12, 3] == 255
    refused = prtbake("shade", polished, *options, tmp_path / "a.hdr")
    assert refused.code == 2
    assert ".hdr has no alpha channel; write .exr or .png" in refused.err


def test_agx_keeps_bright_light_from_clipping(prtbake: Run, tmp_path: Path, polished: Path) -> None:
    """Under a strong sun red and green clip, where AgX keeps their ratio; exposure comes before it."""
    lit = ["shade", polished, "--light", "sun:0.4,0.2,0.9:40,30,20", "--size", "24x24"]
    shown = {}
    for name, options in {
        "none": [],
        "agx": ["--tone-map", "agx"],
        "dark": ["--tone-map", "agx", "--exposure", -8],
    }.items():
        assert prtbake(*lit, *options, "-o", tmp_path / f"{name}.png").code == 0
        shown[name] = read_image(tmp_path / f"{name}.png")[8:16, 8:16]
    assert (shown["none"][..., :2] == 1.0).all()
    assert (shown["agx"][..., :2] < 0.99).all()
    assert (shown["agx"][..., 0] > 1.01 * shown["agx"][..., 1]).all()
    assert shown["dark"].max() < 0.5 * shown["agx"].min()
    turned = prtbake(*lit, "--tone-map", "agx", "--turntable", "eye", "--frames", 2, "-o", tmp_path / "turn_%d.png")
    assert turned.code == 0, turned.err
    assert prtbake(*lit, "--tone-map", "agx", "--transparent", "-o", tmp_path / "alpha.png").code == 0
    np.testing.assert_array_equal(read_image(tmp_path / "turn_0.png"), read_image(tmp_path / "agx.png"))
    np.testing.assert_allclose(read_image(tmp_path / "alpha.png")[8:16, 8:16], shown["agx"], atol=0.02)


def test_a_turntable_in_mp4_needs_ffmpeg_and_even_sizes(
    prtbake: Run, tmp_path: Path, polished: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both are refused before anything is rendered."""
    turn = ["shade", polished, "--light", "sun:0,0,1", "--turntable", "eye", "-o", tmp_path / "t.mp4"]
    monkeypatch.setattr(shutil, "which", lambda _name: None)
    refused = prtbake(*turn, "--size", "9000x9000")
    assert refused.code == 1
    assert "t.mp4: the program ffmpeg, which writes .mp4, was not found; install it, or write .webp" in refused.err
    monkeypatch.setattr(shutil, "which", lambda name: f"/usr/bin/{name}")
    refused = prtbake(*turn, "--size", "9000x9001")
    assert "t.mp4: expected an even width and height in an .mp4, found 9000x9001 pixels" in refused.err


def test_layers_need_exr_and_unknown_ones_are_refused(prtbake: Run, tmp_path: Path, polished: Path) -> None:
    options = ["--light", "sky.exr", "--size", "8x8", "-o"]
    outcome = prtbake("shade", polished, *options, tmp_path / "a.png", "--layers", "normal")
    assert outcome.code == 2
    assert ".png has no layers; write .exr" in outcome.err
    outcome = prtbake("shade", polished, *options, tmp_path / "a.exr", "--layers", "normal, depth")
    assert outcome.code == 1
    assert "layers: expected some of position, normal, vertex" in outcome.err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("turning", ["eye", "light"])
def test_turntables_start_at_the_still_picture(prtbake: Run, tmp_path: Path, polished: Path, turning) -> None:
    """The third of four frames is the picture with the light rotated by half a turn."""
    options = ["--light", "sun:1,0,0.5:3,3,3", "--size", "16x16", *(["--eye", "-2,1,-5"] if turning == "eye" else [])]
    turned = prtbake("shade", polished, *options, "-o", tmp_path / "t_%d.exr", "--turntable", turning, "--frames", 4)
    assert turned.code == 0, turned.err
    frames = [read_image(tmp_path / f"t_{number}.exr") for number in range(4)]
    assert prtbake("shade", polished, *options, "-o", tmp_path / "first.exr").code == 0
    np.testing.assert_array_equal(frames[0], read_image(tmp_path / "first.exr"))
    if turning == "light":
        assert prtbake("shade", polished, *options, "--rotate", 180, "-o", tmp_path / "half.exr").code == 0
        np.testing.assert_allclose(frames[2], read_image(tmp_path / "half.exr"), atol=1e-6)
    assert (
        prtbake(*("shade", polished, *options, "-o", tmp_path / "t.webp", "--turntable", turning, "--frames", 3)).code
        == 0
    )
    with Image.open(tmp_path / "t.webp") as animation:
        assert (animation.n_frames, animation.size) == (3, (16, 16))


def test_turntables_frame_a_long_object_in_every_view(prtbake: Run, tmp_path: Path) -> None:
    """The first view looks along the object and sees its narrow end."""
    long = glossy(build_mesh(ball(2).positions * [0.5, 0.5, 3.0], ball(2).faces))
    write_asset(long, tmp_path / "long.h5")
    options = ["--light", "sun:0,1,0:3,3,3", "--size", "24x24", "--turntable", "eye", "--frames", 4]
    assert prtbake("shade", tmp_path / "long.h5", *options, "-o", tmp_path / "t_%d.exr").code == 0
    for number in range(4):
        shown = read_image(tmp_path / f"t_{number}.exr").max(axis=2) > 0.0
        assert shown[12, 12]
        assert not np.concatenate([shown[[0, -1]].ravel(), shown[:, [0, -1]].ravel()]).any()


def test_a_roughness_image_whose_channels_differ_is_a_warning(prtbake: Run, tmp_path: Path) -> None:
    flat = glossy(ball(2))
    uv = 0.5 + 0.25 * flat.mesh.positions[:, :2]
    write_asset(replace(flat, mesh=replace(flat.mesh, uv=uv)), tmp_path / "unwrapped.h5")
    Image.fromarray(np.array([[[255, 51, 0], [255, 102, 0]]], np.uint8)).save(tmp_path / "packed.png")
    options = ["--light", "sky.exr", "--size", "8x8", "--reflection", "--roughness", tmp_path / "packed.png"]
    outcome = prtbake("shade", tmp_path / "unwrapped.h5", *options, "-o", tmp_path / "x.exr")
    assert outcome.code == 0
    assert "packed.png: its channels differ, and red is read" in outcome.err


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["-o", "x.png", "--roughness", "0.1"], "--roughness: applies to the reflection; add --reflection"),
        (["-o", "x.png", "--normals", "face"], "--normals: applies to the reflection; add --reflection"),
        (
            ["-o", "x.png", "--reflection", "--roughness", "1.5"],
            "--roughness: expected a GGX alpha from 0 to 1 or an image, found 1.5",
        ),
        (["-o", "x.webp"], ".webp is for turntables; add --turntable eye"),
        (["-o", "x_%03d.png"], "names numbered pictures; add --turntable eye"),
        (["-o", "x.png", "--frames", "3"], "apply to turntables; add --turntable eye"),
        (["-o", "x.png", "--seconds", "1"], "apply to turntables; add --turntable eye"),
        (["-o", "x.exr", "--turntable", "eye"], "a single .exr cannot store a turntable"),
        (["-o", "x.gif", "--turntable", "eye", "--transparent"], "cannot be combined with --transparent"),
        (["-o", "x.exr", "--tone-map", "agx"], "--tone-map: has no effect on .exr, which stores radiance; omit it"),
        (["-o", "x.exr", "--exposure", "2"], "--exposure: has no effect on .exr, which"),
        (["-o", "x_%03d.hdr", "--turntable", "eye", "--exposure", "1"], "--exposure: has no effect on .hdr, which"),
        (["-o", "x.png", "--orthographic", "--fov", "50"], "no field of view; omit --fov or --orthographic"),
        (["-o", "x.png", "--view", "front", "--eye", "0,0,5"], "--view: --eye places the camera; omit one of them"),
        (["-o", "x.png", "--extent", "3", "--fov", "50"], "no field of view; omit --fov or --extent"),
    ],
)
def test_ineffective_options_are_wrong_usage(prtbake: Run, polished: Path, options, sentence) -> None:
    outcome = prtbake("shade", polished, "--light", "sky.exr", *options)
    assert outcome.code == 2
    assert sentence in outcome.err


def test_each_suffix_of_an_output_is_named_once(prtbake: Run, polished: Path) -> None:
    outcome = prtbake("shade", polished, "--light", "sky.exr", "-o", "x.tif")
    assert outcome.code == 1
    known = ".png or .exr or .hdr or .webp or .gif or .mp4"
    assert outcome.err == f"prtbake: x.tif: expected a name that ends in {known}, found '.tif'\n"


def test_the_error_picture(prtbake: Run, tmp_path: Path, polished: Path) -> None:
    options = ["--light", "sky.exr", "--size", "40x30", "--reflection", "-o", tmp_path / "a.png"]
    outcome = prtbake("shade", polished, *options, "--error-picture", tmp_path / "error.png")
    assert outcome.code == 0, outcome.err
    shown = np.asarray(Image.open(tmp_path / "error.png"))
    assert shown.shape == (30, 40, 4)
    assert len(np.unique(shown.reshape(-1, 4), axis=0)) > 20
    scale = (
        r"error.png: standard error of the bake and the noise at each pixel, from 0 \(dark blue\) to \d+\.\d% of its"
    )
    assert re.search(scale, outcome.out)
    assert prtbake("shade", polished, *options, "--error-picture", tmp_path / "error.exr").code == 1


@pytest.mark.parametrize("size", [(1, 1), (40, 2)])
def test_colours_of_an_error_picture_run_up_to_its_largest_errors(size: tuple[int, int]) -> None:
    height, width = size
    ones = np.ones((height, width, 3), np.float32)
    error = 0.1 * ones * np.linspace(1.0, 0.0, width, dtype=np.float32)[:, None]
    error[-1] = 0.1
    coverage = ones[..., 0].copy()
    coverage[0, 0] = float(width == 1)
    colours, largest = error_colours(Picture(ones, coverage, 0.0, 1, 0.0, 0.0, error, 0.1, {"radiance": ones}))
    assert colours.shape == (height, width, 4)
    assert largest == pytest.approx(0.1)
    np.testing.assert_array_equal(colours[-1, 0], [253, 231, 36, 255])
    np.testing.assert_array_equal(colours[..., 3], 255 * coverage)
    assert (colours[coverage == 0.0] == 0).all()


def test_relative_errors_are_sigma_over_radiance_with_a_floor_for_dark_pixels() -> None:
    radiance = np.zeros((2, 2, 3))
    radiance[0] = [[2.0, 2.0, 2.0], [1e-6, 0.0, 0.0]]
    coverage = np.array([[1.0, 1.0], [0.0, 0.0]], np.float32)
    error = np.zeros((2, 2, 3), np.float32)
    error[0] = 0.1
    picture = Picture(radiance.astype(np.float32), coverage, 0.0, 1, 0.0, 0.0, error, 0.05)
    relative = relative_errors(picture, radiance)
    assert relative[0, 0] == pytest.approx(0.05)
    assert relative[0, 1] == pytest.approx(0.1 / 0.01, rel=0.01)
    assert np.isnan(relative[1]).all()
