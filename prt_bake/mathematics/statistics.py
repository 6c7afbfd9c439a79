"""Moments that merge without loss of digits, and the error figures that the whole product reports."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from formats.errors import QueryError

BLOCK_ELEMENTS = 1 << 20  # float64 temporaries of the error figures stay near 8 MiB each


@dataclass(frozen=True)
class Moments:
    """Count, mean and sums of central powers of samples; every field is an array of one shape, one entry a quantity.

    `m2`, `m3` and `m4` are Σ (x − mean)^p. Means and sums of disjoint samples merge to rounding (`merge`), whatever
    their sizes and offsets. Source: Pébay, "Formulas for robust, one-pass parallel computation of covariances and
    arbitrary-order statistical moments", Sandia report SAND2008-6212 (2008).
    """

    count: NDArray[np.float64]
    mean: NDArray[np.float64]
    m2: NDArray[np.float64]
    m3: NDArray[np.float64]
    m4: NDArray[np.float64]

    @property
    def variance(self) -> NDArray[np.float64]:
        """Unbiased variance of one sample, m2 / (count − 1); NaN below two samples."""
        return _ratio(self.m2, self.count - 1)

    @property
    def standard_error(self) -> NDArray[np.float64]:
        """One sigma of the mean, sqrt(variance / count); NaN below two samples."""
        return np.sqrt(_ratio(self.variance, self.count))

    @property
    def skewness(self) -> NDArray[np.float64]:
        """Third standardised moment, √count m3 / m2^1.5 (0 for a normal distribution); NaN if all are equal."""
        return _ratio(np.sqrt(self.count) * self.m3, self.m2**1.5)

    @property
    def kurtosis(self) -> NDArray[np.float64]:
        """Fourth standardised moment, count m4 / m2² (3 for a normal distribution); NaN if all are equal."""
        return _ratio(self.count * self.m4, self.m2**2)


def moments(samples: ArrayLike, axis: int = 0) -> Moments:
    """Moments of `samples` over `axis`, in float64. Raises QueryError if there is not one sample."""
    values = np.asarray(samples, dtype=np.float64)
    if values.ndim == 0 or values.shape[axis] == 0:
        raise QueryError(f"moments: expected at least one sample on axis {axis}, found shape {list(values.shape)}")
    mean = values.mean(axis=axis)
    centred = values - np.expand_dims(mean, axis)
    # What rounding left of the first central moment improves the mean.
    mean = mean + centred.mean(axis=axis)
    centred = values - np.expand_dims(mean, axis)
    squares = centred * centred
    return Moments(
        count=np.full_like(mean, values.shape[axis]),
        mean=mean,
        m2=squares.sum(axis=axis),
        m3=(squares * centred).sum(axis=axis),
        m4=(squares * squares).sum(axis=axis),
    )


def empty(shape: tuple[int, ...] = ()) -> Moments:
    """Moments of no samples, the neutral element of `merge`: every field is zero, of `shape`."""
    return Moments(*(np.zeros(shape) for _ in range(5)))


def merge(first: Moments, second: Moments) -> Moments:
    """Moments of two disjoint samples together, entry by entry; shapes broadcast."""
    a, b = first.count, second.count
    total = a + b
    # Two empty samples merge to an empty one.
    share = b / np.where(total > 0, total, 1)
    rest = np.where(total > 0, 1 - share, 0)
    delta = second.mean - first.mean
    squared = delta * delta
    return Moments(
        count=total,
        mean=first.mean + share * delta,
        m2=first.m2 + second.m2 + a * share * squared,
        m3=first.m3
        + second.m3
        + a * share * (rest - share) * squared * delta
        + 3 * delta * (rest * second.m2 - share * first.m2),
        m4=first.m4
        + second.m4
        + a * share * (rest * rest - rest * share + share * share) * squared * squared
        + 6 * squared * (rest * rest * second.m2 + share * share * first.m2)
        + 4 * delta * (rest * second.m3 - share * first.m3),
    )


@dataclass(frozen=True)
class RelativeError:
    """Relative RMSE over everything, the same ratio of each vertex, and the 95th percentile of those."""

    total: float
    percentile_95: float
    per_vertex: NDArray[np.float64]


class Sliced(Protocol):
    """An array or an open dataset whose first axis is V: it has a shape and gives slices of vertices."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Length of every axis."""

    def __getitem__(self, vertices: slice) -> ArrayLike: ...


def relative_rmse(estimate: Sliced, reference: Sliced, valid: ArrayLike | None = None) -> RelativeError:
    """sqrt(Σ|â − a|² / Σ|a|²) of coefficients over all axes, and the 95th percentile over vertices of the ratio per
    vertex.

    `estimate` and `reference` are [V, …], most often [V, B, K, C]; shortened axes of length 1 broadcast. They may be
    open datasets: vertices are read block by block, sums are float64. `valid` [V] leaves out the vertices where it is
    false or 0. A vertex whose reference is 0 everywhere counts as 0 if the estimate is 0 too, otherwise as infinite.
    The percentile is the smallest ratio that at least 95 % of the vertices do not exceed. Raises QueryError if the
    shapes do not broadcast, or if no vertex is left.
    """
    vertices = _common_vertices(estimate, reference)
    chosen = np.ones(vertices, dtype=bool) if valid is None else np.asarray(valid).astype(bool)
    if chosen.shape != (vertices,):
        raise QueryError(f"relative error: expected `valid` of shape [{vertices}], found {list(chosen.shape)}")
    if not chosen.any():
        raise QueryError("relative error: expected at least one valid vertex, found none")
    squared_error, squared_reference = np.zeros(vertices), np.zeros(vertices)
    shape = np.broadcast_shapes(estimate.shape, reference.shape)
    step = max(1, BLOCK_ELEMENTS * vertices // max(1, int(np.prod(shape))))
    for start in range(0, vertices, step):
        block = slice(start, min(start + step, vertices))
        found, expected = np.broadcast_arrays(
            np.asarray(estimate[block], dtype=np.float64), np.asarray(reference[block], dtype=np.float64)
        )
        inner = tuple(range(1, expected.ndim))
        squared_error[block] = ((found - expected) ** 2).sum(axis=inner)
        squared_reference[block] = (expected**2).sum(axis=inner)
    per_vertex = np.sqrt(_error_ratio(squared_error[chosen], squared_reference[chosen]))
    total = np.sqrt(_error_ratio(squared_error[chosen].sum(), squared_reference[chosen].sum()))
    rank = int(np.ceil(0.95 * len(per_vertex))) - 1
    return RelativeError(float(total), float(np.sort(per_vertex)[rank]), per_vertex)


def _common_vertices(estimate: Sliced, reference: Sliced) -> int:
    shapes = f"estimate {list(estimate.shape)} and reference {list(reference.shape)}"
    if len(estimate.shape) != len(reference.shape) or not estimate.shape or estimate.shape[0] != reference.shape[0]:
        raise QueryError(f"relative error: expected arrays over the same axes and vertices, found {shapes}")
    try:
        np.broadcast_shapes(estimate.shape, reference.shape)
    except ValueError as error:
        raise QueryError(f"relative error: expected axes that are equal or 1, found {shapes}") from error
    return estimate.shape[0]


def _error_ratio(squared_error: NDArray[np.float64], squared_reference: NDArray[np.float64]) -> NDArray[np.float64]:
    no_reference = squared_reference == 0
    ratio = squared_error / np.where(no_reference, 1, squared_reference)
    return np.where(no_reference, np.where(squared_error == 0, 0, np.inf), ratio)


def _ratio(numerator: NDArray[np.float64], denominator: NDArray[np.float64]) -> NDArray[np.float64]:
    defined = denominator > 0
    return np.where(defined, numerator / np.where(defined, denominator, 1), np.nan)
