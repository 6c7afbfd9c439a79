"""Skies with other primaries, with layers, and with the tiny negative values of lossy compression."""

from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from formats.errors import ImageError, InputWarning
from formats.image import gamut, read_image, write_image
from formats.image.gamut import Primaries, matrix_to_rec709
from prt_bake.inspection import sky as inspection
from prt_bake.lights import environment
from prt_bake.lights.harmonics import project_lighting
from prt_bake.lights.lighting import read_lighting
from prt_bake.lights.skies.sampling import sky_table
from tests.cli.command_line import Run

SKY = np.random.default_rng(5).gamma(0.5, 2, (16, 32, 3)).astype(np.float32)


def write(path: Path, image: np.ndarray = SKY, **header: object) -> Path:
    kinds = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    channels = {name: np.ascontiguousarray(image[..., i]) for i, name in enumerate("RGB")}
    OpenEXR.File({**kinds, **header}, channels).write(str(path))
    return path


def aces_to_rec709() -> np.ndarray:
    with pytest.warns(InputWarning):
        matrix = matrix_to_rec709("", Primaries("", gamut.ACES_AP1))
    assert matrix is not None
    return matrix


def test_the_light_is_converted_exactly(tmp_path: Path) -> None:
    """Harmonics are linear in the picture: converted pixels and converted coefficients agree."""
    path, expected = write(tmp_path / "a.exr", chromaticities=gamut.ACES_AP1), environment.project(SKY, 3)
    with pytest.warns(InputWarning, match="ACES AP1"):
        opened = environment.open_environment(path)
    np.testing.assert_allclose(environment.project(opened, 3), expected @ aces_to_rec709().T, atol=1e-6)
    with pytest.warns(InputWarning, match="ACES AP1"):
        lighting = read_lighting(path, degree=3)
    np.testing.assert_allclose(project_lighting(lighting, 3), expected @ aces_to_rec709().T, atol=1e-6)
    assert lighting.skies[0].image.min() < 0.0
    # Pixels are drawn by their energy, which is positive.
    assert sky_table(lighting.skies[0].image, np.eye(3)).weights.min() >= 0.0


def test_a_picture_for_python_has_no_negative_channel(tmp_path: Path) -> None:
    path = write(tmp_path / "a.exr", chromaticities=gamut.ACES_AP1)
    with pytest.warns(InputWarning, match="converted"), pytest.warns(InputWarning, match="are outside Rec.709"):
        picture = environment.read_environment(path)
    np.testing.assert_allclose(picture, np.maximum(SKY @ aces_to_rec709().T, 0.0), atol=1e-4)


def test_pixels_are_judged_and_mended_as_they_are_stored(tmp_path: Path) -> None:
    image = SKY.copy()
    image[3, 4] = -1.0, 1.0, 1.0
    image[5, 6] = np.inf, 0.0, 1.0
    path, said = write(tmp_path / "a.exr", image, chromaticities=gamut.ACES_AP1), list[str]()
    with pytest.warns(InputWarning), pytest.raises(ImageError, match="found 2 of 512 pixels"):
        environment.open_environment(path).read()
    with pytest.warns(InputWarning):
        mended = environment.open_environment(path, mend=True, say=said.append).read()
    matrix = aces_to_rec709()
    np.testing.assert_allclose(mended[3, 4], matrix @ [0.0, 1.0, 1.0], atol=1e-5)
    np.testing.assert_allclose(mended[5, 6], matrix @ [SKY.max(), 0.0, 1.0], rtol=1e-5)
    assert len(said) == 1


@pytest.mark.parametrize("scale", [1e-20, 1.0, 1e20])
def test_negative_values_that_are_tiny_beside_the_median_become_0(tmp_path: Path, scale: float) -> None:
    image, said = SKY.copy(), list[str]()
    image[0, 0] = 1e5  # a sun does not raise the median
    image[[1, 2, 2], [3, 4, 4], [0, 1, 2]] = -0.0009 * np.median(SKY)
    path = tmp_path / "a.exr"
    write_image(path, (scale * image.astype(np.float64)).astype(np.float32))
    read = environment.read_environment(path, say=said.append)
    np.testing.assert_array_equal(read, np.maximum((scale * image.astype(np.float64)).astype(np.float32), 0.0))
    assert said == [f"{path}: 3 values are negative, by less than 0.001 of the median, and are set to 0"]
    image[9, 9, 1] = -0.0011 * np.median(SKY)
    write_image(path, (scale * image.astype(np.float64)).astype(np.float32))
    with pytest.raises(ImageError, match=r"found 3 of 512 pixels with others \(4 negative\)"):
        environment.read_environment(path)


def test_a_dark_picture_has_no_tiny_negative_values(tmp_path: Path) -> None:
    image = np.zeros((4, 8, 3), np.float32)
    image[1, 1, 1] = -1e-30
    write_image(tmp_path / "a.exr", image)
    with pytest.raises(ImageError, match="1 negative"):
        environment.read_environment(tmp_path / "a.exr")


def test_info_names_the_layer_and_light_is_that_of_the_layer(prtbake: Run, tmp_path: Path) -> None:
    alone, path = write(tmp_path / "alone.exr"), tmp_path / "a.exr"
    channels = {f"V.Combined.{name}": np.ascontiguousarray(SKY[..., i]) for i, name in enumerate("RGB")}
    channels |= {f"V.AO.{name}": np.full((16, 32), 0.5, np.float32) for name in "RGB"}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, channels).write(str(path))
    light, info, check = (prtbake(*words) for words in (("light", path), ("info", path, "--all"), ("check", path)))
    assert [outcome.code for outcome in (light, info, check)] == [0, 0, 0]
    assert light.out == prtbake("light", alone).out
    warning = f"prtbake: warning: {path}: the colours are those of layer V.Combined; the file also has layer V.AO\n"
    assert [outcome.err for outcome in (light, info, check)] == [warning] * 3
    lines = [line.split(maxsplit=2) for line in info.out.splitlines()]
    assert ["colours", "of", "layer V.Combined"] in lines
    assert ["other", "layers", "['layer V.AO']"] in lines


def test_the_description_of_other_primaries_is_in_rec709(tmp_path: Path) -> None:
    path = write(tmp_path / "a.exr", chromaticities=gamut.ACES_AP1)
    with pytest.warns(InputWarning):
        described = inspection.describe(path)
    converted = SKY @ aces_to_rec709().T
    np.testing.assert_allclose(described["mean radiance"], converted.mean(axis=(0, 1)), rtol=1e-5)
    assert described["largest radiance"] == pytest.approx(converted.max(), rel=1e-5)
    assert described["values negative"] == 0


@pytest.mark.parametrize("suffix", [".jpg", ".jpeg"])
def test_jpegs_are_described_and_checked(prtbake: Run, tmp_path: Path, suffix: str) -> None:
    from PIL import Image

    Image.fromarray(np.full((8, 16, 3), 200, np.uint8)).save(tmp_path / f"a{suffix}")
    assert prtbake("check", tmp_path / f"a{suffix}").out.endswith("sound\n")
    assert "16 × 8 pixels" in prtbake("info", tmp_path / f"a{suffix}").out


def test_a_sky_with_colours_outside_rec709_lights_pictures(prtbake: Run, tmp_path: Path) -> None:
    sky = write(tmp_path / "a.exr", chromaticities=gamut.ACES_AP1)
    shade = ("shade", "asset.h5", "--size", "16x12", "--light", sky, "-o", tmp_path / "b.hdr")
    render = (
        "render",
        "scene.toml",
        "sphere.ply",
        "--size",
        "8x6",
        "--spp",
        4,
        "--light",
        sky,
        "-o",
        tmp_path / "c.exr",
    )
    for command in (shade, render):
        outcome = prtbake(*command)
        assert outcome.code == 0, outcome.err
        assert "converted to Rec.709" in outcome.err
        assert (".hdr stores them as 0" in outcome.err) == (command is shade)
        assert np.isfinite(read_image(command[-1])).all()
