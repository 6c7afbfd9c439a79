"""Lights of a preview: reloading and prefiltering."""

import math
import os
from pathlib import Path

import numpy as np
import pytest

from formats.errors import PrtbakeError
from formats.image import write_image
from prt_bake.lights import environment
from prt_bake.preview.lights import LightSource
from prt_bake.preview.mirrored import prefiltered_sky, resampled_sky
from tests.shading.test_picture import constant, painted_sky


def write(path: Path, content: bytes) -> None:
    """Write a file with a later time stamp, however coarse the file system's clock."""
    later = path.stat().st_mtime_ns + 10_000_000 if path.exists() else None
    path.write_bytes(content)
    if later is not None:
        os.utime(path, ns=(later, later))


def test_a_changed_sky_is_reloaded(tmp_path) -> None:
    path, other = tmp_path / "sky.exr", tmp_path / "other.exr"
    write_image(path, painted_sky())
    write_image(other, constant())
    source = LightSource(str(path), "y", 2)
    first = source.shown
    assert source.reload() is None
    assert source.shown is first
    write(path, other.read_bytes()[:200])
    message = source.reload()
    assert message is not None
    assert "sky.exr" in message
    assert "still showing" in message
    assert source.shown is first
    assert source.reload() is None  # the message is not repeated
    write(path, other.read_bytes())
    assert "was reloaded" in str(source.reload())
    np.testing.assert_allclose(source.shown.harmonics[0], math.sqrt(4 * math.pi))
    path.unlink()
    message = source.reload()
    assert message is not None
    assert "still showing" in message
    np.testing.assert_allclose(source.shown.harmonics[0], math.sqrt(4 * math.pi))


def test_changed_skies_of_a_lights_file_are_reloaded(tmp_path) -> None:
    write_image(tmp_path / "sky.exr", constant())
    write_image(tmp_path / "other.exr", 2.0 * constant())
    (tmp_path / "lights.toml").write_text('[[sky]]\nfile = "sky.exr"\n[[directional]]\ndirection = [0, 1, 0]\n')
    source = LightSource(str(tmp_path / "lights.toml"), "y", 2)
    first = source.shown.harmonics
    write(tmp_path / "sky.exr", (tmp_path / "other.exr").read_bytes())
    assert source.reload() is not None
    np.testing.assert_allclose(source.shown.harmonics[0] - first[0], math.sqrt(4 * math.pi))
    write(tmp_path / "lights.toml", b"[[directional]]\ndirection = 3\n")
    assert "still showing" in str(source.reload())


def test_several_lights_are_added_up_and_reloaded(tmp_path) -> None:
    write_image(tmp_path / "sky.exr", constant())
    write_image(tmp_path / "other.exr", 2.0 * constant())
    alone = [LightSource(text, "y", 2).shown.harmonics for text in (str(tmp_path / "sky.exr"), "sun:0,1,0")]
    source = LightSource([str(tmp_path / "sky.exr"), "sun:0,1,0"], "y", 2)
    assert source.name == "sky.exr + sun:0,1,0"
    np.testing.assert_allclose(source.shown.harmonics, sum(alone))
    write(tmp_path / "sky.exr", (tmp_path / "other.exr").read_bytes())
    assert source.reload() == "sky.exr + sun:0,1,0 was reloaded"
    np.testing.assert_allclose(source.shown.harmonics, sum(alone) + alone[0])


def test_a_missing_light_is_refused(tmp_path) -> None:
    with pytest.raises(PrtbakeError, match=r"none\.exr"):
        LightSource(str(tmp_path / "none.exr"), "y", 2)


@pytest.mark.parametrize("up", ["y", "z"])
def test_the_background_shows_skies_and_discs(tmp_path, up) -> None:
    write_image(tmp_path / "sky.exr", painted_sky())
    alone = LightSource(str(tmp_path / "sky.exr"), up, 2).shown
    np.testing.assert_array_equal(alone.picture, painted_sky())
    assert LightSource("sun:1,2,3", up, 2).shown.picture is None
    (tmp_path / "lights.toml").write_text(
        '[[sky]]\nfile = "sky.exr"\nrotate = 50.0\n'
        "[[directional]]\ndirection = [1, 0.2, 0.1]\nangular_diameter = 20.0\n"
    )
    both = LightSource(str(tmp_path / "lights.toml"), up, 2).shown
    directions = np.random.default_rng(5).normal(size=(500, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    off = np.abs(environment.lookup(both.picture, directions, up) - both.lighting.radiance(directions)).max(axis=1)
    assert np.quantile(off, 0.97) < 0.02  # all but the edge of the sun
    np.testing.assert_allclose(environment.project(both.picture, 2, up), both.harmonics, atol=0.05)


@pytest.mark.parametrize("alpha", [0.05, 0.3, 1.0])
def test_prefiltering_keeps_a_constant_sky(alpha) -> None:
    np.testing.assert_allclose(prefiltered_sky(constant((1.0, 2.0, 3.0)), alpha)[..., :] / [1, 2, 3], 1.0, rtol=1e-5)


def test_a_smooth_surface_needs_no_prefiltering() -> None:
    sky = painted_sky()
    assert prefiltered_sky(sky, 0.0) is sky


@pytest.mark.parametrize("alpha", [0.2, 0.5])
@pytest.mark.parametrize("direction", [[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [-1.0, 0.3, 0.02], [0.1, -1.0, 0.2]])
def test_prefiltering_equals_the_mean_over_the_lobe(alpha, direction) -> None:
    """Compared with a sum over the sky, at a pole, at the seam and elsewhere."""
    height, width = 128, 256
    v, u = (np.arange(height) + 0.5) / height, (np.arange(width) + 0.5) / width
    light = environment.direction_of(u, v[:, None])
    sky = (1.0 + light @ np.array([[0.5, 0.2, -0.4], [0.1, 0.6, 0.2], [-0.3, 0.2, 0.5]])).astype(np.float32)
    normal = np.array(direction) / np.linalg.norm(direction)
    cosine = light @ normal
    half = np.sqrt(0.5 + 0.5 * cosine)
    weight = alpha**2 / (half**2 * (alpha**2 - 1.0) + 1.0) ** 2 * np.maximum(cosine, 0.0) / np.maximum(half, 1e-9)
    weight *= np.sin(math.pi * v)[:, None]
    expected = np.einsum("hw,hwc->c", weight, sky) / weight.sum()
    found = environment.lookup(prefiltered_sky(sky, alpha), normal)
    np.testing.assert_allclose(found, expected, atol=0.02)


@pytest.mark.parametrize("shape", [(64, 128), (50, 75), (3, 5), (1, 1)])
def test_resampling_keeps_the_energy(shape) -> None:
    sky = np.random.default_rng(0).random((*shape, 3)).astype(np.float32)
    small = resampled_sky(sky, 16)
    assert small.shape == (16, 32, 3)
    np.testing.assert_allclose(environment.project(small, 0), environment.project(sky, 0), rtol=0.02)
