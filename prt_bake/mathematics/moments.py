"""Central moments of samples, without the cancellation of raw power sums.

Sums of powers of the deviations from a value of the sample keep their digits, however small the deviations are beside
the mean. Parts of a sample are merged by the formulas of Pébay, "Formulas for Robust, One-Pass Parallel Computation of
Covariances and Arbitrary-Order Statistical Moments", 2008, section 3.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

SUMS = 5
"""Rows of sums: a value s of the sample, and Σ (x − s)^k for k from 1 to 4."""


class Moments(NamedTuple):
    """Mean and central moments E[(x − mean)²], E[(x − mean)³] and E[(x − mean)⁴] of samples, all of one shape."""

    mean: Array
    variance: Array
    third: Array
    fourth: Array

    def raw(self) -> tuple[Array, Array, Array]:
        """E[x²], E[x³] and E[x⁴]."""
        m = self.mean
        second = self.variance + m**2
        third = self.third + m * (3.0 * self.variance + m**2)
        return second, third, self.fourth + m * (4.0 * self.third + m * (6.0 * self.variance + m**2))


def from_sums(sums: ArrayLike, count: ArrayLike) -> Moments:
    """Moments [...] from sums [SUMS, ...] over `count` values.

    >>> values = 1e9 + np.array([0.0, 1.0, 2.0])
    >>> sums = [values[0], *(np.sum((values - values[0]) ** k) for k in range(1, 5))]
    >>> from_sums(sums, 3).mean.item(), round(from_sums(sums, 3).variance.item(), 12)
    (1000000001.0, 0.666666666667)
    """
    shift = np.asarray(sums)[0]
    d, second, third, fourth = np.asarray(sums)[1:] / count
    return Moments(
        shift + d,
        np.maximum(second - d**2, 0.0),
        third - 3.0 * d * second + 2.0 * d**3,
        np.maximum(fourth - 4.0 * d * third + 6.0 * d**2 * second - 3.0 * d**4, 0.0),
    )


def merged(parts: Moments, count: NDArray[np.integer], axis: int) -> Moments:
    """Moments of the union of samples along an axis of `parts`, of `count` values each (broadcasts with the parts)."""
    share = count / count.sum(axis=axis, keepdims=True)
    # Relative to the first part, so that equal parts have exactly their mean.
    first = parts.mean.take([0], axis)
    mean = first + np.sum(share * (parts.mean - first), axis=axis, keepdims=True)
    d = parts.mean - mean
    third = parts.third + d * (3.0 * parts.variance + d**2)
    fourth = parts.fourth + d * (4.0 * parts.third + d * (6.0 * parts.variance + d**2))
    return Moments(
        mean.squeeze(axis), *(np.sum(share * part, axis=axis) for part in (parts.variance + d**2, third, fourth))
    )
