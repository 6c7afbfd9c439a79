"""What the path tracer draws follows the density it says: streams, phase function, interface, free flights, lobes.

Counts in cells are held against the density's own integrals by a chi-square test, means by z. Each single test would
fail a sound sampler with probability FALSE_ALARM, had its seed not been fixed; about 60 of them are made.
"""

import math

import numpy as np
import pytest
from numba import njit
from scipy.integrate import quad
from scipy.interpolate import RegularGridInterpolator
from scipy.stats import chi2, norm
from scenes import unit_directions

from prt_bake import sh
from prt_bake.trainer.connect import _lobe_density
from prt_bake.trainer.counter import begin_stream, uniform
from prt_bake.trainer.interface import (
    MATCHED,
    ROUGH,
    SMOOTH,
    fresnel,
    masking,
    microfacet_density,
    rough_density,
    sample_interface,
    visible_microfacet,
)
from prt_bake.trainer.kernels import harmonics
from prt_bake.trainer.media import Medium, extinction, free_flight, multiply_albedo, phase, phase_cosine, transmittance

FALSE_ALARM = 1e-6
Z_BOUND = norm.isf(FALSE_ALARM / 2)
LEAST_EXPECTED = 10
GENERATOR = np.random.default_rng(17)
# Contrast 40:1, so that most of delta tracking's events are null ones.
EXTINCTION = GENERATOR.uniform(0.1, 4.0, (3, 4, 5)).astype(np.float32)
ALBEDO = GENERATOR.uniform(0.0, 1.0, (4, 2, 3, 3)).astype(np.float32)
LOW, HIGH = np.array([-0.5, -0.4, -0.3]), np.array([0.5, 0.6, 0.2])
# Roughness, index ratio and cosine of `i`: from outside and from inside, total reflection among the latter.
INTERFACES = [
    (0.05, 1.3, 0.8),
    (0.05, 1 / 1.3, 0.85),
    (0.25, 1.3, 0.95),
    (0.25, 1 / 1.3, 0.5),
    (0.6, 1.3, 0.2),
    (0.6, 1 / 1.3, 0.7),
]
SAMPLES = 200_000


def assert_counts_follow(counts, probabilities):
    """Chi-square of counts against probabilities that sum to 1; cells that expect too few are taken together."""
    assert probabilities.sum() == pytest.approx(1.0, abs=1e-4)
    assert counts[probabilities == 0.0].sum() == 0
    expected = counts.sum() * probabilities
    large = expected >= LEAST_EXPECTED
    rest_expected = expected[~large].sum()
    observed, expected = counts[large], expected[large]
    if rest_expected >= LEAST_EXPECTED:
        observed, expected = np.append(observed, counts[~large].sum()), np.append(expected, rest_expected)
    assert len(observed) >= 8
    statistic = ((observed - expected) ** 2 / expected).sum()
    assert statistic < chi2.isf(FALSE_ALARM, len(observed) - 1)


def assert_mean_is(values, expected):
    error = values.std(ddof=1) / math.sqrt(len(values))
    assert abs(values.mean() - expected) < Z_BOUND * error


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
def microfacets(i, alpha, u):
    """Normals [N,3] for u [N,2]."""
    rows = np.empty((len(u), 3))
    for n in range(len(u)):
        rows[n] = visible_microfacet(i[0], i[1], i[2], alpha, u[n, 0], u[n, 1])
    return rows


@njit
def interface_events(kind, alpha, eta, i, transmit_only, count):
    """Directions and weights [N,4] of `count` events, and one more number of each stream to thin them by."""
    rows, thinning = np.empty((count, 4)), np.empty(count)
    stream = np.zeros(2, np.uint64)
    for n in range(count):
        begin_stream(stream, 3, 1, n)
        rows[n] = sample_interface(kind, alpha, eta, i[0], i[1], i[2], transmit_only, stream)
        thinning[n] = uniform(stream)
    return rows, thinning


@njit
def interface_densities(alpha, eta, i, o):
    return np.array([rough_density(alpha, eta, i[0], i[1], i[2], w[0], w[1], w[2]) for w in o])


@njit
def microfacet_densities(alpha, i, m):
    values = np.empty(len(m))
    for n in range(len(m)):
        cosine = i[0] * m[n, 0] + i[1] * m[n, 1] + i[2] * m[n, 2]
        seen = max(0.0, cosine) if m[n, 2] > 0.0 else 0.0
        values[n] = masking(i[2], alpha) * seen * microfacet_density(m[n, 2], alpha) / i[2]
    return values


@njit
def flights(medium, p, d, far, count):
    distances, at, stream = np.empty(count), np.zeros(3), np.zeros(2, np.uint64)
    for n in range(count):
        begin_stream(stream, 5, 2, n)
        distances[n] = free_flight(medium, p, d, far, at, stream)
    return distances


@njit
def transmittances(medium, p, d, near, far, count):
    kept, at, stream = np.empty(count), np.zeros(3), np.zeros(2, np.uint64)
    for n in range(count):
        begin_stream(stream, 6, 2, n)
        kept[n] = transmittance(medium, p, d, near, far, at, stream)
    return kept


class SphereCells:
    """The sphere cut into rings of equal height and sectors: integrals by 4×4 Gauss points a cell, and counts."""

    def __init__(self, rings, sectors):
        self.rings, self.sectors = rings, sectors
        nodes, weights = np.polynomial.legendre.leggauss(4)
        z = (2 * (np.arange(rings)[:, None] + 0.5 * (nodes + 1)) / rings - 1).ravel()
        phi = (2 * np.pi * (np.arange(sectors)[:, None] + 0.5 * (nodes + 1)) / sectors).ravel()
        sine = np.sqrt(1 - z**2)[:, None]
        x, y = sine * np.cos(phi), sine * np.sin(phi)
        self.directions = np.stack([x, y, np.broadcast_to(z[:, None], x.shape)], axis=-1).reshape(-1, 3)
        self.point_weights = np.outer(weights, weights) * np.pi / (rings * sectors)

    def integrate(self, values):
        """∫ over each cell [cells]."""
        table = values.reshape(self.rings, 4, self.sectors, 4)
        return np.einsum("iajb,ab->ij", table, self.point_weights).ravel()

    def count(self, directions):
        """Directions in each cell [cells]."""
        ring = np.minimum((0.5 * (directions[:, 2] + 1) * self.rings).astype(int), self.rings - 1)
        turn = np.arctan2(directions[:, 1], directions[:, 0]) / (2 * np.pi) % 1.0
        sector = np.minimum((turn * self.sectors).astype(int), self.sectors - 1)
        return np.bincount(ring * self.sectors + sector, minlength=self.rings * self.sectors)


@pytest.fixture(scope="module")
def cells():
    """Cells by roughness: narrow lobes want small ones."""
    return {0.05: SphereCells(256, 512), 0.25: SphereCells(128, 256), 0.6: SphereCells(64, 128)}


def seen_from(cosine):
    sine = math.sqrt(1 - cosine**2)
    return np.array([sine * math.cos(0.7), sine * math.sin(0.7), cosine])


def grid_medium(sigma_t=EXTINCTION, albedo=ALBEDO, phase_g=0.0):
    return Medium(
        sigma_t=float(sigma_t.max()),
        phase_g=phase_g,
        albedo=np.ones(3),
        extinction_grid=sigma_t,
        albedo_grid=albedo,
        has_extinction_grid=True,
        has_albedo_grid=True,
        low=LOW,
        per_length=1.0 / (HIGH - LOW),
    )


def homogeneous_medium(sigma_t):
    nothing = np.zeros((1, 1, 1), np.float32)
    return grid_medium()._replace(
        sigma_t=sigma_t,
        has_extinction_grid=False,
        extinction_grid=nothing,
        has_albedo_grid=False,
        albedo_grid=nothing[..., None],
    )


def look_up(grid, points):
    """scipy's own trilinear look-up of a grid [Z,Y,X,…] at points [N,3] = (x, y, z), clamped to the cell centres."""
    for axis in range(3):
        if grid.shape[axis] == 1:
            grid = np.repeat(grid, 2, axis=axis)
    centres = [
        LOW[k] + (np.arange(count) + 0.5) / count * (HIGH[k] - LOW[k]) for k, count in enumerate(grid.shape[2::-1])
    ]
    inside = np.clip(points, [c[0] for c in centres], [c[-1] for c in centres])
    return RegularGridInterpolator(centres[::-1], grid.astype(np.float64))(inside[:, ::-1])


def optical_depths(p, d, far, steps=20_000):
    """Distances and ∫ sigma_t up to each, along p + t d in the grid, by the midpoint rule."""
    t = np.linspace(0.0, far, steps + 1)
    middles = 0.5 * (t[1:] + t[:-1])
    return t, np.append(0.0, np.cumsum(look_up(EXTINCTION, p + middles[:, None] * d)) * far / steps)


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


def test_every_part_of_a_key_opens_another_stream():
    seeds, queries, paths = (part.ravel().astype(np.uint64) for part in np.mgrid[0:20, 0:20, 0:20])
    table = stream_numbers(seeds, queries, paths, 2)
    assert len(np.unique(table[:, 0])) == len(np.unique(table[:, 1])) == 8000


@pytest.mark.parametrize("g", [-0.99, -0.5, 0.0, 1e-9, 0.3, 0.9, 0.99])
def test_phase_function_is_normalised_and_its_mean_cosine_is_g(g):
    # In cos = 1 − (1 − |g|)(e^s − 1) toward the peak the integrand is smooth on a scale of one.
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
    # Edges where a tabulated inverse of the density's own integral has equal shares.
    s = np.linspace(0.0, 1.0, 400_001)
    near = 1 - abs(g)
    table = np.sign(g or 1.0) * (1 - near * np.expm1(s * math.log1p(2 / near)))
    density = 2 * np.pi * np.array([phase(cosine, g) for cosine in table])
    cumulative = np.append(0.0, np.cumsum(0.5 * (density[1:] + density[:-1]) * np.abs(np.diff(table))))
    edges = np.sort(np.interp(np.linspace(0, 1, 65)[1:-1] * cumulative[-1], cumulative, table))
    counts = np.bincount(np.searchsorted(edges, cosines), minlength=64)
    assert_counts_follow(counts, np.full(64, 1 / 64))


@pytest.mark.parametrize("g", [-0.99, 0.0, 0.7])
def test_phase_cosine_runs_from_backward_to_forward(g):
    cosines = phase_cosines(g, np.linspace(0.0, 1.0, 10_001))
    assert cosines[0] == pytest.approx(-1.0, abs=1e-12)
    assert cosines[-1] == pytest.approx(1.0, abs=1e-12)
    assert (np.diff(cosines) >= 0.0).all()


@pytest.mark.parametrize("eta", [1.3, 1 / 1.3, 1.5, 2.4])
def test_fresnel_at_normal_grazing_and_polarising_incidence(eta):
    assert fresnel(1.0, eta) == pytest.approx(((eta - 1) / (eta + 1)) ** 2, rel=1e-12)
    assert fresnel(0.0, eta) == pytest.approx(1.0, abs=1e-12)
    assert fresnel(1e-9, eta) == pytest.approx(1.0, abs=1e-7)
    # At Brewster's angle, tan = eta, what is polarised in the plane of incidence is not reflected at all.
    perpendicular = ((1 - eta**2) / (1 + eta**2)) ** 2
    assert fresnel(1 / math.sqrt(1 + eta**2), eta) == pytest.approx(0.5 * perpendicular, rel=1e-12)


def test_fresnel_is_the_same_from_both_sides():
    for cosine in np.linspace(0.05, 1.0, 20):
        other = math.sqrt(1 - (1 - cosine**2) / 1.3**2)
        assert fresnel(cosine, 1.3) == pytest.approx(fresnel(other, 1 / 1.3), rel=1e-10)


def test_fresnel_reflects_all_beyond_the_critical_angle_and_nothing_without_a_step():
    critical = math.sqrt(1 - (1 / 1.3) ** 2)
    assert fresnel(0.999 * critical, 1 / 1.3) == 1.0
    assert 0.5 < fresnel(1.001 * critical, 1 / 1.3) < 1.0
    for cosine in (0.01, 0.3, 1.0):
        assert fresnel(cosine, 1.0) == pytest.approx(0.0, abs=1e-15)
        assert fresnel(cosine, 1.0 + 1e-8) < 1e-7


@pytest.mark.parametrize(("alpha", "cosine"), [(0.05, 0.8), (0.25, 0.1), (0.25, 0.95), (0.6, 0.3), (0.6, 1.0)])
def test_visible_microfacets_follow_their_density(alpha, cosine, cells):
    i = seen_from(cosine)
    probabilities = cells[alpha].integrate(microfacet_densities(alpha, i, cells[alpha].directions))
    normals = microfacets(i, alpha, np.random.default_rng(2).random((SAMPLES, 2)))
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-14)
    assert_counts_follow(cells[alpha].count(normals), probabilities)


@pytest.mark.parametrize("alpha", [0.05, 0.25, 0.6])
def test_microfacets_cover_the_plane_once(alpha):
    # ∫ D cos dω = 1, in tan² = alpha² (e^s − 1), where the integrand is e^−s.
    def integrand(s):
        slope = alpha**2 * math.expm1(s)
        cosine = 1 / math.sqrt(1 + slope)
        return math.pi * microfacet_density(cosine, alpha) * cosine**4 * alpha**2 * math.exp(s)

    assert quad(integrand, 0.0, 40.0, epsabs=1e-13)[0] == pytest.approx(1.0, abs=1e-10)


@pytest.mark.parametrize("transmit_only", [False, True])
@pytest.mark.parametrize(("alpha", "eta", "cosine"), INTERFACES)
def test_rough_interface_sends_light_by_its_density(alpha, eta, cosine, transmit_only, cells):
    """Events kept with a probability of their weight (≤ 1) are distributed as rough_density; the others are lost."""
    i = seen_from(cosine)
    density = interface_densities(alpha, eta, i, cells[alpha].directions)
    if transmit_only:
        density[cells[alpha].directions[:, 2] > 0] = 0.0
    probabilities = cells[alpha].integrate(density)
    rows, thinning = interface_events(ROUGH, alpha, eta, i, transmit_only, SAMPLES)
    weights = rows[:, 3]
    assert weights.max() <= 1.0
    kept = rows[thinning < weights, :3]
    np.testing.assert_allclose(np.linalg.norm(kept, axis=1), 1.0, atol=1e-12)
    counts = np.append(cells[alpha].count(kept), SAMPLES - len(kept))
    assert_counts_follow(counts, np.append(probabilities, 1.0 - probabilities.sum()))
    assert_mean_is(weights, probabilities.sum())
    for side in (1.0, -1.0):
        there = np.sign(cells[alpha].directions[:, 2]) == side
        expected = cells[alpha].integrate(np.where(there, density, 0.0)).sum()
        if not (transmit_only and side > 0.0):
            assert_mean_is(np.where(np.sign(rows[:, 2]) == side, weights, 0.0), expected)


def test_rough_interface_is_reciprocal():
    """f(i→o) · |o·n| over the receiving cosine is the same turned round, but for the squared index ratio."""
    eta, alpha = 1.3, 0.4
    directions = unit_directions(400, seed=8)
    above, below = np.abs(directions[:200]) * [1, 1, 1], -np.abs(directions[200:])
    compared = 0
    for i, o in zip(above, below * [0.3, 0.3, 1], strict=True):
        down = o / np.linalg.norm(o)
        there = rough_density(alpha, eta, *i, *down) / abs(down[2])
        # The frame of the way back has its z axis on the other side.
        back = rough_density(alpha, 1 / eta, down[0], down[1], -down[2], i[0], i[1], -i[2]) / abs(i[2])
        assert there == pytest.approx(back * eta**2, rel=1e-9, abs=1e-12)
        compared += there > 1e-3
    assert compared > 50


def test_smooth_interface_reflects_and_refracts_as_fresnel_says():
    i, eta = seen_from(0.4), 1.3
    rows, _ = interface_events(SMOOTH, 0.0, eta, i, False, SAMPLES)
    mirrored = rows[:, 2] > 0
    assert (rows[:, 3] == 1.0).all()
    assert_mean_is(mirrored.astype(float), fresnel(0.4, eta))
    np.testing.assert_allclose(rows[mirrored, :3] - [-i[0], -i[1], i[2]], 0.0, atol=1e-15)
    np.testing.assert_allclose(rows[~mirrored, :2] + i[:2] / eta, 0.0, atol=1e-15)
    np.testing.assert_allclose(np.linalg.norm(rows[:, :3], axis=1), 1.0, atol=1e-14)
    only, _ = interface_events(SMOOTH, 0.0, eta, i, True, 10)
    np.testing.assert_allclose(only[:, 3], 1 - fresnel(0.4, eta), rtol=1e-14)
    assert (only[:, 2] < 0).all()


def test_matched_interface_changes_nothing():
    i = seen_from(0.4)
    rows, _ = interface_events(MATCHED, 0.0, 1.0, i, False, 3)
    np.testing.assert_array_equal(rows, np.tile([*-i, 1.0], (3, 1)))


def test_free_flights_in_a_grid_follow_the_optical_depth():
    p, d, far = np.array([-0.6, -0.5, -0.35]), np.array([0.8, 0.6, 0.0]), 1.6
    d = d * math.sqrt(0.9) + [0.0, 0.0, math.sqrt(0.1)]
    t, depth = optical_depths(p, d, far)
    distances = flights(grid_medium(), p, d, far, SAMPLES)
    met = distances[np.isfinite(distances)]
    assert met.max() < far
    reached = 1 - math.exp(-depth[-1])
    passed = -np.expm1(-np.interp(met, t, depth))
    counts = np.append(np.histogram(passed, bins=64, range=(0.0, reached))[0], SAMPLES - len(met))
    assert_counts_follow(counts, np.append(np.full(64, reached / 64), 1 - reached))


def test_free_flights_in_a_homogeneous_medium_are_exponential():
    distances = flights(homogeneous_medium(2.5), np.zeros(3), np.array([0.0, 0.0, 1.0]), 0.7, SAMPLES)
    met = distances[np.isfinite(distances)]
    reached = 1 - math.exp(-2.5 * 0.7)
    counts = np.append(np.histogram(-np.expm1(-2.5 * met), bins=64, range=(0.0, reached))[0], SAMPLES - len(met))
    assert_counts_follow(counts, np.append(np.full(64, reached / 64), 1 - reached))


def test_nothing_is_met_in_a_vacuum():
    vacuum = homogeneous_medium(0.0)
    assert np.isinf(flights(vacuum, np.zeros(3), np.array([0.0, 0.0, 1.0]), np.inf, 10)).all()
    assert (transmittances(vacuum, np.zeros(3), np.array([0.0, 0.0, 1.0]), 0.0, 5.0, 10) == 1.0).all()


# The last one is deep enough for the roulette to decide nearly always.
@pytest.mark.parametrize(("near", "far"), [(0.0, 0.3), (0.4, 1.2), (0.0, 4.0)])
def test_transmittance_in_a_grid_is_unbiased(near, far):
    p, d = np.array([-0.6, -0.5, -0.35]), np.array([0.6, 0.64, 0.48])
    t, depth = optical_depths(p, d, far)
    expected = math.exp(np.interp(near, t, depth) - depth[-1])
    kept = transmittances(grid_medium(), p, d, near, far, SAMPLES)
    assert kept.min() >= 0.0
    assert_mean_is(kept, expected)


def test_transmittance_of_a_homogeneous_medium_is_exact():
    kept = transmittances(homogeneous_medium(2.5), np.zeros(3), np.array([1.0, 0.0, 0.0]), 0.2, 0.9, 3)
    np.testing.assert_allclose(kept, math.exp(-2.5 * 0.7), rtol=1e-14)


@pytest.mark.parametrize("kappa", [0.5, 3.0, 30.0, 333.0])
def test_aiming_lobe_integrates_to_one(kappa):
    total = quad(lambda cosine: 2 * math.pi * _lobe_density(cosine, kappa), -1.0, 1.0, points=[1 - 5 / (kappa + 5)])
    assert total[0] == pytest.approx(1.0, abs=1e-10)


def test_kernel_harmonics_are_those_of_the_package():
    directions = np.concatenate([unit_directions(500, seed=9), np.eye(3), -np.eye(3)])
    for degree in (0, 1, 2, 7, 20):
        basis = np.full((len(directions), (degree + 1) ** 2), np.nan)
        for d, row in zip(directions, basis, strict=True):
            harmonics(*d, degree, row)
        np.testing.assert_allclose(basis, sh.evaluate(directions, degree), rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("shape", [(3, 4, 5), (1, 4, 2), (2, 1, 1), (1, 1, 1)])
def test_grids_are_trilinear_between_cell_centres_and_clamped_beyond(shape):
    generator = np.random.default_rng(10)
    sigma_t = generator.uniform(0.1, 4.0, shape).astype(np.float32)
    albedo = generator.uniform(0.0, 1.0, (*shape[::-1], 3)).astype(np.float32)
    medium = grid_medium(sigma_t, albedo)
    points = np.concatenate([generator.uniform(LOW - 0.3, HIGH + 0.3, (2000, 3)), [LOW, HIGH]])
    extinctions, throughputs = np.empty(len(points)), np.empty((len(points), 3))
    for n, point in enumerate(points):
        extinctions[n] = extinction(medium, point)
        throughputs[n] = 0.5
        multiply_albedo(medium, point, throughputs[n])
    np.testing.assert_allclose(extinctions, look_up(sigma_t, points), rtol=1e-6)
    np.testing.assert_allclose(throughputs, 0.5 * look_up(albedo, points), rtol=1e-6)
