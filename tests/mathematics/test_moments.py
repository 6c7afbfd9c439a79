"""Moments, errors and ratios from sums agree with exact rational arithmetic, however small the deviations are."""

from fractions import Fraction

import numpy as np
import pytest

from prt_bake.mathematics.moments import SUMS, Moments, from_sums, merged
from prt_bake.mathematics.noise_free import Replicates, ratio
from prt_bake.rendering.state import Sums

Array = np.ndarray
LENGTHS = (1, 7, 64, 928)
"""Values of each part of a sample."""


def series(deviations: float, count: int = sum(LENGTHS)) -> Array:
    """Skewed values whose mean is that many standard deviations."""
    drawn = np.random.default_rng(7).exponential(size=count)
    return np.asarray(deviations + drawn)


def sums_of(values: Array) -> Array:
    """As the kernels sum."""
    sums = np.zeros(SUMS)
    sums[0] = values[0]
    for value in values:
        sums[1:] += (value - sums[0]) ** np.arange(1, SUMS)
    return sums


def exact(values: Array) -> list[float]:
    """Mean and central moments by rational arithmetic."""
    rational = [Fraction(float(value)) for value in values]
    mean = sum(rational) / len(rational)
    return [float(mean), *(float(sum((x - mean) ** k for x in rational) / len(rational)) for k in (2, 3, 4))]


@pytest.mark.parametrize("deviations", [0.0, 1.0, 1e3, 1e6, 1e9, 1e12])
def test_moments_of_a_sample_in_parts_are_exact(deviations: float) -> None:
    values = series(deviations)
    parts = np.split(values, np.cumsum(LENGTHS)[:-1])
    of_parts = from_sums(np.stack([sums_of(part) for part in parts], axis=1), np.array(LENGTHS))
    found = merged(of_parts, np.array(LENGTHS), axis=0)
    # A mean of 1e12 deviations is itself rounded to 1e-4 of a deviation.
    np.testing.assert_allclose(found, exact(values), rtol=max(1e-11, 1e-15 * deviations))


def test_a_sample_that_begins_with_its_outlier_keeps_its_moments() -> None:
    values = np.concatenate([[1e6], series(1.0)])
    np.testing.assert_allclose(from_sums(sums_of(values), len(values)), exact(values), rtol=1e-11)


def test_equal_values_have_no_variance() -> None:
    of_parts = from_sums(np.stack([sums_of(np.full(count, 1.0 / 3.0)) for count in LENGTHS], axis=1), np.array(LENGTHS))
    mean, *central = merged(of_parts, np.array(LENGTHS), axis=0)
    assert mean == 1.0 / 3.0
    np.testing.assert_array_equal(central, 0.0)


def test_raw_moments_are_those_of_the_values() -> None:
    values = series(2.0)
    found = Moments(*(np.asarray(part) for part in exact(values))).raw()
    np.testing.assert_allclose(found, [np.mean(values**k) for k in (2, 3, 4)], rtol=1e-12)


@pytest.mark.parametrize("deviations", [1.0, 1e6, 1e12])
def test_the_error_of_a_picture_is_that_of_its_passes(deviations: float) -> None:
    values = series(deviations, 64)
    sums = Sums.empty(1, 1)
    for value in values:
        sums.add(slice(0, 1), np.full((1, 1, 3), value), np.ones((1, 1)))
        sums.passes += 1
    expected = np.sqrt(exact(values)[1] / 63)
    np.testing.assert_allclose(sums.standard_error(), expected, rtol=max(1e-11, 1e-15 * deviations))


@pytest.mark.parametrize("deviations", [1.0, 1e6, 1e12])
def test_replicates_keep_the_variance_of_nearly_equal_estimates(deviations: float) -> None:
    values = series(deviations, 64)
    replicates = Replicates.empty(())
    for value in values:
        replicates.add(value)
    np.testing.assert_allclose(replicates.variance, exact(values)[1] / 63, rtol=max(1e-11, 1e-15 * deviations))


@pytest.mark.parametrize("deviations", [1e3, 1e6, 1e9])
def test_the_interval_of_a_nearly_constant_ratio_has_the_width_of_its_deviations(deviations: float) -> None:
    """Numerators of 1 + x / deviations: the interval of the ratio, times the deviations, is that of the mean of x."""
    denominators, x = np.ones(64), series(0.0, 64)
    plain = ratio(x, denominators, 0)
    shifted = ratio(1.0 + x / deviations, denominators, 0)
    for bound in ("value", "low", "high"):
        found = (getattr(shifted, bound) - 1.0) * deviations
        assert found == pytest.approx(getattr(plain, bound), rel=1e-15 * deviations + 1e-9)
