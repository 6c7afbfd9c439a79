"""Samples of the path tracer follow their densities: random streams, phase function, diffuse surfaces.

About 50 tests of false-alarm rate `sampling.FALSE_ALARM` each.
"""

import math
from collections import namedtuple

import numpy as np
import pytest
from numba import njit
from scipy.integrate import quad

from prt_bake.mathematics import sh
from prt_bake.mathematics.counter import begin_stream, uniform
from prt_bake.tracer.kernels import harmonics
from prt_bake.tracer.volume.media import phase, phase_cosine
from prt_bake.tracer.walk import COUNTS_SIZE, DENSITY, DIRECTION, MASK, NORMAL, STATE_SIZE, bounce, scatter
from tests.mathematics.sampling import SAMPLES, assert_counts_follow, assert_mean_is
from tests.tracer.grids import medium_of
from tests.tracer.scenes import unit_directions

Regions = namedtuple("Regions", "region_of_mask")
Faces = namedtuple("Faces", "faces")


@njit
def stream_numbers(seeds, queries, paths, count):
    table = np.empty((len(seeds), count))
    stream = np.zeros(2, np.uint64)
    for n in range(len(seeds)):
        begin_stream(stream, seeds[n], queries[n], paths[n])
        for j in range(count):
            table[n, j] = uniform(stream)
    return table


@njit
def phase_cosines(g, u):
    return np.array([phase_cosine(g, value) for value in u])


@njit
def scattered(regions, medium, before, count):
    """Directions [N,3] after one scattering each, and the stored densities [N]."""
    drawn, densities = np.empty((count, 3)), np.empty(count)
    state, counts, stream = np.zeros(STATE_SIZE), np.zeros(COUNTS_SIZE, np.int64), np.zeros(2, np.uint64)
    counts[MASK] = 1
    for n in range(count):
        begin_stream(stream, 7, 2, n)
        state[DIRECTION : DIRECTION + 3] = before
        scatter(regions, medium, state, counts, stream)
        drawn[n], densities[n] = state[DIRECTION : DIRECTION + 3], state[DENSITY]
    return drawn, densities


@njit
def bounced(boundary, normal, before, count):
    """Directions [N,3] after one diffuse reflection each at face 0, and the stored densities [N]."""
    drawn, densities = np.empty((count, 3)), np.empty(count)
    state, counts, stream = np.zeros(STATE_SIZE), np.zeros(COUNTS_SIZE, np.int64), np.zeros(2, np.uint64)
    for n in range(count):
        begin_stream(stream, 7, 3, n)
        state[DIRECTION : DIRECTION + 3], state[NORMAL : NORMAL + 3] = before, normal
        bounce(boundary, state, counts, stream)
        drawn[n], densities[n] = state[DIRECTION : DIRECTION + 3], state[DENSITY]
    return drawn, densities


def ring_counts(directions, axis, heights, edges):
    """Counts [rings·12] by height and by azimuth about the axis."""
    across = np.cross(axis, [0.0, 1.0, 0.0])
    across /= np.linalg.norm(across)
    turn = np.arctan2(directions @ np.cross(axis, across), directions @ across) / (2 * np.pi) % 1.0
    return np.histogram2d(heights, turn, bins=(edges, np.linspace(0, 1, 13)))[0].ravel()


@pytest.mark.parametrize("varied", ["seed", "query", "path"])
@pytest.mark.parametrize("shift", [1, 3])
def test_streams_are_uniform_and_independent_along_and_across(varied, shift):
    keys = {name: np.full(500, 4, np.uint64) for name in ("seed", "query", "path")}
    keys[varied] = np.arange(500, dtype=np.uint64)
    table = stream_numbers(keys["seed"], keys["query"], keys["path"], 500)
    assert table.min() >= 0.0
    assert table.max() < 1.0
    for axis in (0, 1):
        pairs = np.stack([table, np.roll(table, shift, axis=axis)], axis=-1).reshape(-1, 2)
        counts = np.histogram2d(pairs[:, 0], pairs[:, 1], bins=32, range=[[0, 1], [0, 1]])[0].ravel()
        assert_counts_follow(counts, np.full(1024, 1 / 1024))
    lowest_bits = (table * 2.0**53).astype(np.uint64) & np.uint64(15)
    assert_counts_follow(np.bincount(lowest_bits.ravel().astype(int), minlength=16), np.full(16, 1 / 16))


def test_every_part_of_a_key_selects_another_stream():
    seeds, queries, paths = (part.ravel().astype(np.uint64) for part in np.mgrid[0:20, 0:20, 0:20])
    table = stream_numbers(seeds, queries, paths, 2)
    assert len(np.unique(table[:, 0])) == len(np.unique(table[:, 1])) == 8000


@pytest.mark.parametrize("g", [-0.99, -0.5, 0.0, 1e-9, 0.3, 0.9, 0.99])
def test_phase_function_is_normalised_and_its_mean_cosine_is_g(g):
    # In s, cos = 1 − (1 − |g|)(e^s − 1) toward the peak, the integrand is smooth on a scale of one.
    def around_the_peak(moment):
        near = 1 - abs(g)
        sign = math.copysign(1.0, g)

        def integrand(s):
            cosine = 1 - near * math.expm1(s)
            return 2 * math.pi * phase(sign * cosine, g) * near * math.exp(s) * (sign * cosine) ** moment

        return quad(integrand, 0.0, math.log1p(2 / near), epsabs=1e-13, epsrel=1e-12, limit=200)[0]

    assert around_the_peak(0) == pytest.approx(1.0, abs=1e-11)
    assert around_the_peak(1) == pytest.approx(g, abs=1e-11)


@pytest.mark.parametrize("g", [-0.99, -0.5, 0.0, 1e-9, 0.3, 0.9, 0.99])
def test_phase_cosines_follow_the_phase_function(g):
    cosines = phase_cosines(g, np.random.default_rng(1).random(SAMPLES))
    assert np.abs(cosines).max() <= 1.0
    assert_mean_is(cosines, g)
    # Edges of equal probability from a tabulated integral of the density.
    s = np.linspace(0.0, 1.0, 400_001)
    near = 1 - abs(g)
    table = np.sign(g or 1.0) * (1 - near * np.expm1(s * math.log1p(2 / near)))
    density = 2 * np.pi * np.array([phase(cosine, g) for cosine in table])
    cumulative = np.append(0.0, np.cumsum(0.5 * (density[1:] + density[:-1]) * np.abs(np.diff(table))))
    edges = np.sort(np.interp(np.linspace(0, 1, 65)[1:-1] * cumulative[-1], cumulative, table))
    counts = np.bincount(np.searchsorted(edges, cosines), minlength=64)
    assert_counts_follow(counts, np.full(64, 1 / 64))


@pytest.mark.parametrize("g", [-0.99, 0.0, 0.7])
def test_phase_cosine_increases_from_backward_to_forward(g):
    cosines = phase_cosines(g, np.linspace(0.0, 1.0, 10_001))
    assert cosines[0] == pytest.approx(-1.0, abs=1e-12)
    assert cosines[-1] == pytest.approx(1.0, abs=1e-12)
    assert (np.diff(cosines) >= 0.0).all()


def test_kernel_harmonics_agree_with_sh():
    directions = np.concatenate([unit_directions(500, seed=9), np.eye(3), -np.eye(3)])
    for degree in (0, 1, 2, 7, 20):
        basis = np.full((len(directions), (degree + 1) ** 2), np.nan)
        for d, row in zip(directions, basis, strict=True):
            harmonics(*d, degree, row)
        np.testing.assert_allclose(basis, sh.evaluate(directions, degree), rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("g", [-0.5, 0.0, 0.8])
def test_scattered_directions_follow_the_phase_function(g):
    """Cosine and azimuth relative to the previous direction; the stored density is that of the sample."""
    before = np.array([0.6, -0.48, -0.64])
    drawn, densities = scattered(Regions(np.array([0, 1])), medium_of(2.0, phase_g=g), before, SAMPLES)
    np.testing.assert_allclose(np.linalg.norm(drawn, axis=1), 1.0, atol=1e-14)
    cosines = drawn @ before
    np.testing.assert_allclose(densities[:1000], [phase(cosine, g) for cosine in cosines[:1000]], rtol=1e-12)
    edges = np.linspace(-1.0, 1.0, 17)
    below = 0.5 * (1 + edges) if g == 0 else (1 - g * g) / (2 * g) / np.sqrt(1 + g * g - 2 * g * edges)
    assert_counts_follow(ring_counts(drawn, before, cosines, edges), np.repeat(np.diff(below) / 12, 12))


@pytest.mark.parametrize("from_behind", [False, True])
def test_diffuse_reflection_follows_the_cosine_on_the_incident_side(from_behind):
    """About the interpolated normal, which differs from the face normal; the stored density is that of the sample."""
    face = np.array([0.48, 0.6, 0.64])
    normal = face + np.array([0.1, -0.05, 0.02])
    normal /= np.linalg.norm(normal)
    before = np.array([-0.6, -0.64, 0.48]) - 0.5 * face
    before /= np.linalg.norm(before)
    axis = normal
    if from_behind:
        before, axis = -before, -normal
    drawn, densities = bounced(Faces(face[None].copy()), normal, before, SAMPLES)
    np.testing.assert_allclose(np.linalg.norm(drawn, axis=1), 1.0, atol=1e-14)
    cosines = drawn @ axis
    assert cosines.min() >= 0.0
    np.testing.assert_allclose(densities, cosines / np.pi, rtol=1e-9, atol=1e-12)
    edges = np.linspace(0.0, 1.0, 17)
    assert_counts_follow(ring_counts(drawn, axis, cosines, edges), np.repeat(np.diff(edges**2) / 12, 12))
