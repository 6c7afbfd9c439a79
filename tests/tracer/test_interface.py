"""Interfaces: samples follow the density, and the density obeys the laws of Fresnel, Snell and Helmholtz.

About 50 tests of false-alarm rate `sampling.FALSE_ALARM` each.
"""

import math

import numpy as np
import pytest
from numba import njit
from scipy.integrate import quad

from prt_bake.mathematics.counter import begin_stream, uniform
from prt_bake.tracer.surface.interface import (
    MATCHED,
    ROUGH,
    SMOOTH,
    fresnel,
    masking,
    microfacet_distribution,
    microfacet_transport,
    rough_density,
    sample_interface,
    visible_microfacet,
)
from tests.mathematics.sampling import SAMPLES, SphereCells, assert_counts_follow, assert_mean_is
from tests.tracer.scenes import unit_directions

# Roughness, index ratio and cosine of `i`, from outside and from inside, including total internal reflection.
INTERFACES = [
    (0.05, 1.3, 0.8),
    (0.05, 1 / 1.3, 0.85),
    (0.25, 1.3, 0.95),
    (0.25, 1 / 1.3, 0.5),
    (0.6, 1.3, 0.2),
    (0.6, 1 / 1.3, 0.7),
    (1.0, 2.5, 0.6),
    (1.0, 1 / 2.5, 0.4),
]


@njit
def microfacets(i, alpha, u):
    """Normals [N,3] for u [N,2]."""
    rows = np.empty((len(u), 3))
    for n in range(len(u)):
        rows[n] = visible_microfacet(i[0], i[1], i[2], alpha, u[n, 0], u[n, 1])
    return rows


@njit
def interface_events(kind, alpha, eta, i, transmit_only, count):
    """Directions and weights [N,4] of `count` events, and one more random number of each stream."""
    rows, extra = np.empty((count, 4)), np.empty(count)
    stream = np.zeros(2, np.uint64)
    for n in range(count):
        begin_stream(stream, 3, 1, n)
        rows[n] = sample_interface(kind, alpha, eta, i[0], i[1], i[2], transmit_only, stream)
        extra[n] = uniform(stream)
    return rows, extra


@njit
def interface_densities(alpha, eta, i, o):
    return np.array([rough_density(alpha, eta, i[0], i[1], i[2], w[0], w[1], w[2]) for w in o])


@njit
def sampling_densities(alpha, eta, i, o):
    values = np.empty(len(o))
    for n in range(len(o)):
        density, reflectance = microfacet_transport(alpha, eta, i[0], i[1], i[2], o[n, 0], o[n, 1], o[n, 2])
        values[n] = density * (reflectance if o[n, 2] > 0.0 else 1.0 - reflectance)
    return values


@njit
def microfacet_densities(alpha, i, m):
    values = np.empty(len(m))
    for n in range(len(m)):
        cosine = i[0] * m[n, 0] + i[1] * m[n, 1] + i[2] * m[n, 2]
        result = max(0.0, cosine) if m[n, 2] > 0.0 else 0.0
        values[n] = masking(i[2], alpha) * result * microfacet_distribution(m[n, 2], alpha) / i[2]
    return values


@pytest.fixture(scope="module")
def cells():
    """Cells by roughness: narrow lobes and the edge of total internal reflection require small ones."""
    return {
        0.05: SphereCells(1024, 512),
        0.25: SphereCells(256, 512),
        0.6: SphereCells(256, 512),
        1.0: SphereCells(96, 96),
    }


def direction_at(cosine):
    sine = math.sqrt(1 - cosine**2)
    return np.array([sine * math.cos(0.7), sine * math.sin(0.7), cosine])


@pytest.mark.parametrize("eta", [1.3, 1 / 1.3, 1.5, 2.4])
def test_fresnel_at_normal_grazing_and_polarising_incidence(eta):
    assert fresnel(1.0, eta) == pytest.approx(((eta - 1) / (eta + 1)) ** 2, rel=1e-12)
    assert fresnel(0.0, eta) == pytest.approx(1.0, abs=1e-12)
    assert fresnel(1e-9, eta) == pytest.approx(1.0, abs=1e-7)
    # At Brewster's angle, tan = eta, light polarised in the plane of incidence is not reflected.
    perpendicular = ((1 - eta**2) / (1 + eta**2)) ** 2
    assert fresnel(1 / math.sqrt(1 + eta**2), eta) == pytest.approx(0.5 * perpendicular, rel=1e-12)


def test_fresnel_is_equal_from_both_sides():
    for cosine in np.linspace(0.05, 1.0, 20):
        other = math.sqrt(1 - (1 - cosine**2) / 1.3**2)
        assert fresnel(cosine, 1.3) == pytest.approx(fresnel(other, 1 / 1.3), rel=1e-10)


def test_fresnel_beyond_the_critical_angle_and_without_an_index_step():
    critical = math.sqrt(1 - (1 / 1.3) ** 2)
    assert fresnel(0.999 * critical, 1 / 1.3) == 1.0
    assert 0.5 < fresnel(1.001 * critical, 1 / 1.3) < 1.0
    for cosine in (0.01, 0.3, 1.0):
        assert fresnel(cosine, 1.0) == pytest.approx(0.0, abs=1e-15)
        assert fresnel(cosine, 1.0 + 1e-8) < 1e-7


@pytest.mark.parametrize(("alpha", "cosine"), [(0.05, 0.8), (0.25, 0.1), (0.25, 0.95), (0.6, 0.3), (0.6, 1.0)])
def test_visible_microfacets_follow_their_density(alpha, cosine, cells):
    i = direction_at(cosine)
    probabilities = cells[alpha].integrate(microfacet_densities(alpha, i, cells[alpha].directions))
    normals = microfacets(i, alpha, np.random.default_rng(2).random((SAMPLES, 2)))
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-14)
    assert_counts_follow(cells[alpha].count(normals), probabilities)


def assert_visible_from(i, alpha, normals):
    """Microfacets stretched by 1 / alpha are the visible normals of a hemisphere from the stretched `i` (Heitz 2018):
    density 2 (i·h)⁺ / π (1 + i_z) for any alpha.
    """
    view, stretched = i * [alpha, alpha, 1.0], normals / [alpha, alpha, 1.0]
    view, stretched = view / np.linalg.norm(view), stretched / np.linalg.norm(stretched, axis=1, keepdims=True)
    grid = SphereCells(256, 256)
    result = np.maximum(0.0, grid.directions @ view) * (grid.directions[:, 2] > 0.0)
    assert_counts_follow(grid.count(stretched), grid.integrate(2.0 * result / (np.pi * (1.0 + view[2]))))


@pytest.mark.parametrize("alpha", [1e-3, 0.01, 1.0])
@pytest.mark.parametrize("cosine", [0.05, 0.5, 1.0])
def test_visible_microfacets_of_any_roughness(alpha, cosine):
    i = direction_at(cosine)
    assert_visible_from(i, alpha, microfacets(i, alpha, np.random.default_rng(4).random((SAMPLES, 2))))


@pytest.mark.parametrize(("alpha", "eta", "cosine"), [(0.01, 1.5, 0.8), (0.01, 2.5, 0.3), (0.01, 1 / 1.5, 0.9)])
def test_narrow_interfaces_reflect_and_refract_at_visible_microfacets(alpha, eta, cosine):
    """Half vectors of reflection and refraction together follow the microfacets; Fresnel gives the share of each."""
    i = direction_at(cosine)
    rows, _thinning = interface_events(ROUGH, alpha, eta, i, False, SAMPLES)
    valid = rows[:, 3] > 0.0
    # Microfacets in the tail send a few directions below the surface.
    assert valid.mean() > 0.999
    o, reflected = rows[valid, :3], rows[valid, 2] > 0.0
    half = np.where(reflected[:, None], i + o, -(i + eta * o))
    half *= np.sign(half[:, 2:]) / np.linalg.norm(half, axis=1, keepdims=True)
    assert_visible_from(i, alpha, half)
    due = np.array([fresnel(c, eta) for c in half[:20_000] @ i])
    assert_mean_is(reflected[:20_000] - due, 0.0)


@pytest.mark.parametrize("alpha", [0.05, 0.25, 0.6])
def test_microfacets_project_to_the_plane(alpha):
    # ∫ D cos dω = 1, in tan² = alpha² (e^s − 1), where the integrand is e^−s.
    def integrand(s):
        slope = alpha**2 * math.expm1(s)
        cosine = 1 / math.sqrt(1 + slope)
        return math.pi * microfacet_distribution(cosine, alpha) * cosine**4 * alpha**2 * math.exp(s)

    assert quad(integrand, 0.0, 40.0, epsabs=1e-13)[0] == pytest.approx(1.0, abs=1e-10)


@pytest.mark.parametrize("transmit_only", [False, True])
@pytest.mark.parametrize(("alpha", "eta", "cosine"), INTERFACES)
def test_rough_interface_samples_follow_rough_density(alpha, eta, cosine, transmit_only, cells):
    """Events accepted with the probability of their weight (≤ 1) follow rough_density; the others are lost."""
    i = direction_at(cosine)
    density = interface_densities(alpha, eta, i, cells[alpha].directions)
    if transmit_only:
        density[cells[alpha].directions[:, 2] > 0] = 0.0
    probabilities = cells[alpha].integrate(density)
    rows, extra = interface_events(ROUGH, alpha, eta, i, transmit_only, SAMPLES)
    weights = rows[:, 3]
    assert weights.max() <= 1.0
    kept = rows[extra < weights, :3]
    np.testing.assert_allclose(np.linalg.norm(kept, axis=1), 1.0, atol=1e-12)
    counts = np.append(cells[alpha].count(kept), SAMPLES - len(kept))
    assert_counts_follow(counts, np.append(probabilities, 1.0 - probabilities.sum()))
    assert_mean_is(weights, probabilities.sum())
    for side in (1.0, -1.0):
        there = np.sign(cells[alpha].directions[:, 2]) == side
        expected = cells[alpha].integrate(np.where(there, density, 0.0)).sum()
        if not (transmit_only and side > 0.0):
            assert_mean_is(np.where(np.sign(rows[:, 2]) == side, weights, 0.0), expected)


@pytest.mark.parametrize(("alpha", "eta", "cosine"), INTERFACES)
def test_rough_interface_samples_follow_microfacet_transport(alpha, eta, cosine, cells):
    """All events count, at any weight; connections divide by this density."""
    i = direction_at(cosine)
    probabilities = cells[alpha].integrate(sampling_densities(alpha, eta, i, cells[alpha].directions))
    rows, _thinning = interface_events(ROUGH, alpha, eta, i, False, SAMPLES)
    drawn = rows[rows[:, 3] > 0.0, :3]
    counts = np.append(cells[alpha].count(drawn), SAMPLES - len(drawn))
    assert_counts_follow(counts, np.append(probabilities, 1.0 - probabilities.sum()))


def test_rough_interface_is_reciprocal():
    """f(i→o) equals f(o→i) up to the squared index ratio."""
    eta, alpha = 1.3, 0.4
    directions = unit_directions(400, seed=8)
    above, below = np.abs(directions[:200]) * [1, 1, 1], -np.abs(directions[200:])
    compared = 0
    for i, o in zip(above, below * [0.3, 0.3, 1], strict=True):
        down = o / np.linalg.norm(o)
        there = rough_density(alpha, eta, *i, *down) / abs(down[2])
        # The frame of the reverse direction has its z axis on the other side.
        back = rough_density(alpha, 1 / eta, down[0], down[1], -down[2], i[0], i[1], -i[2]) / abs(i[2])
        assert there == pytest.approx(back * eta**2, rel=1e-9, abs=1e-12)
        compared += there > 1e-3
    assert compared > 50


def test_smooth_interface_reflects_and_refracts_by_fresnel():
    i, eta = direction_at(0.4), 1.3
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
    i = direction_at(0.4)
    rows, _ = interface_events(MATCHED, 0.0, 1.0, i, False, 3)
    np.testing.assert_array_equal(rows, np.tile([*-i, 1.0], (3, 1)))
