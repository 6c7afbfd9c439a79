"""Calibration: standard errors are correct bounds, and the distribution of vertices' errors is as stated."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from bakers.adaptive.calibration import Correction, Tally
from bakers.adaptive.records import METHODS, RefinedBlock, ValidationSamples
from bakers.adaptive.vertex_scatter import (
    CORRELATED_VARIANCE,
    INDEPENDENT_VARIANCE,
    UNKNOWN,
    Scatter,
    error_quantiles,
    measured_scatter,
)
from bakers.error_covariance import unknown_covariance
from prt_bake import bake
from tests.bakers.transports import Lobed, icosphere

Array = NDArray[np.float64]
NUMBERS, COUNT = 27, 20_000


def samples_of(errors: Array, noise: float, seed: int) -> tuple[Array, Array]:
    """`squared` and `noise` of validation samples with that noise, for errors [M,27]."""
    random = np.random.default_rng(seed)
    one, other = (errors + noise * random.normal(size=errors.shape) for _half in range(2))
    return (one * other).mean(axis=1), (one**2 - other**2).mean(axis=1) / 2.0


def tally_of(stated: Array, squared: Array, noise: Array, vertices: NDArray[np.int64], correlated: float) -> Tally:
    """A bake of one bin per vertex with validation samples at the bins of `vertices` [M]."""
    count = int(vertices.max()) + 1
    tally = Tally(count)
    samples = ValidationSamples(
        vertices, np.full(len(stated), METHODS.index("alone"), np.uint8), stated, squared, noise, 0
    )
    one, rows = np.ones((count, 1), np.float32), np.arange(count)
    method, share = np.full((count, 1), METHODS.index("alone"), np.uint8), np.full(count, correlated, np.float32)
    coefficients = np.ones((count, 1, 9, 3), np.float32)
    shape = unknown_covariance(count, 9)
    shapes = shape.covariance, shape.channels, shape.apart
    tally.add(rows, RefinedBlock(coefficients, one, one.astype(np.uint16), method, share, *shapes, 0, 0, samples))
    return tally


@pytest.mark.parametrize("noise", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("shape", [0.5, 2.0, 20.0])
def test_bounds_hold_95_percent_whatever_the_noise_of_the_samples(noise: float, shape: float) -> None:
    """Errors of the size of the samples' noise, alike from bin to bin or not: 94 to 97 % are within the bound. Bounds
    that take that noise for error hold up to 99 %.
    """
    random = np.random.default_rng(1)
    size = random.gamma(shape, 1.0 / shape, COUNT)
    errors = np.sqrt(size)[:, None] * random.normal(size=(COUNT, NUMBERS))
    squared, noises = samples_of(errors, noise, 2)
    stated = np.ones(COUNT)
    correction = tally_of(stated, squared, noises, np.arange(COUNT), 0.0).correction(Correction())
    method = np.full(COUNT, METHODS.index("alone"))
    bound = 1.96 * correction.standard_error(stated.astype(np.float32), method)
    within = (np.sqrt((errors**2).mean(axis=1)) <= bound).mean()
    assert correction.own_lattice == pytest.approx(1.0, abs=0.05)
    assert 0.94 < within < 0.97


def test_bins_with_errors_far_below_the_noise_do_not_affect_bounds() -> None:
    """Validation samples are equally noisy at all bins of a vertex; they do not measure an error of a thousandth of
    that noise.
    """
    random = np.random.default_rng(6)
    stated = np.where(np.arange(COUNT) % 2 == 0, 1.0, 1e-6)
    errors = np.sqrt(stated)[:, None] * random.normal(size=(COUNT, NUMBERS))
    squared, noises = samples_of(errors, 0.5, 7)
    correction = tally_of(stated, squared, noises, np.arange(COUNT), 0.0).correction(Correction())
    within = (np.sqrt((errors**2).mean(axis=1)) <= 1.96 * correction.bound * np.sqrt(stated)).mean()
    assert correction.own_lattice == pytest.approx(1.0, abs=0.05)
    assert 0.94 < within < 0.97


def test_the_noise_has_the_variance_of_the_noise_in_the_square() -> None:
    errors = np.random.default_rng(0).normal(size=(1, NUMBERS)) * np.ones((COUNT, 1))
    squared, noise = samples_of(errors, 1.3, 3)
    # The standard error of a variance of COUNT numbers with some kurtosis is about 1.5 %; allow four of them.
    assert noise.var() == pytest.approx(squared.var(), rel=0.06)
    assert abs(noise.mean()) < 4.0 * noise.std() / np.sqrt(COUNT)


@pytest.mark.parametrize("variance", [0.0, 0.3, 1.0])
def test_the_scatter_of_vertices_is_measured_from_several_samples_of_each(variance: float) -> None:
    random = np.random.default_rng(4)
    vertices = np.repeat(np.arange(2000), 4)
    common = random.gamma(1.0 / variance, variance, 2000) if variance else np.ones(2000)
    errors = np.sqrt(common[vertices])[:, None] * random.normal(size=(len(vertices), NUMBERS))
    squared, _noise = samples_of(errors, 0.7, 5)
    found = measured_scatter(vertices, np.ones(len(vertices)), squared, 0.3)
    assert found.measured == pytest.approx(variance, abs=0.1)
    assert found.weight > 0.9


def test_few_samples_leave_the_default() -> None:
    assert measured_scatter(np.arange(50), np.ones(50), np.ones(50), 0.3) == UNKNOWN
    assert measured_scatter(np.zeros(0, np.int64), np.zeros(0), np.zeros(0), 0.3) == UNKNOWN
    random = np.random.default_rng(6)
    assert measured_scatter(np.repeat([0, 1], 2), np.ones(4), random.gamma(0.3, 3.0, 4), 0.3).weight < 0.5
    np.testing.assert_allclose(
        UNKNOWN.variance(np.array([0.0, 1.0])), [INDEPENDENT_VARIANCE, INDEPENDENT_VARIANCE + CORRELATED_VARIANCE]
    )
    np.testing.assert_allclose(Scatter(0.2, 1.0).variance(np.array([0.0, 1.0])), 0.2)


@pytest.mark.parametrize("variance", [0.01, 0.2, 1.0])
def test_error_quantiles_are_those_of_chi_square(variance: float) -> None:
    found = np.percentile(error_quantiles(np.full(4000, 2.0), np.full(4000, variance)), [50, 90, 95])
    freedom = 2.0 / variance
    expected = 2.0 * np.sqrt(stats.chi2.ppf([0.5, 0.9, 0.95], freedom) / freedom)
    np.testing.assert_allclose(found, expected, rtol=0.04)


def test_the_percentile_allows_for_different_vertices() -> None:
    """The error of each vertex has its own factor; the 95th percentile allows for it once samples have measured it."""
    random = np.random.default_rng(7)
    vertices = np.repeat(np.arange(1000), 6)
    common = random.gamma(1.0, 1.0, 1000)
    squared, noise = samples_of(
        0.01 * np.sqrt(common[vertices])[:, None] * random.normal(size=(6000, NUMBERS)), 0.005, 8
    )
    tally = tally_of(np.full(6000, 1e-4), squared, noise, vertices, 0.0)
    tally.variance[METHODS.index("alone")] = 1e-4
    correction = tally.correction(Correction())
    total, worst = tally.relative(correction)
    assert total == pytest.approx(0.01, rel=0.05)
    assert worst == pytest.approx(0.01 * np.percentile(np.sqrt(common), 95), rel=0.1)
    assert tally.relative(Correction())[1] < 0.8 * worst


@pytest.mark.statistics
@pytest.mark.parametrize("error", [0.01, 0.05])
def test_percentiles_of_a_bake_are_accurate(error: float) -> None:
    from tests.bakers.transports import exact

    mesh, transport = icosphere(1), Lobed()
    asset = bake(transport, mesh, error=error)
    truth = exact(transport, mesh, 16, 64, directions=1024)
    relative = ((asset.coefficients - truth) ** 2).sum(axis=(1, 2, 3)) / (truth**2).sum(axis=(1, 2, 3))
    reported = asset.provenance["estimated_relative_rmse"]["percentile_95_over_vertices"]
    assert 0.75 < reported / np.sqrt(np.percentile(relative, 95)) < 1.35
