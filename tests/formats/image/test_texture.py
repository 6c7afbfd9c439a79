"""Textures: data never pass through a curve, colours do, whatever the suffix."""

from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from formats.errors import ImageError, InputWarning, SceneError
from formats.image import gamut
from formats.image.png import to_linear
from formats.image.texture import read_reflectance_texture, read_roughness_texture

SCENE = Path("scene.toml")
HEADER = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".jpeg"])
@pytest.mark.parametrize("mode", ["L", "RGB"])
def test_roughness_is_the_stored_value_and_reflectance_is_not(tmp_path: Path, suffix: str, mode: str) -> None:
    Image.fromarray(np.full((16, 16), 128, np.uint8)).convert(mode).save(tmp_path / f"a{suffix}")
    roughness = read_roughness_texture(tmp_path / SCENE, "roughness", f"a{suffix}")
    np.testing.assert_allclose(roughness, 128 / 255, rtol=1e-15)
    reflectance = read_reflectance_texture(tmp_path / SCENE, "reflectance", f"a{suffix}")
    np.testing.assert_allclose(reflectance, to_linear(np.array(128 / 255)), rtol=1e-6)


def test_alphas_that_no_rough_boundary_has_are_raised(tmp_path: Path) -> None:
    stored = np.array([[0.0, 0.005], [0.01, 1.0]], np.float32)
    OpenEXR.File(dict(HEADER), {"Y": stored}).write(str(tmp_path / "a.exr"))
    roughness = read_roughness_texture(tmp_path / SCENE, "roughness", "a.exr")
    np.testing.assert_allclose(roughness, [[0.01, 0.01], [0.01, 1.0]], rtol=1e-6)


def test_statements_about_colour_do_not_concern_roughness(tmp_path: Path) -> None:
    stored = np.full((4, 4), 0.5, np.float32)
    channels = {"R": stored, "G": np.zeros_like(stored), "B": np.zeros_like(stored)}
    OpenEXR.File({**HEADER, "chromaticities": gamut.ACES_AP0}, channels).write(str(tmp_path / "a.exr"))
    with pytest.warns(InputWarning, match="channels differ"):
        np.testing.assert_array_equal(read_roughness_texture(tmp_path / SCENE, "roughness", "a.exr"), stored)


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".exr"])
def test_channels_that_differ_are_reported(tmp_path: Path, suffix: str) -> None:
    packed = np.empty((16, 16, 3), np.uint8)
    packed[:] = 255, 128, 0
    path = tmp_path / f"a{suffix}"
    if suffix == ".exr":
        channels = {name: np.float32(packed[..., i] / 255) for i, name in enumerate("RGB")}
        OpenEXR.File(dict(HEADER), channels).write(str(path))
    else:
        Image.fromarray(packed).save(path, quality=100)
    with pytest.warns(InputWarning, match="its channels differ, and red is read; if another one is meant"):
        roughness = read_roughness_texture(tmp_path / SCENE, "roughness", path.name)
    np.testing.assert_allclose(roughness, 1.0, atol=0.01)


def test_a_grey_jpeg_of_three_channels_is_grey(tmp_path: Path) -> None:
    noise = np.random.default_rng(1).integers(0, 256, (32, 32), np.uint8)
    Image.fromarray(noise).convert("RGB").save(tmp_path / "a.jpg", quality=20)
    assert read_roughness_texture(tmp_path / SCENE, "roughness", "a.jpg").shape == (32, 32)


def test_normals_are_no_roughness(tmp_path: Path) -> None:
    normals = {f"N.{name}": np.zeros((4, 4), np.float32) for name in "XYZ"}
    OpenEXR.File(dict(HEADER), normals).write(str(tmp_path / "a.exr"))
    with pytest.raises(ImageError, match=r"a\.exr: has no colour"):
        read_roughness_texture(tmp_path / SCENE, "roughness", "a.exr")


def test_reflectances_outside_rec709_are_clipped_to_it(tmp_path: Path) -> None:
    image = np.full((4, 4, 3), 0.25, np.float32)
    image[0, 0] = 0.0, 0.5, 0.0
    channels = {name: np.ascontiguousarray(image[..., i]) for i, name in enumerate("RGB")}
    OpenEXR.File({**HEADER, "chromaticities": gamut.ACES_AP1}, channels).write(str(tmp_path / "a.exr"))
    clipped = pytest.warns(InputWarning, match="1 of 16 pixels are outside Rec.709")
    with pytest.warns(InputWarning, match="converted"), clipped:
        texture = read_reflectance_texture(tmp_path / SCENE, "reflectance", "a.exr")
    assert texture[0, 0, 0] == texture[0, 0, 2] == 0.0
    np.testing.assert_allclose(texture[1:], 0.25, rtol=1e-5)


def test_what_lossy_compression_adds_is_clipped(tmp_path: Path) -> None:
    levels = np.linspace(-0.0009, 1.0009, 16, dtype=np.float32).reshape(4, 4)
    OpenEXR.File(dict(HEADER), dict.fromkeys("RGB", levels)).write(str(tmp_path / "a.exr"))
    for reader, least in ((read_roughness_texture, 0.01), (read_reflectance_texture, 0.0)):
        with pytest.warns(InputWarning, match="values are outside 0 to 1, by less than 0.001, and are clipped"):
            texture = reader(tmp_path / SCENE, "key", "a.exr")
        np.testing.assert_allclose(texture.reshape(4, 4, -1)[..., 0], np.clip(levels, least, 1.0), rtol=1e-6)


def test_a_fault_stays_a_fault(tmp_path: Path) -> None:
    image = {name: np.full((4, 4), -0.25, np.float32) for name in "RGB"}
    OpenEXR.File(dict(HEADER), image).write(str(tmp_path / "a.exr"))
    for reader in (read_roughness_texture, read_reflectance_texture):
        with pytest.raises(SceneError, match="values out of range"):
            reader(tmp_path / SCENE, "key", "a.exr")
