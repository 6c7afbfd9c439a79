"""Free flights and transmittances follow the optical depth for any grid, blocks and channels.

About 30 tests of false-alarm rate `sampling.FALSE_ALARM` each.
"""

import math

import numpy as np
import pytest
from numba import njit

from prt_bake.mathematics.counter import begin_stream
from prt_bake.tracer.volume.majorants import extinction_blocks
from prt_bake.tracer.volume.media import extinction, multiply_albedo
from prt_bake.tracer.volume.tracking import attenuate, flight_by_channel, free_flight
from tests.mathematics.sampling import SAMPLES, assert_counts_follow, assert_mean_is
from tests.tracer.grids import HIGH, LOW, look_up, medium_of, optical_depths

GENERATOR = np.random.default_rng(17)
EVEN = GENERATOR.uniform(0.1, 4.0, (3, 4, 5)).astype(np.float32)
RARE = np.where(GENERATOR.random((24, 20, 18)) < 0.01, 25.0, 0.0025).astype(np.float32)
"""Few cells 10,000 times as dense as the others, so that there are several blocks."""
COLOURED = GENERATOR.uniform(0.0, 4.0, (3, 4, 5, 3)).astype(np.float32)
GRIDS = {"even": EVEN, "rare dense cells": RARE}
FROM, ALONG = np.array([-0.6, -0.5, -0.35]), np.array([0.6, 0.64, 0.48])
BACK = FROM + 1.7 * ALONG


@njit
def flights(medium, p, d, far, count):
    distances, at, stream = np.empty(count), np.zeros(3), np.zeros(2, np.uint64)
    for n in range(count):
        begin_stream(stream, 5, 2, n)
        distances[n] = free_flight(medium, 1, p, d, far, at, stream)
    return distances


@njit
def coloured_flights(medium, p, d, far, before, count):
    """Distances [N], and throughputs [N,3] after flights that start with throughput `before`."""
    distances, after, at, stream = np.empty(count), np.empty((count, 3)), np.zeros(3), np.zeros(2, np.uint64)
    for n in range(count):
        begin_stream(stream, 5, 3, n)
        after[n] = before
        distances[n] = flight_by_channel(medium, 1, p, d, far, after[n], at, stream)
    return distances, after


@njit
def transmittances(medium, p, d, near, far, count):
    kept, at, stream = np.ones((count, 3)), np.zeros(3), np.zeros(2, np.uint64)
    for n in range(count):
        begin_stream(stream, 6, 2, n)
        attenuate(medium, 1, p, d, near, far, at, stream, kept[n])
    return kept


@pytest.mark.parametrize("name", GRIDS)
@pytest.mark.parametrize(("p", "d"), [(FROM, ALONG), (BACK, -ALONG)])
def test_free_flights_in_a_grid_follow_the_optical_depth(name, p, d):
    far = 1.5
    t, depth = optical_depths(GRIDS[name], p, d, far)
    distances = flights(medium_of(GRIDS[name]), p, d, far, SAMPLES)
    met = distances[np.isfinite(distances)]
    assert met.max() < far
    reached = 1 - math.exp(-depth[-1])
    passed = -np.expm1(-np.interp(met, t, depth))
    counts = np.append(np.histogram(passed, bins=64, range=(0.0, reached))[0], SAMPLES - len(met))
    assert_counts_follow(counts, np.append(np.full(64, reached / 64), 1 - reached))


def test_free_flights_in_a_homogeneous_medium_are_exponential():
    distances = flights(medium_of(2.5), np.zeros(3), np.array([0.0, 0.0, 1.0]), 0.7, SAMPLES)
    met = distances[np.isfinite(distances)]
    reached = 1 - math.exp(-2.5 * 0.7)
    counts = np.append(np.histogram(-np.expm1(-2.5 * met), bins=64, range=(0.0, reached))[0], SAMPLES - len(met))
    assert_counts_follow(counts, np.append(np.full(64, reached / 64), 1 - reached))


@pytest.mark.parametrize("sigma_t", [COLOURED, np.array([0.0, 1.0, 6.0])])
@pytest.mark.parametrize("before", [np.array([1.0, 1.0, 1.0]), np.array([0.2, 0.0, 3.0])])
def test_flights_by_channel_are_unbiased_in_each_channel(sigma_t, before):
    """Per channel: scattering in each interval of the flight, and transmittance; weights are bounded."""
    far = 1.2
    if sigma_t.ndim == 1:
        t = np.linspace(0.0, far, 101)
        depth = t[:, None] * sigma_t
    else:
        t, depth = optical_depths(sigma_t, FROM, ALONG, far)
    distances, after = coloured_flights(medium_of(sigma_t), FROM, ALONG, far, before, SAMPLES)
    np.testing.assert_allclose(after.sum(axis=1), before.sum(), rtol=1e-9)
    ends = np.array([0.2, 0.7, far])
    for c in range(3):
        kept = np.exp(-np.interp(np.append(0.0, ends), t, depth[:, c])) * before[c]
        for first, last, due in zip(np.append(0.0, ends), ends, -np.diff(kept), strict=False):
            there = (distances >= first) & (distances < last)
            _assert_mean_is(np.where(there, after[:, c], 0.0), due)
        _assert_mean_is(np.where(np.isinf(distances), after[:, c], 0.0), kept[-1])


def _assert_mean_is(values, mean):
    """Values of an impossible event are 0; others have the expected mean."""
    if mean == 0.0:
        assert not values.any()
    else:
        assert_mean_is(values, mean)


def test_thick_media_do_not_underflow_by_channel():
    _distances, after = coloured_flights(medium_of(np.array([1e4, 2e4, 3e4])), FROM, ALONG, 1.0, np.ones(3), 1000)
    assert np.isfinite(after).all()
    np.testing.assert_allclose(after.sum(axis=1), 3.0, rtol=1e-9)


def test_vacuum_has_no_events():
    vacuum = medium_of(0.0)
    assert np.isinf(flights(vacuum, np.zeros(3), np.array([0.0, 0.0, 1.0]), np.inf, 10)).all()
    assert (transmittances(vacuum, np.zeros(3), np.array([0.0, 0.0, 1.0]), 0.0, 5.0, 10) == 1.0).all()


# The last one is so deep that roulette ends nearly all.
@pytest.mark.parametrize(("near", "far"), [(0.0, 0.3), (0.4, 1.2), (0.0, 4.0)])
@pytest.mark.parametrize("name", [*GRIDS, "coloured"])
def test_transmittance_in_a_grid_is_unbiased(name, near, far):
    grid = COLOURED if name == "coloured" else GRIDS[name]
    t, depth = optical_depths(grid, FROM, ALONG, far)
    depth = np.stack([depth] * 3, axis=1) if depth.ndim == 1 else depth
    kept = transmittances(medium_of(grid), FROM, ALONG, near, far, SAMPLES)
    assert kept.min() >= 0.0
    for c in range(3):
        expected = math.exp(np.interp(near, t, depth[:, c]) - depth[-1, c])
        assert_mean_is(kept[:, c], expected)


def test_transmittance_of_a_homogeneous_medium_is_exact():
    kept = transmittances(medium_of(2.5), np.zeros(3), np.array([1.0, 0.0, 0.0]), 0.2, 0.9, 3)
    np.testing.assert_allclose(kept, math.exp(-2.5 * 0.7), rtol=1e-14)


def test_transmittance_of_a_constant_grid_is_exact():
    kept = transmittances(medium_of(np.full((4, 4, 4), 2.5)), FROM, ALONG, 0.2, 0.9, 3)
    np.testing.assert_allclose(kept, math.exp(-2.5 * 0.7), rtol=1e-12)


@pytest.mark.parametrize("shape", [(24, 20, 18), (1, 1, 1), (40, 1, 3), (64, 64, 64)])
def test_blocks_bound_the_extinction_in_them(shape):
    grid = np.where(np.random.default_rng(2).random(shape) < 0.02, 1000.0, 0.1)
    bounds, (nx, ny, nz) = extinction_blocks(grid, HIGH - LOW)
    points = np.random.default_rng(3).uniform(LOW, HIGH, (20_000, 3))
    voxels = np.array(shape[::-1])
    across = ((points - LOW) / (HIGH - LOW) * voxels - 0.5) / np.maximum(voxels - 1, 1)
    place = np.clip(across * [nx, ny, nz], 0, np.array([nx, ny, nz]) - 1).astype(int)
    low, high = bounds[(place[:, 2] * ny + place[:, 1]) * nx + place[:, 0]].T
    values = look_up(grid, points)
    assert (values >= low - 1e-9).all()
    assert (values <= high * (1 + 1e-9)).all()


def test_number_of_blocks_follows_the_contrast():
    assert np.prod(extinction_blocks(np.full((32, 32, 32), 3.0), np.ones(3))[1]) == 1
    assert np.prod(extinction_blocks(RARE, np.ones(3))[1]) > 100


@pytest.mark.parametrize("shape", [(3, 4, 5), (1, 4, 2), (2, 1, 1), (1, 1, 1)])
def test_grids_are_trilinear_between_cell_centres_and_clamped_beyond(shape):
    generator = np.random.default_rng(10)
    sigma_t = generator.uniform(0.1, 4.0, shape).astype(np.float32)
    albedo = generator.uniform(0.0, 1.0, (*shape[::-1], 3)).astype(np.float32)
    medium = medium_of(sigma_t, albedo)
    points = np.concatenate([generator.uniform(LOW - 0.3, HIGH + 0.3, (2000, 3)), [LOW, HIGH]])
    extinctions, throughputs = np.empty(len(points)), np.empty((len(points), 3))
    for n, point in enumerate(points):
        extinctions[n] = extinction(medium, 1, point, 0)
        throughputs[n] = 0.5
        multiply_albedo(medium, 1, point, throughputs[n])
    np.testing.assert_allclose(extinctions, look_up(sigma_t, points), rtol=1e-6)
    np.testing.assert_allclose(throughputs, 0.5 * look_up(albedo, points), rtol=1e-6)
