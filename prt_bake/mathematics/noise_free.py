"""Error figures against a reference that is itself noisy: its noise taken out, each figure with its interval.

A reference is the mean of R independent, equal estimates. With m that mean and v the unbiased variance of it,
(f − m)² − v has the expectation (f − t)² whatever the estimates' distribution, t being the truth; m² − v has t².
Sums over whole positions (clusters) are independent of one another: intervals come from a bootstrap over them.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from formats.errors import QueryError

Array = NDArray[np.float64]

LEVEL = 0.95
_RESAMPLES = 1000
_FEWEST = 8
"""Clusters below which no interval is given."""


@dataclass(frozen=True)
class Interval:
    """A figure and the bounds that hold the truth 95 times in 100; NaN bounds where too few clusters are there."""

    value: float
    low: float
    high: float

    def as_json(self) -> dict[str, float]:
        """Plain values."""
        return {"value": self.value, "low": self.low, "high": self.high}

    def within(self, bound: float) -> str:
        """Whether |truth| is at most `bound`: "met", "not met", or "undecided" where the interval holds both."""
        largest = max(abs(self.low), abs(self.high))
        least = 0.0 if self.low <= 0.0 <= self.high else min(abs(self.low), abs(self.high))
        if not np.isfinite(largest):
            return "undecided"
        return "met" if largest <= bound else "not met" if least > bound else "undecided"


@dataclass
class Replicates:
    """Running mean and spread of independent, equal estimates of one array."""

    count: int
    mean: Array
    squares: Array
    """Σ (estimate − mean)²."""

    @classmethod
    def of(cls, shape: tuple[int, ...]) -> "Replicates":
        """No estimates yet."""
        return cls(0, np.zeros(shape), np.zeros(shape))

    def add(self, estimate: ArrayLike) -> None:
        """Take in one more estimate."""
        self.count += 1
        difference = np.asarray(estimate, np.float64) - self.mean
        self.mean = self.mean + difference / self.count
        self.squares = self.squares + difference**2 * (1.0 - 1.0 / self.count)

    @property
    def variance(self) -> Array:
        """Of the mean, without bias. Raises QueryError below two estimates."""
        if self.count < 2:
            raise QueryError(f"replicates: {self.count} where at least 2 are needed to tell the noise")
        return np.asarray(self.squares / (self.count * (self.count - 1)))


@dataclass(frozen=True)
class Sums:
    """Of N clusters: squared error without noise, squared value without noise, and the noise itself, [N] each."""

    error: Array
    value: Array
    noise: Array

    def of(self, chosen: Any) -> "Sums":
        """Those of some clusters."""
        return Sums(self.error[chosen], self.value[chosen], self.noise[chosen])


def sums(answer: ArrayLike, reference: Replicates) -> Sums:
    """Sums over every axis but the first of `answer` [N,…] against a reference of the same shape."""
    found, variance = np.asarray(answer, np.float64), reference.variance
    inner = tuple(range(1, found.ndim))
    return Sums(
        error=np.asarray(((found - reference.mean) ** 2 - variance).sum(axis=inner)),
        value=np.asarray((reference.mean**2 - variance).sum(axis=inner)),
        noise=np.asarray(variance.sum(axis=inner)),
    )


def relative_rmse(clusters: Sums, seed: int) -> Interval:
    """sqrt(Σ error / Σ value); 0 where the noise leaves nothing of the error."""
    return _root(ratio(clusters.error, clusters.value, seed))


def relative_noise(clusters: Sums) -> float:
    """sqrt(Σ noise / Σ value): how noisy the reference is."""
    return float(np.sqrt(clusters.noise.sum() / max(float(clusters.value.sum()), 1e-300)))


def ratio(numerator: Array, denominator: Array, seed: int) -> Interval:
    """Σ numerator / Σ denominator over N clusters, each drawn independently.

    The interval is the studentised bootstrap's (Efron and Tibshirani 1993, section 12.5): it leans to the long side of
    skewed errors, where plain ones miss the truth twice as often as they say.
    """
    a, b = np.asarray(numerator, np.float64), np.asarray(denominator, np.float64)
    count = len(a)
    value = float(a.sum() / b.sum()) if count and b.sum() > 0.0 else np.nan
    if count < _FEWEST or not np.isfinite(value):
        return Interval(value, np.nan, np.nan)
    powers = np.stack([a, b, a * a, a * b, b * b], axis=1)
    own, error = _studentised(powers.sum(axis=0), count)
    resampled, errors = _studentised(_times_drawn(count, seed) @ powers, count)
    with np.errstate(invalid="ignore", divide="ignore"):
        t = (resampled - own) / errors
    t = t[np.isfinite(t)]
    if not t.size:
        return Interval(value, value, value)
    low, high = np.quantile(t, [0.5 - 0.5 * LEVEL, 0.5 + 0.5 * LEVEL])
    return Interval(value, float(own - high * error), float(own - low * error))


def percentile_over(error: Array, value: Array, seed: int, share: float = 0.95) -> tuple[Interval, float]:
    """The percentile over P positions of sqrt(Σ error / Σ value) of each, and the same without a correction.

    error, value: [P,B], B independent looks at a position, each without noise on average but scattering. Their
    scattering widens what the positions show; the squared ratios are drawn towards their mean until their variance is
    that of the positions alone (Louis 1984, constrained empirical Bayes). The second figure leaves that out.
    """
    looks = error.shape[1]
    if looks < 2:
        raise QueryError(f"percentile over positions: {looks} looks at each where at least 2 are needed")
    whole = value.mean(axis=1)
    squared = error.mean(axis=1) / whole
    scatter = ((error - squared[:, None] * value) ** 2).sum(axis=1) / (looks * (looks - 1)) / whole**2

    def corrected(chosen: Any) -> Array:
        return _percentile(_contracted(squared[chosen], scatter[chosen]), share)

    return _resampled(corrected, len(squared), seed), float(_percentile(squared, share))


def percentile_of_length(vectors: Array, variance: Array, seed: int, share: float = 0.95) -> tuple[Interval, float]:
    """The percentile over P positions of |d|, d [P,C] known with a variance [P,C] each; corrected as
    `percentile_over`, and without.
    """

    def corrected(chosen: Any) -> Array:
        drawn = np.moveaxis(vectors[chosen], -1, 0)
        noise = np.moveaxis(variance[chosen], -1, 0).mean(axis=0)
        mean = drawn.mean(axis=-1, keepdims=True)
        spread = drawn.var(axis=-1, ddof=1).mean(axis=0)
        left = np.sqrt(_left(noise.mean(axis=-1), spread))[..., None]
        return _percentile(((mean + left * (drawn - mean)) ** 2).sum(axis=0), share)

    return _resampled(corrected, len(vectors), seed), float(_percentile((vectors**2).sum(axis=1), share))


def _resampled(statistic: Any, count: int, seed: int) -> Interval:
    value = float(statistic(np.arange(count)))
    if count < _FEWEST:
        return Interval(value, np.nan, np.nan)
    drawn = np.random.default_rng(seed).integers(0, count, (_RESAMPLES, count))
    low, high = np.quantile(statistic(drawn), [0.5 - 0.5 * LEVEL, 0.5 + 0.5 * LEVEL])
    return Interval(value, float(low), float(high))


def _times_drawn(count: int, seed: int) -> Array:
    """How often each of the clusters is drawn in each resample [_RESAMPLES, count]."""
    drawn = np.random.default_rng(seed).integers(0, count, (_RESAMPLES, count))
    places = drawn + count * np.arange(_RESAMPLES)[:, None]
    times = np.bincount(places.ravel(), minlength=_RESAMPLES * count)
    return times.reshape(_RESAMPLES, count).astype(np.float64)


def _contracted(values: Array, variance: Array) -> Array:
    """Values [..., P] drawn towards their mean until their variance is what `variance` [..., P] does not explain."""
    mean = values.mean(axis=-1, keepdims=True)
    left = _left(variance.mean(axis=-1), values.var(axis=-1, ddof=1))
    return np.asarray(mean + np.sqrt(left)[..., None] * (values - mean))


def _left(noise: Array, spread: Array) -> Array:
    """The share of a variance that is not noise."""
    return np.asarray(np.maximum(0.0, 1.0 - noise / np.maximum(spread, 1e-300)))


def _percentile(squared: Array, share: float) -> Array:
    return np.asarray(np.sqrt(np.maximum(0.0, np.quantile(squared, share, axis=-1, method="median_unbiased"))))


def _studentised(totals: Array, count: int) -> tuple[Any, Any]:
    """Ratio and its standard error from Σ (a, b, a², ab, b²) [...,5]."""
    a, b, aa, ab, bb = np.moveaxis(totals, -1, 0)
    value = a / b
    variance = np.maximum(aa - 2.0 * value * ab + value**2 * bb, 0.0)
    return value, np.sqrt(variance * count / (count - 1)) / b


def _root(squared: Interval) -> Interval:
    value, low, high = (float(np.sqrt(max(0.0, x))) if np.isfinite(x) else np.nan for x in vars(squared).values())
    return Interval(value, low, high)
