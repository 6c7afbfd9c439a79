"""The prefiltered sky: white furnace, energy, equal areas of texels, no seams at folds, rotation."""

import math

import numpy as np
import pytest

from prt_bake.lights import environment
from prt_bake.lights.lighting import Sky
from prt_bake.lights.skies import prefiltered
from prt_bake.lights.skies.prefiltered import radiance
from tests.tracer.scenes import unit_directions

DIRECTIONS = np.concatenate([unit_directions(20_000, 1), np.eye(3), -np.eye(3)])


def sky_of(image: np.ndarray, up="y", degrees=0.0) -> Sky:
    return Sky(np.asarray(image, np.float32), up, environment.rotation(degrees, up))


def prefilter(sky: Sky) -> prefiltered.PrefilteredSky:
    return prefiltered.prefilter(sky.image, sky.to_object)


def linear_sky(height=64, up="y") -> Sky:
    """1 + x, whose mean over a cap of solid angle Ω is 1 + x (1 − Ω / 4π)."""
    width = 2 * height
    u, v = (np.arange(width) + 0.5) / width, (np.arange(height) + 0.5)[:, None] / height
    return sky_of(np.repeat(1 + environment.direction_of(u[None], v, up)[..., :1], 3, axis=2), up)


@pytest.mark.parametrize("shape", [(1, 1), (1, 2), (5, 7), (64, 128)])
def test_a_white_sky_is_white_over_any_solid_angle(shape) -> None:
    sky = prefilter(sky_of(np.ones((*shape, 3))))
    angles = 10.0 ** np.random.default_rng(2).uniform(-9, 2, len(DIRECTIONS))
    np.testing.assert_allclose(radiance(sky, DIRECTIONS, angles), 1.0, rtol=1e-6)


@pytest.mark.parametrize("up", ["y", "z"])
def test_energy_is_kept_even_of_a_sun_of_one_pixel(up) -> None:
    image = np.random.default_rng(3).random((64, 128, 3)).astype(np.float32)
    image[20, 5] = 1e5
    sky = sky_of(image, up, 40.0)
    whole = environment.project(image, 0, up)[0] / math.sqrt(4 * math.pi)
    np.testing.assert_allclose(prefilter(sky).levels[-1][0, 0], whole, rtol=0.01)


def test_texels_have_equal_areas_and_the_mapping_round_trips() -> None:
    uv = np.array([prefiltered.to_square(*direction) for direction in DIRECTIONS])
    back = np.array([prefiltered._to_direction(*point) for point in uv])
    np.testing.assert_allclose(back, DIRECTIONS, atol=1e-14)
    counts, _, _ = np.histogram2d(*uv[:20_000].T, bins=10, range=[[0, 1], [0, 1]])
    chi_square = ((counts - 200.0) ** 2 / 200.0).sum()
    assert chi_square < 99 + 5 * math.sqrt(2 * 99)


@pytest.mark.parametrize("up", ["y", "z"])
def test_radiance_is_averaged_over_the_requested_solid_angle(up) -> None:
    """The filter footprint stays within a few radii of the cap."""
    sky = prefilter(linear_sky(up=up))
    for angle in (1e-2, 1e-1, 1.0):
        seen = radiance(sky, DIRECTIONS, np.full(len(DIRECTIONS), angle))[:, 0]
        off = seen - (1 + DIRECTIONS[:, 0] * (1 - angle / (4 * math.pi)))
        assert abs(off).max() < 0.4 * math.sqrt(angle)
        assert abs(off.mean()) < 0.003
    finest = radiance(sky, DIRECTIONS, np.zeros(len(DIRECTIONS)))[:, 0]
    np.testing.assert_allclose(finest, 1 + DIRECTIONS[:, 0], atol=0.06)


def test_noise_averages_out_over_the_solid_angle() -> None:
    """As over so many independent pixels, or over up to six times as many where the filter is wider than the cap."""
    noise = np.random.default_rng(9).random((64, 128, 1)).repeat(3, axis=2)
    sky = prefilter(sky_of(noise))
    for angle in (1e-2, 1e-1, 1.0):
        pixels = angle / (4.0 * math.pi / (64 * 128))
        found = radiance(sky, DIRECTIONS, np.full(len(DIRECTIONS), angle))[:, 0].std()
        assert 0.4 < found / (noise.std() / math.sqrt(pixels)) < 0.8


def test_the_octahedron_has_no_seams_at_its_folds() -> None:
    """A step of 1e-4 across folds, outer edges and poles changes a smooth sky little."""
    u, v = (np.arange(128) + 0.5) / 128, (np.arange(64) + 0.5)[:, None] / 64
    slope = environment.direction_of(u[None], v) @ np.array([0.6, 0.5, 0.62])
    sky = prefilter(sky_of(np.repeat(1 + slope[..., None], 3, axis=2)))
    generator = np.random.default_rng(5)
    on_folds = unit_directions(3000, 7)
    on_folds[np.arange(3000), generator.integers(0, 3, 3000)] = 0.0
    on_folds /= np.linalg.norm(on_folds, axis=1, keepdims=True)
    steps = on_folds + 1e-4 * generator.normal(size=on_folds.shape)
    steps /= np.linalg.norm(steps, axis=1, keepdims=True)
    for angle in (1e-4, 1e-2, 0.3):
        here, there = (radiance(sky, part, np.full(3000, angle)) for part in (on_folds, steps))
        assert abs(here - there).max() < 2e-3


def test_a_rotated_sky_gives_rotated_radiance() -> None:
    image = np.random.default_rng(4).random((16, 32, 3))
    turn = environment.rotation(77.0, "y")
    still, turned = prefilter(sky_of(image)), prefilter(sky_of(image, "y", 77.0))
    angles = np.full(len(DIRECTIONS), 0.05)
    ours, theirs = radiance(turned, DIRECTIONS @ turn.T, angles), radiance(still, DIRECTIONS, angles)
    np.testing.assert_allclose(ours, theirs, atol=1e-9)


def test_a_picture_finer_than_the_texels_is_averaged_first() -> None:
    """Alternating black and white columns of one pixel become grey."""
    stripes = np.zeros((64, 16384, 3), np.float32)
    stripes[:, ::2] = 1.0
    reduced = prefiltered._reduced(stripes, 64)
    np.testing.assert_allclose(reduced, 0.5)
    assert prefiltered._reduced(stripes[:, :128], 64).shape[1] == 128


def test_the_largest_float32_is_averaged_without_overflow() -> None:
    largest = np.finfo(np.float32).max
    for level in prefilter(sky_of(np.full((8, 16, 3), largest))).levels:
        np.testing.assert_allclose(level, largest, rtol=1e-6)
