"""Reflection in NumPy equals the reflecting part of the walk's interface, to rounding and at the extremes."""

import numpy as np
import pytest
from numba import njit

from prt_bake.mathematics.counter import begin_stream
from prt_bake.reflection.microfacet import (
    fresnel,
    half_vectors,
    masking,
    mirrored,
    reflection_density,
    visible_facets,
)
from prt_bake.tracer.surface import interface
from prt_bake.tracer.surface.losses import CELLS, LOSS, loss_tables
from tests.mathematics.sampling import SAMPLES, Z_BOUND, SphereCells, assert_counts_follow

ETAS = (1.4, 2.5, 1 / 1.4)


@njit
def kernel_density(alpha, eta, i, o):
    """f(i, o) |o·n| of the walk's interface for rows of i and o."""
    return np.array([interface.rough_density(alpha, eta, *_triple(i[n]), *_triple(o[n])) for n in range(len(i))])


@njit
def _triple(row):
    return row[0], row[1], row[2]


@njit
def kernel_facets(alpha, i, u):
    rows = np.empty((len(u), 3))
    for n in range(len(u)):
        rows[n] = interface.visible_microfacet(i[n, 0], i[n, 1], i[n, 2], alpha, u[n, 0], u[n, 1])
    return rows


def upper(count, seed, cosine=None):
    """Directions above the horizon [N,3], half of them grazing, or all at one cosine."""
    generator = np.random.default_rng(seed)
    z = np.where(generator.random(count) < 0.5, generator.random(count), 10 ** generator.uniform(-8, 0, count))
    z = z if cosine is None else np.full(count, cosine)
    turn, sine = generator.random(count) * 2 * np.pi, np.sqrt(1 - z * z)
    return np.stack([sine * np.cos(turn), sine * np.sin(turn), z], axis=1)


def reflected(towards, o, alpha, eta):
    """f(i, o) |o·n| in NumPy."""
    facets, rough = half_vectors(towards, o), np.full(len(o), alpha)
    share = fresnel(np.einsum("ni,ni->n", towards, facets), eta) * masking(o[:, 2], rough)
    return share * reflection_density(towards, facets, rough)


@pytest.mark.parametrize("eta", ETAS)
def test_fresnel_and_masking_equal_those_of_the_walks(eta):
    cosines = np.array([0.0, 1e-9, 1e-3, 0.2, 0.69, 0.7, 0.9, 1.0])
    expected = [interface.fresnel(cosine, eta) for cosine in cosines]
    np.testing.assert_allclose(fresnel(cosines, eta), expected, rtol=1e-12)
    for alpha in (1e-4, 0.3, 1.0):
        expected = [interface.masking(cosine, alpha) for cosine in cosines]
        np.testing.assert_allclose(masking(cosines, np.full(8, alpha)), expected, rtol=1e-12)
    assert masking(np.array([-0.5]), np.array([0.3])) == 0.0


@pytest.mark.parametrize("eta", ETAS)
@pytest.mark.parametrize("alpha", [1e-4, 1e-2, 0.3, 1.0])
def test_reflection_equals_that_of_the_walks(alpha, eta):
    """For mirror directions of facets, for other directions, and at grazing."""
    towards = upper(3000, 1)
    facets = visible_facets(towards, np.full(3000, alpha), np.random.default_rng(2).random((3000, 2)))
    o = np.concatenate([mirrored(towards, facets), upper(3000, 3)])
    towards = np.concatenate([towards, towards])
    above = o[:, 2] > 0.0
    expected = kernel_density(alpha, eta, towards[above], o[above])
    # The walks compute the sine of a facet from its cosine, which loses digits for narrow lobes.
    np.testing.assert_allclose(
        reflected(towards[above], o[above], alpha, eta), expected, rtol=max(1e-9, 1e-14 / alpha**2)
    )
    assert above[:3000].mean() > 0.4
    assert (expected[: above[:3000].sum()] > 0.0).all()


@pytest.mark.parametrize("alpha", [1e-4, 0.1, 1.0])
def test_facets_equal_those_of_the_walks(alpha):
    towards, numbers = upper(3000, 4), np.random.default_rng(5).random((3000, 2))
    towards[0] = [0.0, 0.0, 1.0]
    facets = visible_facets(towards, np.full(3000, alpha), numbers)
    np.testing.assert_allclose(np.linalg.norm(facets, axis=1), 1.0, rtol=1e-14)
    np.testing.assert_allclose(facets, kernel_facets(alpha, towards, numbers), atol=1e-12)


@pytest.mark.parametrize("alpha", [1e-4, 1e-2, 0.3, 1.0])
@pytest.mark.parametrize("cosine", [1e-6, 0.05, 0.6, 1.0])
def test_sampled_facets_follow_the_density_of_visible_facets(alpha, cosine):
    """Stretched by 1 / alpha they are visible points of a hemisphere: density 2 (i·h)⁺ / π (1 + i_z) (Heitz 2018)."""
    towards = upper(1, 6, cosine)
    numbers = np.random.default_rng(7).random((SAMPLES, 2))
    facets = visible_facets(np.repeat(towards, SAMPLES, axis=0), np.full(SAMPLES, alpha), numbers)
    stretched = facets / [alpha, alpha, 1.0]
    stretched /= np.linalg.norm(stretched, axis=1, keepdims=True)
    view = towards[0] * [alpha, alpha, 1.0]
    view /= np.linalg.norm(view)
    grid = SphereCells(128, 128)
    seen = np.maximum(0.0, grid.directions @ view) * (grid.directions[:, 2] > 0.0)
    assert_counts_follow(grid.count(stretched), grid.integrate(2.0 * seen / (np.pi * (1.0 + view[2]))))


@pytest.mark.parametrize(("alpha", "cosine"), [(0.25, 0.05), (0.25, 0.9), (0.6, 0.3), (1.0, 0.01), (1.0, 1.0)])
def test_reflected_directions_follow_their_density_which_integrates_to_one(alpha, cosine):
    """By cells above the horizon; the rest of the density is below it."""
    cells = SphereCells(256, 256) if alpha < 0.5 else SphereCells(64, 64)
    towards = upper(1, 8, cosine)
    grid = np.repeat(towards, len(cells.directions), axis=0)
    density = reflection_density(grid, half_vectors(grid, cells.directions), np.full(len(grid), alpha))
    above = cells.integrate(np.where(cells.directions[:, 2] > 0.0, density, 0.0))
    rows, rough = np.repeat(towards, SAMPLES, axis=0), np.full(SAMPLES, alpha)
    drawn = mirrored(rows, visible_facets(rows, rough, np.random.default_rng(9).random((SAMPLES, 2))))
    counts = cells.count(drawn[drawn[:, 2] > 0.0])
    assert_counts_follow(np.append(counts, SAMPLES - counts.sum()), np.append(above, 1.0 - above.sum()))
    if alpha < 0.5 and cosine > 0.5:
        assert cells.integrate(density).sum() == pytest.approx(1.0, abs=3e-5)


@njit
def transmitted(alpha, eta, i, count):
    """Initial weights of walks [N]: the transmittance of the facet times masking."""
    weights, stream = np.empty(count), np.zeros(2, np.uint64)
    for n in range(count):
        begin_stream(stream, 3, 1, n)
        weights[n] = interface.sample_interface(interface.ROUGH, alpha, eta, i[0], i[1], i[2], True, stream)[3]
    return weights


@pytest.mark.parametrize("eta", ETAS)
@pytest.mark.parametrize("alpha", [0.1, 0.3, 1.0])
def test_reflection_transmission_and_loss_sum_to_one(alpha, eta):
    """The loss is that of the energy-compensating lobe."""
    losses = loss_tables([eta], (alpha, alpha))[0, 0, LOSS : LOSS + CELLS + 1]
    for node in (CELLS // 3, CELLS * 3 // 4, CELLS):
        towards = upper(1, 10, (node / CELLS) ** 2)
        rows, rough = np.repeat(towards, SAMPLES, axis=0), np.full(SAMPLES, alpha)
        facets = visible_facets(rows, rough, np.random.default_rng(11).random((SAMPLES, 2)))
        reflectance = fresnel(np.einsum("ni,ni->n", rows, facets), eta)
        kept = reflectance * masking(mirrored(rows, facets)[:, 2], rough) + transmitted(alpha, eta, towards[0], SAMPLES)
        error = Z_BOUND * kept.std() / SAMPLES**0.5
        # The table sums over a grid of facets, with an error of about 1e-4 at the onset of total reflection.
        assert kept.mean() == pytest.approx(1.0 - losses[node], abs=error + 3e-4)
