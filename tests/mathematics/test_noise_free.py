"""Error figures relative to a noisy reference are unbiased, and their intervals have the stated coverage.

No path tracing here. Coverages over repeated trials are compared with binomial bounds. With random seeds each bound
would fail a correct figure with probability FALSE_ALARM.
"""

import numpy as np
import pytest
from scipy.stats import binom, norm

from formats.errors import QueryError
from prt_bake.mathematics.noise_free import (
    Interval,
    Replicates,
    Sums,
    percentile_of_length,
    percentile_over,
    ratio,
    relative_noise,
    relative_rmse,
    sums,
)

FALSE_ALARM = 1e-5


def noisy_reference(truth: np.ndarray, noise: float, batches: int, generator: np.random.Generator) -> Replicates:
    """Estimates with skewed noise proportional to the value, as of walks; `noise` is the relative one of their mean."""
    reference = Replicates.empty(truth.shape)
    for _ in range(batches):
        drawn = generator.exponential(size=truth.shape) - 1.0
        reference.add(truth * (1.0 + noise * np.sqrt(batches) * drawn))
    return reference


def test_replicates_give_mean_and_variance_of_the_mean() -> None:
    estimates = np.random.default_rng(1).exponential(size=(9, 4, 3)) + 100.0
    reference = Replicates.empty((4, 3))
    for estimate in estimates:
        reference.add(estimate)
    np.testing.assert_allclose(reference.mean, estimates.mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(reference.variance, estimates.var(axis=0, ddof=1) / 9, rtol=1e-9)


def test_one_replicate_gives_no_variance() -> None:
    reference = Replicates.empty((2,))
    reference.add([1.0, 2.0])
    with pytest.raises(QueryError, match="expected at least 2 to estimate the noise, found 1"):
        _ = reference.variance


@pytest.mark.parametrize("error", [0.0, 0.02, 0.05])
def test_error_is_unbiased_even_if_the_noise_exceeds_it(error: float) -> None:
    generator = np.random.default_rng(2)
    truth = generator.exponential(size=(256, 12))
    found = []
    for _ in range(60):
        clusters = sums(truth * (1.0 + error), noisy_reference(truth, 0.05, 8, generator))
        found.append(clusters.error.sum() / clusters.value.sum())
    off = np.mean(found) - error**2
    assert abs(off) < norm.isf(FALSE_ALARM / 2) * np.std(found, ddof=1) / np.sqrt(len(found))
    # The trials are precise enough to detect uncorrected noise.
    assert np.std(found, ddof=1) / np.sqrt(len(found)) < 0.05**2 / 20
    assert relative_noise(clusters) == pytest.approx(0.05, rel=0.1)


@pytest.mark.parametrize("spread", [0.3, 1.0])
def test_intervals_of_the_relative_rmse_cover_the_truth(spread: float) -> None:
    """At least 90 of 100 if few queries dominate the error (spread 1: the log of a query's error has this
    deviation).
    """
    generator, trials = np.random.default_rng(3), 250
    true = 0.05 * np.exp(spread**2 / 4)
    covered = 0
    for trial in range(trials):
        value = np.exp(0.5 * generator.normal(size=256))
        error = 0.05**2 * np.exp(0.125 + spread * generator.normal(size=256))
        noise = 0.03**2 * generator.normal(size=256) + 2 * 0.02 * np.sqrt(error) * generator.normal(size=256)
        interval = relative_rmse(Sums(error + noise, value, np.full(256, 0.03**2)), trial)
        covered += interval.low <= true <= interval.high
    least = 0.92 if spread < 0.5 else 0.9
    assert covered >= binom.ppf(FALSE_ALARM, trials, least)
    assert covered <= binom.isf(FALSE_ALARM, trials, 0.97)


def test_intervals_of_a_signed_ratio_cover_the_truth() -> None:
    generator, trials = np.random.default_rng(4), 250
    covered = 0
    for trial in range(trials):
        value = generator.gamma(2.0, size=128)
        interval = ratio(0.02 * value + 0.1 * generator.normal(size=128) * value, value, trial)
        covered += interval.low <= 0.02 <= interval.high
    assert binom.ppf(FALSE_ALARM, trials, 0.92) <= covered <= binom.isf(FALSE_ALARM, trials, 0.97)


@pytest.mark.parametrize("noise", [0.33, 1.0])
@pytest.mark.parametrize("variation", [0.35, 0.8])
def test_percentile_over_positions_excludes_the_noise(noise: float, variation: float) -> None:
    """Within 4 % on average, where noise raises the uncorrected one by up to 13 %; 87 of 100 intervals cover it."""
    generator, trials = np.random.default_rng(5), 60
    shape = variation**-2
    true = np.sqrt(np.quantile(generator.gamma(shape, 1 / shape, size=1_000_000), 0.95))
    values, plain, covered = [], [], 0
    for trial in range(trials):
        position = generator.gamma(shape, 1 / shape, size=(192, 1))
        strength = position * generator.exponential(size=(192, 8))
        difference = generator.normal(size=(192, 8, 8))
        difference *= np.sqrt(strength / (difference**2).sum(axis=2))[..., None]
        noisy = difference + noise / np.sqrt(8) * generator.normal(size=difference.shape)
        interval, uncorrected = percentile_over((noisy**2).sum(axis=2) - noise**2, np.ones((192, 8)), trial)
        values.append(interval.value)
        plain.append(uncorrected)
        covered += interval.low <= true <= interval.high
    assert np.mean(values) == pytest.approx(true, rel=0.04)
    assert np.mean(plain) > np.mean(values)
    assert covered >= binom.ppf(FALSE_ALARM, trials, 0.87)


def test_percentile_of_signed_errors_excludes_their_noise() -> None:
    generator = np.random.default_rng(6)
    true = np.quantile(np.abs(0.01 + 0.01 * generator.normal(size=1_000_000)), 0.95)
    values, plain = [], []
    for trial in range(40):
        error = 0.01 + 0.01 * generator.normal(size=(192, 1)) + 0.01 * generator.normal(size=(192, 1))
        interval, uncorrected = percentile_of_length(error, np.full((192, 1), 1e-4), trial)
        values.append(interval.value)
        plain.append(uncorrected)
    assert np.mean(values) == pytest.approx(true, rel=0.05)
    assert np.mean(plain) > 1.1 * true


def test_equal_positions_show_no_spread() -> None:
    generator = np.random.default_rng(7)
    samples = 1.0 + 0.5 * generator.normal(size=(192, 8))
    interval, uncorrected = percentile_over(samples, np.ones((192, 8)), 0)
    assert interval.value == pytest.approx(1.0, abs=0.1)
    assert uncorrected > 1.1


@pytest.mark.parametrize(
    ("interval", "expected"),
    [
        (Interval(0.01, 0.0, 0.02), "met"),
        (Interval(-0.01, -0.029, 0.02), "met"),
        (Interval(-0.05, -0.06, -0.04), "not met"),
        (Interval(0.03, 0.02, 0.04), "undecided"),
        (Interval(0.0, -0.04, 0.01), "undecided"),
        (Interval(0.01, np.nan, np.nan), "undecided"),
    ],
)
def test_bound_is_met_not_met_or_undecided(interval: Interval, expected: str) -> None:
    assert interval.within(0.03) == expected


def test_too_few_clusters_give_no_interval() -> None:
    interval = ratio(np.ones(3), np.ones(3), 0)
    assert interval.value == 1.0
    assert np.isnan(interval.low)


def test_exact_ratio_has_an_interval_of_no_width() -> None:
    values = np.arange(1.0, 33.0)
    interval = ratio(0.25 * values, values, 0)
    assert (interval.low, interval.high) == pytest.approx((0.25, 0.25), rel=1e-6)


def test_a_reference_without_signal_gives_no_relative_figures() -> None:
    none, noise = np.zeros((9, 2)), np.full((9, 2), 1e-3)
    for value in (none, -noise):
        clusters = Sums(noise.sum(axis=1), value.sum(axis=1), noise.sum(axis=1))
        assert np.isnan(relative_noise(clusters))
        assert np.isnan(relative_rmse(clusters, 0).value)
        interval, uncorrected = percentile_over(noise, value, 0)
        assert np.isnan([interval.value, interval.low, interval.high, uncorrected]).all()


@pytest.mark.parametrize("size", [1e-60, 1.0, 1e57])
def test_one_cluster_with_all_of_the_error_gives_no_interval(size: float) -> None:
    error = np.zeros(256)
    error[77] = size
    interval = ratio(error, np.ones(256), 0)
    assert interval.value == pytest.approx(size / 256, rel=1e-12)
    assert np.isnan([interval.low, interval.high]).all()


@pytest.mark.parametrize("value", [1.0, 0.1, 1e-60, 1e60, 0.0])
def test_equal_clusters_give_an_interval_without_width(value: float) -> None:
    interval = ratio(np.full(100, value), np.full(100, 0.3), 0)
    assert interval.low == interval.value == interval.high == pytest.approx(value / 0.3, rel=1e-12)
