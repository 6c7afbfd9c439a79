"""Error figures relative to a noisy reference, without the bias of its noise, and with confidence intervals.

The reference is the mean m of R independent, equal estimates, and v is the unbiased variance of m. Then (f − m)² − v
has the expectation (f − t)² for any distribution of the estimates, t being the truth, and m² − v has t². Sums over
positions (clusters) are independent of one another, so a bootstrap over clusters gives intervals.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from formats.errors import QueryError

Array = NDArray[np.float64]

LEVEL = 0.95
_RESAMPLES = 1000
_FEWEST = 8
"""Fewer clusters than this give no interval."""
_ROUNDING = 1e-14
"""A variance below this share of the sums that it is a difference of is 0."""


@dataclass(frozen=True)
class Interval:
    """A figure and its 95 % confidence interval, which is NaN for too few clusters, or if one of them is all of it."""

    value: float
    low: float
    high: float

    def as_json(self) -> dict[str, float]:
        """As plain values."""
        return {"value": self.value, "low": self.low, "high": self.high}

    @classmethod
    def from_json(cls, values: Mapping[str, float | None]) -> "Interval":
        """Read what `as_json` returns, in which JSON has null in place of NaN."""
        value, low, high = (np.nan if (part := values[name]) is None else part for name in ("value", "low", "high"))
        return cls(value, low, high)

    @property
    def is_bound(self) -> bool:
        """Whether the value is only the upper end of the interval, because noise hides what it is."""
        return self.low == 0.0 < self.value == self.high

    def or_bound(self) -> "Interval":
        """The same, with the upper end as value if the value is 0."""
        return Interval(self.high, 0.0, self.high) if self.value == 0.0 < self.high else self

    def within(self, bound: float) -> str:
        """Whether |truth| is at most `bound`: "met", "not met", or "undecided" if the interval contains both cases."""
        largest = max(abs(self.low), abs(self.high))
        least = 0.0 if self.low <= 0.0 <= self.high else min(abs(self.low), abs(self.high))
        if not np.isfinite(largest):
            return "undecided"
        return "met" if largest <= bound else "not met" if least > bound else "undecided"


@dataclass
class Replicates:
    """Running mean and variance of independent, equal estimates of one array."""

    count: int
    mean: Array
    squares: Array
    """Σ (estimate − mean)²."""

    @classmethod
    def empty(cls, shape: tuple[int, ...]) -> "Replicates":
        """No estimates yet."""
        return cls(0, np.zeros(shape), np.zeros(shape))

    def add(self, estimate: ArrayLike) -> None:
        """Add one estimate."""
        self.count += 1
        difference = np.asarray(estimate, np.float64) - self.mean
        self.mean = self.mean + difference / self.count
        self.squares = self.squares + difference**2 * (1.0 - 1.0 / self.count)

    @property
    def variance(self) -> Array:
        """Unbiased variance of the mean. Raises QueryError for fewer than two estimates."""
        if self.count < 2:
            raise QueryError(f"replicates: expected at least 2 to estimate the noise, found {self.count}")
        return np.asarray(self.squares / (self.count * (self.count - 1)))


@dataclass(frozen=True)
class Sums:
    """Sums [N] over each of N clusters: squared error and squared value without noise, and the variance of the
    noise.
    """

    error: Array
    value: Array
    noise: Array

    def select(self, chosen: Any) -> "Sums":
        """The sums of some clusters."""
        return Sums(self.error[chosen], self.value[chosen], self.noise[chosen])


def sums(answer: ArrayLike, reference: Replicates) -> Sums:
    """Sums of `answer` [N,…] relative to a reference of the same shape, over all axes but the first."""
    found, variance = np.asarray(answer, np.float64), reference.variance
    inner = tuple(range(1, found.ndim))
    return Sums(
        error=np.asarray(((found - reference.mean) ** 2 - variance).sum(axis=inner)),
        value=np.asarray((reference.mean**2 - variance).sum(axis=inner)),
        noise=np.asarray(variance.sum(axis=inner)),
    )


def relative_rmse(clusters: Sums, seed: int) -> Interval:
    """sqrt(Σ error / Σ value); 0 if the error is below the noise."""
    return _root(ratio(clusters.error, clusters.value, seed))


def relative_noise(clusters: Sums) -> float:
    """sqrt(Σ noise / Σ value): relative noise of the reference; NaN if its values are no larger than their noise."""
    value = float(clusters.value.sum())
    return float(np.sqrt(clusters.noise.sum() / value)) if value > 0.0 else np.nan


def ratio(numerator: Array, denominator: Array, seed: int) -> Interval:
    """Σ numerator / Σ denominator over N independent clusters.

    The interval is that of the studentised bootstrap (Efron and Tibshirani 1993, section 12.5). It is asymmetric for
    skewed errors, for which plain intervals miss the truth twice as often as stated. It has no bounds if a resample
    without a few clusters has no spread left.
    """
    a, b = np.asarray(numerator, np.float64), np.asarray(denominator, np.float64)
    count = len(a)
    value = float(a.sum() / b.sum()) if count and b.sum() > 0.0 else np.nan
    if count < _FEWEST or not np.isfinite(value):
        return Interval(value, np.nan, np.nan)
    # Residuals have the spread of the ratio itself, so that no digits cancel where it is nearly constant.
    rest = a - value * b
    powers = np.stack([rest, b, rest * rest, rest * b, b * b], axis=1)
    own, error = _studentised(powers.sum(axis=0), count)
    if not error > 0.0:
        return Interval(value, value, value)
    resampled, errors = _studentised(_multiplicities(count, seed) @ powers, count)
    with np.errstate(invalid="ignore", divide="ignore"):
        t = (resampled - own) / errors
        low, high = np.quantile(t[~np.isnan(t)], [0.5 - 0.5 * LEVEL, 0.5 + 0.5 * LEVEL])
    if not (np.isfinite(low) and np.isfinite(high)):
        return Interval(value, np.nan, np.nan)
    return Interval(value, float(value - high * error), float(value - low * error))


def percentile_over(error: Array, value: Array, seed: int, share: float = 0.95) -> tuple[Interval, float]:
    """The percentile over P positions of sqrt(Σ error / Σ value) at each, corrected for noise, and uncorrected.

    error, value: [P,B], from B independent samples per position, unbiased but noisy. This noise widens the distribution
    over positions. The squared ratios are therefore contracted towards their mean until their variance is that of the
    positions alone (Louis 1984, constrained empirical Bayes). NaN if a position's value is no larger than its noise.
    """
    samples = error.shape[1]
    if samples < 2:
        raise QueryError(f"percentile over positions: expected at least 2 samples per position, found {samples}")
    mean = value.mean(axis=1)
    if not (mean > 0.0).all():
        return Interval(np.nan, np.nan, np.nan), np.nan
    squared = error.mean(axis=1) / mean
    variance = ((error - squared[:, None] * value) ** 2).sum(axis=1) / (samples * (samples - 1)) / mean**2

    def corrected(chosen: Any) -> Array:
        return _percentile(_contracted(squared[chosen], variance[chosen]), share)

    return _resampled(corrected, len(squared), seed), float(_percentile(squared, share))


def percentile_of_length(vectors: Array, variance: Array, seed: int, share: float = 0.95) -> tuple[Interval, float]:
    """The percentile over P positions of |d|, d [P,C] with variance [P,C]; corrected as in `percentile_over`, and
    uncorrected.
    """

    def corrected(chosen: Any) -> Array:
        drawn = np.moveaxis(vectors[chosen], -1, 0)
        noise = np.moveaxis(variance[chosen], -1, 0).mean(axis=0)
        mean = drawn.mean(axis=-1, keepdims=True)
        spread = drawn.var(axis=-1, ddof=1).mean(axis=0)
        scale = np.sqrt(_signal_share(noise.mean(axis=-1), spread))[..., None]
        return _percentile(((mean + scale * (drawn - mean)) ** 2).sum(axis=0), share)

    return _resampled(corrected, len(vectors), seed), float(_percentile((vectors**2).sum(axis=1), share))


def _resampled(statistic: Any, count: int, seed: int) -> Interval:
    value = float(statistic(np.arange(count)))
    if count < _FEWEST:
        return Interval(value, np.nan, np.nan)
    drawn = np.random.default_rng(seed).integers(0, count, (_RESAMPLES, count))
    low, high = np.quantile(statistic(drawn), [0.5 - 0.5 * LEVEL, 0.5 + 0.5 * LEVEL])
    return Interval(value, float(low), float(high))


def _multiplicities(count: int, seed: int) -> Array:
    """Multiplicity of each cluster in each bootstrap resample [_RESAMPLES, count]."""
    drawn = np.random.default_rng(seed).integers(0, count, (_RESAMPLES, count))
    indices = drawn + count * np.arange(_RESAMPLES)[:, None]
    times = np.bincount(indices.ravel(), minlength=_RESAMPLES * count)
    return times.reshape(_RESAMPLES, count).astype(np.float64)


def _contracted(values: Array, variance: Array) -> Array:
    """Values [..., P] contracted towards their mean until the noise `variance` [..., P] is gone from their variance."""
    mean = values.mean(axis=-1, keepdims=True)
    signal = _signal_share(variance.mean(axis=-1), values.var(axis=-1, ddof=1))
    return np.asarray(mean + np.sqrt(signal)[..., None] * (values - mean))


def _signal_share(noise: Array, spread: Array) -> Array:
    """Share of the variance `spread` that is not noise."""
    return np.asarray(np.maximum(0.0, 1.0 - noise / np.maximum(spread, 1e-300)))


def _percentile(squared: Array, share: float) -> Array:
    return np.asarray(np.sqrt(np.maximum(0.0, np.quantile(squared, share, axis=-1, method="median_unbiased"))))


def _studentised(totals: Array, count: int) -> tuple[Any, Any]:
    """Ratio Σa / Σb and its standard error from Σ (a, b, a², ab, b²) [...,5]."""
    a, b, aa, ab, bb = np.moveaxis(totals, -1, 0)
    value = a / b
    variance = aa - 2.0 * value * ab + value**2 * bb
    variance = np.where(variance > _ROUNDING * (aa + value**2 * bb), variance, 0.0)
    return value, np.sqrt(variance * count / (count - 1)) / b


def _root(squared: Interval) -> Interval:
    value, low, high = (float(np.sqrt(max(0.0, x))) if np.isfinite(x) else np.nan for x in vars(squared).values())
    return Interval(value, low, high)
