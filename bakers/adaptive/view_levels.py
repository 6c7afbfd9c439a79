"""View bins from coarse to fine: which come first, and what the coarser ones say of each finer one.

The bins are ordered so that each next one is the farthest from those before it; the first few are level 0, and up to
each next level there are FINER times as many bins. A bin is predicted from the nearest bins of the levels below by
kriging with the Matérn kernel of smoothness 3/2 and weights that add up to 1, so that constants are predicted exactly.
Measured on six trained networks against smoother kernels and longer stencils: none is better by a tenth where the view
matters smoothly, and this one is the best where it does not. Source: Stein, "Interpolation of Spatial Data" (1999).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.spatial import KDTree

Array = NDArray[np.float64]

COARSEST = 4
FINER = 2.6
"""All the bins of a level and of those below it, over those below it."""
STENCIL = 24
NEAREST = 6
"""Parents whose surprise tells what a bin may be in for."""
CORRELATION_LENGTH = 4.0
"""Of the kernel, in chords of the unit sphere: long, so that it is the distance itself that counts."""
MOST_ORDERED = 1024
"""Bins that are put in order; finer ones are predicted from these, all at once."""


@dataclass(frozen=True)
class Level:
    """The bins that a level adds, and what those of the levels below say of them."""

    bins: NDArray[np.int64]
    """[n]"""
    parents: NDArray[np.int64]
    """Bins [n,S] of the levels below that are nearest, the nearest first; S = 0 for level 0."""
    weights: Array
    """[n,S]: prediction = Σ weights · value over the parents; rows add up to 1."""
    place: NDArray[np.int64]
    """[B], of each bin of this level its place in `bins`; −1 for all others."""
    combining: csr_array
    """The weights as a matrix [n,B]."""
    combining_squares: csr_array
    """Their squares, for what errs apart."""
    nearest: csr_array
    """The mean over the nearest parents as a matrix [n,B]."""


def view_levels(directions: Array) -> list[Level]:
    """Levels of the view bins whose centres are the unit vectors `directions` [B,3]; every bin is in one of them."""
    order = _farthest_first(directions, min(len(directions), MOST_ORDERED))
    rest = np.setdiff1d(np.arange(len(directions)), order)
    first = order[:COARSEST]
    none = np.empty((len(first), 0))
    levels = [_complete(first, none.astype(np.int64), none, len(directions))]
    known = COARSEST
    while known < len(order):
        more = min(int(np.ceil(FINER * known)), len(order))
        # A last level of a few bins is not worth its own round.
        more = len(order) if more > 0.8 * len(order) else more
        levels.append(_level(directions, order[:known], order[known:more]))
        known = more
    if rest.size:
        levels.append(_level(directions, order, rest))
    return levels


def _farthest_first(directions: Array, count: int) -> NDArray[np.int64]:
    """`count` of the unit vectors `directions` [B,3], each the farthest from those before; the first is the lowest."""
    chosen = np.empty(count, np.int64)
    chosen[0] = int(np.argmin(directions[:, 2]))
    nearest = np.full(len(directions), -np.inf)
    for place in range(1, count):
        nearest = np.maximum(nearest, directions @ directions[chosen[place - 1]])
        nearest[chosen[:place]] = np.inf
        chosen[place] = int(np.argmin(nearest))
    return chosen


def _level(directions: Array, below: NDArray[np.int64], bins: NDArray[np.int64]) -> Level:
    stencil = min(STENCIL, len(below))
    distance, found = KDTree(directions[below]).query(directions[bins], k=stencil)
    distance, found = distance.reshape(len(bins), stencil), found.reshape(len(bins), stencil)
    around = directions[below][found]
    weights = _kriging(np.linalg.norm(around[:, :, None] - around[:, None], axis=-1), distance)
    return _complete(bins, below[found], weights, len(directions))


def _complete(bins: NDArray[np.int64], parents: NDArray[np.int64], weights: Array, width: int) -> Level:
    place = np.full(width, -1, np.int64)
    place[bins] = np.arange(len(bins))
    near = parents[:, :NEAREST]
    means = np.full(near.shape, 1.0 / max(1, near.shape[1]))
    return Level(
        bins,
        parents,
        weights,
        place,
        _matrix(weights, parents, width),
        _matrix(weights**2, parents, width),
        _matrix(means, near, width),
    )


def _matrix(weights: Array, columns: NDArray[np.int64], width: int) -> csr_array:
    starts = np.arange(len(weights) + 1) * weights.shape[1]
    # Copies: the matrix sorts its entries in place when it likes to.
    return csr_array((weights.ravel().copy(), columns.ravel().copy(), starts), shape=(len(weights), width))


def _kriging(between: Array, distance: Array) -> Array:
    """Weights [n,s] from the distances between the s known bins [n,s,s] and to them [n,s]."""
    count, stencil = distance.shape
    system = np.ones((count, stencil + 1, stencil + 1))
    system[:, :stencil, :stencil] = _matern(between)
    system[:, stencil, stencil] = 0.0
    right = np.ones((count, stencil + 1, 1))
    right[:, :stencil, 0] = _matern(distance)
    return np.asarray(np.linalg.solve(system, right)[:, :stencil, 0])


def _matern(distance: Array) -> Array:
    scaled = np.sqrt(3.0) / CORRELATION_LENGTH * distance
    return np.asarray((1.0 + scaled) * np.exp(-scaled))
