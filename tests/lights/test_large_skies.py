"""Skies larger than memory: projection from the file, downsampled copies, bad pixels."""

import math
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from formats.errors import ImageError, QueryError
from formats.image import read_image, write_image
from formats.image.rows import rows_of
from prt_bake.lights import environment, lighting
from prt_bake.lights.harmonics import project_lighting
from prt_bake.lights.lighting import read_lighting
from prt_bake.lights.skies import downsampled, pixels
from prt_bake.mathematics import sh
from prt_bake.shading.picture import render_picture
from tests.shading.test_picture import front, make_asset
from tests.shapes import ball


@pytest.fixture(autouse=True)
def every_sky_is_large(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lighting, "MAX_BYTES", 0)


def painted(height: int, width: int, seed: int = 1) -> np.ndarray:
    image = np.random.default_rng(seed).random((height, width, 3)).astype(np.float32) ** 3
    image[height // 3, width // 5] = 1e5
    return image


def solid_angles(height: int) -> np.ndarray:
    return np.diff(-np.cos(np.linspace(0, math.pi, height + 1)))


def slow_copy(image: np.ndarray, height: int, width: int) -> np.ndarray:
    """The copy by sums over a grid that contains the edges of both pictures."""
    (h, w), out = image.shape[:2], np.zeros((height, width, 3))
    fine = np.repeat(np.repeat(image.astype(np.float64), height, 0), width, 1)
    weights = np.repeat(solid_angles(h * height)[:, None], w * width, 1)
    for i in range(height):
        for j in range(width):
            here = slice(i * h, (i + 1) * h), slice(j * w, (j + 1) * w)
            out[i, j] = np.einsum("ij,ijc->c", weights[here], fine[here]) / weights[here].sum()
    return out


@pytest.mark.parametrize("suffix", [".exr", ".hdr"])
@pytest.mark.parametrize("degree", [0, 2, 6])
def test_projection_from_the_file_equals_that_in_memory(tmp_path: Path, suffix: str, degree: int) -> None:
    path = tmp_path / f"sky{suffix}"
    write_image(path, painted(75, 150))
    found = environment.project(environment.open_environment(path), degree, "z")
    expected = environment.project(read_image(path), degree, "z")
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-13 * np.abs(expected).max())


@pytest.mark.parametrize(
    ("shape", "height"), [((12, 24), 5), ((9, 14), 4), ((40, 10), 7), ((64, 128), 16), ((5, 3), 5)]
)
def test_a_copy_holds_means_over_solid_angle(shape: tuple[int, int], height: int) -> None:
    image = painted(*shape)
    copy, residual = downsampled.shrink(rows_of(image, rows=5), height, 3)
    assert copy.shape == (height, round(shape[1] * height / shape[0]), 3)
    np.testing.assert_allclose(copy, slow_copy(image, *copy.shape[:2]), rtol=1e-5)
    energy = np.einsum("h,hwc->c", solid_angles(shape[0]), image.astype(np.float64)) / shape[1]
    np.testing.assert_allclose(
        np.einsum("h,hwc->c", solid_angles(height), copy.astype(np.float64)) / copy.shape[1], energy, rtol=1e-6
    )
    whole = environment.project(image, 3)
    found = environment.project(copy, 3) + sh.rotation(environment.from_polar("y"), 3) @ residual
    np.testing.assert_allclose(found, whole, rtol=0, atol=1e-12 * np.abs(whole).max())


def test_a_copy_of_a_constant_sky_is_constant() -> None:
    copy, residual = downsampled.shrink(rows_of(np.full((37, 91, 3), 0.7, np.float32)), 11, 4)
    np.testing.assert_allclose(copy, 0.7, rtol=1e-6)
    assert np.abs(residual).max() < 1e-6


@pytest.mark.parametrize("up", ["y", "z"])
def test_a_downsampled_sky_has_the_harmonics_of_the_original(tmp_path: Path, up: str) -> None:
    """Including exposure, tint and rotation."""
    write_image(tmp_path / "sky.exr", painted(96, 192))
    (tmp_path / "a.toml").write_text('[[sky]]\nfile = "sky.exr"\nrotate = 40\nexposure = 1\ntint = [1, 2, 0.5]\n')
    lights = [tmp_path / "a.toml", tmp_path / "sky.exr"]
    whole = project_lighting(read_lighting(lights, up, 25.0), 3)
    small = read_lighting(lights, up, 25.0, most_rows=10, degree=3)
    assert [sky.image.shape for sky in small.skies] == [(10, 20, 3)] * 2
    np.testing.assert_allclose(project_lighting(small, 3), whole, rtol=0, atol=1e-10 * np.abs(whole).max())
    np.testing.assert_allclose(project_lighting(small, 2), whole[:9], rtol=0, atol=1e-10 * np.abs(whole).max())
    with pytest.raises(QueryError, match="harmonics to degree 3, not 4"):
        project_lighting(small, 4)
    assert small.content_hash() != read_lighting(lights, up, 25.0, most_rows=10, degree=2).content_hash()


def test_small_skies_are_not_downsampled(tmp_path: Path) -> None:
    image = painted(16, 32)
    write_image(tmp_path / "sky.exr", image)
    (sky,) = read_lighting([tmp_path / "sky.exr"], most_rows=16).skies
    np.testing.assert_array_equal(sky.image, image)
    assert sky.residual is None


def test_a_picture_with_a_downsampled_sky_equals_that_with_the_original(tmp_path: Path) -> None:
    """The background differs by the filter alone, the light on the object not at all."""
    v = (np.arange(512) + 0.5)[:, None] / 512
    u = (np.arange(1024) + 0.5) / 1024
    image = np.stack([1.5 + np.sin(40 * u) * np.sin(math.pi * v), 1 + v + 0 * u, 1 + v * u], axis=-1)
    write_image(tmp_path / "sky.exr", image)
    asset, view = make_asset(ball(2)), front(24, 18)
    rows = downsampled.rows_shown(view.height, view.fov)
    assert 18 < rows < 100
    small = read_lighting([tmp_path / "sky.exr"], most_rows=rows)
    whole = render_picture(asset, read_lighting([tmp_path / "sky.exr"]), view, samples=6)
    shown = render_picture(asset, small, view, samples=6)
    inside = whole.coverage == 1.0
    np.testing.assert_allclose(shown.image[inside], whole.image[inside], rtol=1e-6)
    np.testing.assert_allclose(shown.image, whole.image, atol=0.03)


def test_rows_shown_by_a_picture() -> None:
    assert downsampled.rows_shown(1, 179.0) == 1
    assert downsampled.rows_shown(480, 30.0) == math.ceil(480 * math.pi / (2 * math.tan(math.radians(15))))
    assert downsampled.rows_shown(10_000, 1e-3) == 4096


def test_memory_does_not_grow_with_the_sky(tmp_path: Path) -> None:
    write_image(tmp_path / "sky.exr", np.ones((1024, 2048, 3), np.float32))  # 25 MB
    tracemalloc.start()
    (sky,) = read_lighting([tmp_path / "sky.exr"], most_rows=64).skies
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    np.testing.assert_allclose(sky.image, 1.0, rtol=1e-6)
    assert peak < 6 << 20


def test_bad_pixels_are_counted_over_all_blocks_or_repaired(tmp_path: Path) -> None:
    """The largest finite value comes after the first infinity."""
    image = painted(100, 10).clip(0, 1)
    image[3, 4, 1], image[40, 2], image[70, 1, 0], image[99, 9] = np.inf, np.nan, -2.0, np.inf
    image[80, 3, 2] = 55.0
    write_image(tmp_path / "sky.exr", image)
    messages: list[str] = []
    opened = environment.open_environment(tmp_path / "sky.exr", say=messages.append)
    with pytest.raises(ImageError, match=r"found 4 of 1000 pixels .*3 NaN, 4 infinite, 1 negative.* row 3, column 4"):
        environment.project(opened)
    read = environment.open_environment(tmp_path / "sky.exr", mend=True, say=messages.append)
    expected = repaired(image)
    assert expected[3, 4, 1] == 55.0
    np.testing.assert_array_equal(read.read(), expected)
    np.testing.assert_allclose(environment.project(read), environment.project(expected), rtol=0, atol=1e-12)
    assert len([words for words in messages if "repaired 8 values" in words]) == 1  # read twice, reported once
    half = image.astype("float16")
    np.testing.assert_array_equal(repaired(half), repaired(half.astype(np.float32)))


def repaired(image: np.ndarray) -> np.ndarray:
    return pixels.repaired(rows_of(image), lambda sentence: None).read()
