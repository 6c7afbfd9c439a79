"""Standard errors of baked coefficients, from direction sets that are independent between bins.

Three estimates of the variance, best first; each gives the mean over coefficients and channels. Measured with 64
directions and degree 2 on transports with shadow edges and lobes and on a trained network, against 2¹³ and 2¹⁴
directions (fraction of bins whose true error is within 1.96 of the estimate; estimated over true rms error):

    neighbours   0.96–1.00   0.99–1.02   costs nothing
    halves       0.96–0.99   0.96–1.01   1.3–2 times the error for the same evaluations
    residual     1.00        1.5–5       costs nothing; for few bins and few directions

An rms over many numbers varies less than a single number, so more than 95 % may be within the bound.

`neighbours` takes the fourth difference (1, −4, 6, −4, 1)/√70 along the sectors of a ring: the coefficients vary
smoothly there and cancel to fourth order, while the errors of the five bins are independent. Below 32 sectors the
signal does not cancel well enough. Behind polished glass it never does: the estimate is up to 14 times the error. If
the residual suggests this, a few validation bins of the vertex are evaluated again on other direction sets
(`validated_variance`).
"""

from typing import Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Estimator = Literal["neighbours", "halves", "residual"]

ROUNDING = 2.0**-23
"""Least relative error of a coefficient: values and coefficients are stored in float32."""
FEWEST_SECTORS = 32
LEAST_DIRECTIONS_PER_COEFFICIENT = 1.5
"""Least directions per coefficient in each half-size set."""
FEWEST_VALIDATION_BINS, BINS_PER_VALIDATION_BIN = 4, 64
"""Least number of validation bins of a vertex, and number of bins per validation bin."""
UNRELIABLE_FIT, DIRECTIONS_POWER, UNRELIABLE_SUM = 0.3, 1.4, 1.5
"""The neighbour estimate may contain signal above this multiple of the residual variance: for fits over 64 directions,
the power of the number of directions by which the multiple falls above 64, and for plain sums, whose residual is no
larger than their error.
"""
VALIDATED_BELOW = 0.5
"""The validation bins replace the neighbour estimate below this fraction of it; sixteen pairs vary by a third."""
_FOURTH_DIFFERENCE = (1.0, -4.0, 6.0, -4.0, 1.0)


def choose_estimator(sectors: int, samples: int, count: int, fitted: bool) -> Estimator:
    """The best estimator for `samples` directions, `count` coefficients and `sectors` bins per ring."""
    if sectors >= FEWEST_SECTORS:
        return "neighbours"
    if not fitted or samples / 2 >= LEAST_DIRECTIONS_PER_COEFFICIENT * count:
        return "halves"
    return "residual"


def neighbour_errors(coefficients: Array, sectors: int) -> Array:
    """Numbers [n,B,K,3] that have the variance of the errors of coefficients [n,B,K,3]: fourth differences along each
    ring.
    """
    n, bins, count, channels = coefficients.shape
    rings = coefficients.reshape(n, bins // sectors, sectors, count * channels)
    difference = np.zeros_like(rings)
    for shift, factor in enumerate(_FOURTH_DIFFERENCE, start=-2):
        difference += factor * np.roll(rings, shift, axis=2)
    difference /= np.sqrt(sum(factor**2 for factor in _FOURTH_DIFFERENCE))
    return difference.reshape(coefficients.shape)


def half_buffer_variance(errors: Array, rough: Array, sectors: int) -> Array:
    """Variance [n,B] of the mean of two half buffers; `errors` [n,B,K,3] is half their difference, `rough` [n,B] their
    residual variance.

    The variance is pooled over each bin and its two neighbours, which raises the fraction within 1.96 from 0.91 to
    0.97: a single difference of few independent numbers is often too small. The pooled variance is distributed in
    proportion to the residuals, since adjacent bins may differ in variance a hundredfold.
    """
    own = (errors**2).mean(axis=(-1, -2))
    if sectors < 3:
        return np.asarray(own)
    pooled, total = _with_neighbours(own, sectors), _with_neighbours(rough, sectors)
    return np.asarray(np.divide(pooled * rough, total, out=np.zeros_like(own), where=total > 0.0))


def _with_neighbours(values: Array, sectors: int) -> Array:
    """Values [n,B] plus those of the two adjacent bins on the ring."""
    rings = values.reshape(len(values), -1, sectors)
    return np.asarray(np.roll(rings, 1, axis=2) + rings + np.roll(rings, -1, axis=2)).reshape(values.shape)


def validation_bin_count(bins: int) -> int:
    """Number of validation bins of a vertex."""
    return min(bins, max(FEWEST_VALIDATION_BINS, bins // BINS_PER_VALIDATION_BIN))


def unreliable_vertices(neighbours: Array, rough: Array, fitted: int) -> NDArray[np.int64]:
    """Vertices [m] at which the neighbour estimate [n,B] may contain signal, judged by the residual variance [n,B];
    `fitted`: number of directions of the fit, 0 for plain sums.
    """
    times = UNRELIABLE_FIT * min(1.0, 64 / fitted) ** DIRECTIONS_POWER if fitted else UNRELIABLE_SUM
    return np.flatnonzero(neighbours.mean(axis=1) > times * rough.mean(axis=1))


def validated_variance(pairs: Array, neighbours: Array, rough: Array, at: NDArray[np.int64]) -> Array:
    """Variance [n,B]: the neighbour estimate [n,B], or where the validation variance `pairs` [n] at the bins `at` [n,m]
    is much smaller, that variance scaled by the roughness [n,B] of each bin.
    """
    there = np.take_along_axis(rough, at, axis=1).mean(axis=1)
    scaled = rough * np.divide(pairs, there, out=np.zeros_like(pairs), where=there > 0.0)[:, None]
    return np.where((pairs < VALIDATED_BELOW * neighbours.mean(axis=1))[:, None], scaled, neighbours)
