"""The standard error of baked coefficients, from rotations that are independent between bins.

Three estimates of the variance, best first; each gives the mean over coefficients and channels. Measured with 64
directions and degree 2 on shadow-edged and lobed transports and on a trained network, against 2¹³ and 2¹⁴ directions
(share of bins whose true error lies within 1.96 of the estimate; estimated over true rms error):

    neighbours   0.96–1.00   0.99–1.02   costs nothing
    halves       0.96–0.99   0.96–1.01   1.3–2 times the error for the same evaluations
    residual     1.00        1.5–5       costs nothing; for few bins and few directions

An rms over many numbers scatters less than one number does, so that more than 95 % may lie within.

`neighbours` takes the fourth difference (1, −4, 6, −4, 1)/√70 along the sectors of a ring: the coefficients
vary smoothly there and drop out to fourth order, while the errors of the five bins are independent. Below 32 sectors
too much remains; and behind polished glass at any number, up to 14 times the error. Where the residual makes that seem
possible, a few bins of the vertex are evaluated once more, on other sets of directions (`held_against`).
"""

from typing import Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Estimator = Literal["neighbours", "halves", "residual"]

FEWEST_SECTORS = 32
COMFORTABLE_HALF = 1.5
"""Least directions per coefficient in each half-size set."""
FEWEST_HELD, SHARE_HELD = 4, 64
"""Bins of a vertex that are evaluated twice: at least, and one of how many."""
SUSPECT, FALLING, PLAIN_SUSPECT = 0.3, 1.4, 1.5
"""Times the residual's variance, from which on what neighbours differ by may be view: of lattices of 64 directions that
are fitted, and with which power of their number that falls beyond; and of plain sums, whose residual is no larger."""
BELIEVED = 0.5
"""Times that, which pairs must be less than to be believed instead: sixteen of them scatter by a third."""
_FOURTH_DIFFERENCE = (1.0, -4.0, 6.0, -4.0, 1.0)


def choose_estimator(sectors: int, samples: int, count: int, fitted: bool) -> Estimator:
    """The best estimate that `samples` directions, `count` coefficients and `sectors` bins a ring allow."""
    if sectors >= FEWEST_SECTORS:
        return "neighbours"
    if not fitted or samples / 2 >= COMFORTABLE_HALF * count:
        return "halves"
    return "residual"


def neighbour_errors(coefficients: Array, sectors: int) -> Array:
    """Numbers [n,B,K,3] that vary as the errors of coefficients [n,B,K,3] do: fourth differences along each ring."""
    n, bins, count, channels = coefficients.shape
    rings = coefficients.reshape(n, bins // sectors, sectors, count * channels)
    difference = np.zeros_like(rings)
    for shift, factor in enumerate(_FOURTH_DIFFERENCE, start=-2):
        difference += factor * np.roll(rings, shift, axis=2)
    difference /= np.sqrt(sum(factor**2 for factor in _FOURTH_DIFFERENCE))
    return difference.reshape(coefficients.shape)


def halves_variance(errors: Array, rough: Array, sectors: int) -> Array:
    """Variance [n,B] of the mean of two independent estimates; `errors` [n,B,K,3] is half of what they differ by, and
    `rough` [n,B] what their fits leave over.

    Taken together for each bin and its two neighbours, which raises the share within 1.96 from 0.91 to 0.97: one
    difference of few independent numbers is often too small. What is found there is shared out by roughness: a bin
    with a hundred times the variance of the next would be told in both.
    """
    own = (errors**2).mean(axis=(-1, -2))
    if sectors < 3:
        return np.asarray(own)
    found, there = _with_neighbours(own, sectors), _with_neighbours(rough, sectors)
    return np.asarray(np.divide(found * rough, there, out=np.zeros_like(own), where=there > 0.0))


def _with_neighbours(values: Array, sectors: int) -> Array:
    """Values [n,B], each added to those of the two bins beside it on its ring."""
    rings = values.reshape(len(values), -1, sectors)
    return np.asarray(np.roll(rings, 1, axis=2) + rings + np.roll(rings, -1, axis=2)).reshape(values.shape)


def how_many_held(bins: int) -> int:
    """How many of its bins a vertex is evaluated at twice."""
    return min(bins, max(FEWEST_HELD, bins // SHARE_HELD))


def suspect(neighbours: Array, rough: Array, fitted: int) -> NDArray[np.int64]:
    """Vertices [m] at which what neighbouring bins differ by [n,B] may be more than noise, by their residuals [n,B];
    `fitted`: over how many directions, 0 where values were only summed.
    """
    times = SUSPECT * min(1.0, 64 / fitted) ** FALLING if fitted else PLAIN_SUSPECT
    return np.flatnonzero(neighbours.mean(axis=1) > times * rough.mean(axis=1))


def held_against(pairs: Array, neighbours: Array, rough: Array, at: NDArray[np.int64]) -> Array:
    """Variance [n,B]: that of neighbours [n,B], or where pairs [n] of the bins `at` [n,m] say far less, theirs, in
    proportion to the roughness [n,B] of each bin.
    """
    there = np.take_along_axis(rough, at, axis=1).mean(axis=1)
    scaled = rough * np.divide(pairs, there, out=np.zeros_like(pairs), where=there > 0.0)[:, None]
    return np.where((pairs < BELIEVED * neighbours.mean(axis=1))[:, None], scaled, neighbours)
