"""Lobes: the density integrates to 1, samples follow it, and extremes are finite and correct."""

import math

import numpy as np
import pytest

from formats.errors import QueryError
from prt_bake.mathematics import lobe
from prt_bake.mathematics.lobe import Lobe
from tests.mathematics.sampling import SAMPLES, SphereCells, assert_counts_follow, assert_mean_is

SIGMAS = (1e-3, 0.05, 0.4, 1.0, math.pi, 10.0 * math.pi)
SHAPES = (0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 16.0)
RNG = np.random.default_rng(1)


def angles(sigma: float) -> tuple[np.ndarray, np.ndarray]:
    """Gauss nodes and weights over [0, π], refined towards both poles and over the width of the lobe."""
    near = np.geomspace(1e-6, np.pi, 120)
    own = np.minimum(np.linspace(0.0, 40.0 * sigma, 200), np.pi)
    edges = np.unique(np.concatenate([[0.0], near, np.pi - near[:-1], own, [np.pi]]))
    nodes, weights = np.polynomial.legendre.leggauss(12)
    half = 0.5 * np.diff(edges)[:, None]
    return (edges[:-1, None] + half * (nodes + 1.0)).ravel(), (half * weights).ravel()


def unit(*shape: int) -> np.ndarray:
    vectors = RNG.normal(size=(*shape, 3))
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("sigma", SIGMAS)
def test_density_integrates_to_one(sigma: float, shape: float) -> None:
    theta, weights = angles(sigma)
    per_angle = 2.0 * np.pi * np.sin(theta) * lobe.density(sigma, shape, np.cos(theta))
    assert (per_angle * weights).sum() == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize("shape", [1.0, 2.0, 3.0])
def test_sigma_is_the_standard_deviation_of_each_planar_coordinate(shape: float) -> None:
    """A lobe too narrow to wrap: E[θ²] = 2σ²."""
    theta, weights = angles(0.05)
    own = (lobe.density(0.05, shape, np.cos(theta)) - 0.1 / (4 * np.pi)) / 0.9
    second = (theta**2 * 2.0 * np.pi * np.sin(theta) * own * weights).sum()
    assert second == pytest.approx(2.0 * 0.05**2, rel=1e-6)


def test_gaussian_is_the_sum_over_its_wraps() -> None:
    theta, sigma = np.array([0.3, 1.0, 2.0, 3.0]), 1.7
    radii = np.abs(theta[:, None] + 2.0 * np.pi * np.arange(-6, 7))
    planar = radii * np.exp(-(radii**2) / (2 * sigma**2)) / (2 * np.pi * sigma**2)
    expected = 0.9 * planar.sum(axis=1) / np.sin(theta) + 0.1 / (4 * np.pi)
    np.testing.assert_allclose(lobe.density(sigma, 2.0, np.cos(theta)), expected, rtol=1e-12)


@pytest.mark.parametrize("shape", [1.0, 2.0, 2.7])
@pytest.mark.parametrize("sigma", [0.3, 1.1, 31.4])
def test_samples_follow_the_density(sigma: float, shape: float) -> None:
    """Chi-square over 48×4 cells about an oblique axis, and the mean of 1/density, which is the sphere's area."""
    axis = np.array([0.6, -0.48, -0.64])
    draws = lobe.draw(
        np.full(SAMPLES, sigma), shape, np.random.default_rng(3).random((SAMPLES, 3)), np.tile(axis, (SAMPLES, 1))
    )
    np.testing.assert_allclose(np.linalg.norm(draws, axis=1), 1.0, atol=1e-12)
    cosine = draws @ axis
    cells = 48
    turn = np.arctan2(draws @ np.array([0.8, 0.36, 0.48]), draws @ np.array([0.0, 0.8, -0.6]))
    sector = np.minimum(((turn / (2 * np.pi) % 1.0) * 4).astype(int), 3)
    ring = np.minimum((np.arccos(np.clip(cosine, -1, 1)) / np.pi * cells).astype(int), cells - 1)
    counts = np.bincount(4 * ring + sector, minlength=4 * cells)
    nodes, weights = np.polynomial.legendre.leggauss(12)
    theta = (np.arange(cells)[:, None] + 0.5 * (nodes + 1.0)) * np.pi / cells
    per_angle = 2.0 * np.pi * np.sin(theta) * lobe.density(sigma, shape, np.cos(theta))
    shares = per_angle @ weights * (0.5 * np.pi / cells)
    assert_counts_follow(counts, np.repeat(shares / 4, 4))
    assert_mean_is(1.0 / lobe.density(sigma, shape, cosine[:20_000]), 4.0 * np.pi)


@pytest.mark.parametrize("shape", SHAPES)
def test_density_is_finite_and_never_below_the_uniform_share(shape: float) -> None:
    cosine = np.concatenate([[-1.0, 1.0, 0.0], np.cos(np.geomspace(1e-9, 3.1, 50)), -np.cos(np.geomspace(1e-9, 1, 50))])
    for sigma in (*lobe.SIGMAS, *SIGMAS):
        values = lobe.density(sigma, shape, cosine)
        assert np.isfinite(values).all()
        assert values.min() >= 0.1 / (4 * np.pi)


def test_narrow_lobe_has_its_planar_peak_on_the_axis() -> None:
    expected = 0.9 / (2 * np.pi * 1e-3**2) + 0.1 / (4 * np.pi)
    assert lobe.density(1e-3, 2.0, 1.0) == pytest.approx(expected, rel=1e-12)


def test_very_wide_lobe_is_uniform_in_angle() -> None:
    theta = np.linspace(0.1, 3.0, 7)
    expected = 0.9 / (2.0 * np.pi**2 * np.sin(theta)) + 0.1 / (4 * np.pi)
    np.testing.assert_allclose(lobe.density(100.0, 2.0, np.cos(theta)), expected, rtol=1e-3)


@pytest.mark.parametrize("shape", SHAPES)
def test_extreme_numbers_give_unit_directions(shape: float) -> None:
    ends = np.array([0.0, 0.05, 0.5, 1.0 - 2.0**-53])
    numbers = np.stack(np.meshgrid(ends, ends, ends), axis=-1).reshape(-1, 3)
    for sigma in (*lobe.SIGMAS, *SIGMAS):
        for axis in ([0.0, 0.0, 1.0], [0.0, 0.0, -1.0]):
            draws = lobe.draw(np.full(len(numbers), sigma), shape, numbers, np.tile(axis, (len(numbers), 1)))
            np.testing.assert_allclose(np.linalg.norm(draws, axis=1), 1.0, atol=1e-12)


def test_samples_of_several_lobes_follow_their_sum() -> None:
    """Chi-square of samples of two queries against the density of their three lobes."""
    axes, cells = unit(2, 3), SphereCells(24, 12)
    lobes = Lobe(axes, np.array([[0.3, 0.6, 0.5], [0.4, 0.5, 0.5]]), np.array([[0.5, 0.3, 0.2], [0.2, 0.0, 0.8]]), 3.0)
    draws = lobes.draw(np.random.default_rng(5).random((2, SAMPLES, 3)))
    assert draws.shape == (2, SAMPLES, 3)
    # Steep lobes: integrate over cells four times as fine, and sum.
    fine = SphereCells(24 * 4, 12 * 4)
    density = lobes.density(np.broadcast_to(fine.directions, (2, *fine.directions.shape)))
    for query in range(2):
        shares = fine.integrate(density[query]).reshape(24, 4, 12, 4).sum(axis=(1, 3)).ravel()
        assert_counts_follow(cells.count(draws[query]), shares)


def test_one_lobe_about_the_normal_equals_the_plain_functions() -> None:
    normals, numbers, sigma = unit(5), RNG.random((5, 2, 3)), RNG.uniform(0.1, 2.0, 5)
    lobes = Lobe(normals[:, None], sigma[:, None], np.ones((5, 1)), 2.0)
    draws = lobes.draw(numbers)
    np.testing.assert_array_equal(draws[:, 1], lobe.draw(sigma, 2.0, numbers[:, 1], normals))
    cosine = np.einsum("nsk,nk->ns", draws, normals)
    np.testing.assert_allclose(lobes.density(draws), lobe.density(sigma[:, None], 2.0, cosine), rtol=1e-12)


@pytest.mark.parametrize(
    ("sigma", "shape", "share"), [(0.0, 2, 0.1), (math.nan, 2, 0.1), (1.0, 0, 0.1), (1, 2, 0), (1, 2, 1.5)]
)
def test_invalid_lobes_are_refused(sigma: float, shape: float, share: float) -> None:
    with pytest.raises(QueryError, match="lobe"):
        lobe.density([sigma, 1.0], shape, [0.5, 0.5], share)
