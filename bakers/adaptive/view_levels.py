"""Levels of view bins from coarse to fine, and the interpolation of each level from the coarser ones.

The bins are sorted so that each is the farthest from those before it. Level 0 has the first few, and each further level
multiplies the number of bins by GROWTH. A bin is predicted from the nearest bins of the levels below by kriging with
the Matérn kernel of smoothness 3/2 and weights that add up to 1, so constants are reproduced exactly. On six trained
networks smoother kernels and longer stencils are at most a tenth better where Ŝ is smooth in the view, and worse where
it is not. Source: Stein, "Interpolation of Spatial Data" (1999).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.spatial import KDTree

Array = NDArray[np.float64]

COARSEST = 4
GROWTH = 2.6
"""Number of bins of a level and those below it, over the number below it."""
STENCIL = 24
NEAREST = 6
"""Parents whose prediction errors determine the expected one of a bin."""
CORRELATION_LENGTH = 4.0
"""Correlation length of the kernel, in chords of the unit sphere; it is long, so that the kernel acts like the distance
itself.
"""
MOST_SORTED = 1024
"""Bins that are sorted; all further ones are predicted from these."""


@dataclass(frozen=True)
class Level:
    """Bins of a level, and their interpolation from the levels below."""

    bins: NDArray[np.int64]
    """[n]"""
    parents: NDArray[np.int64]
    """Nearest bins [n,S] of the levels below, nearest first; S = 0 for level 0."""
    weights: Array
    """[n,S]: prediction = Σ weights · value over the parents; rows add up to 1."""
    place: NDArray[np.int64]
    """[B], the index in `bins` of each bin of this level; −1 for all others."""
    interpolation: csr_array
    """The weights as a matrix [n,B]."""
    squared_weights: csr_array
    """The squared weights, for independent errors."""
    nearest_mean: csr_array
    """The mean over the nearest parents as a matrix [n,B]."""


def view_levels(directions: Array) -> list[Level]:
    """Levels of the view bins whose centres are the unit vectors `directions` [B,3]; every bin is in one of them."""
    order = _farthest_first(directions, min(len(directions), MOST_SORTED))
    rest = np.setdiff1d(np.arange(len(directions)), order)
    first = order[:COARSEST]
    none = np.empty((len(first), 0))
    levels = [_with_matrices(first, none.astype(np.int64), none, len(directions))]
    known = COARSEST
    while known < len(order):
        more = min(int(np.ceil(GROWTH * known)), len(order))
        # Merge a last level of a few bins.
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
    return _with_matrices(bins, below[found], weights, len(directions))


def _with_matrices(bins: NDArray[np.int64], parents: NDArray[np.int64], weights: Array, width: int) -> Level:
    place = np.full(width, -1, np.int64)
    place[bins] = np.arange(len(bins))
    near = parents[:, :NEAREST]
    means = np.full(near.shape, 1.0 / max(1, near.shape[1]))
    interpolation, squared = (_matrix(each, parents, width) for each in (weights, weights**2))
    return Level(bins, parents, weights, place, interpolation, squared, _matrix(means, near, width))


def _matrix(weights: Array, columns: NDArray[np.int64], width: int) -> csr_array:
    starts = np.arange(len(weights) + 1) * weights.shape[1]
    # Copies, since the matrix may sort its entries in place.
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
