"""Box filter along one axis: weights with which the rows or columns of an image average to those of a smaller one."""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class BoxFilter(NamedTuple):
    """Source cells begins … ends [coarse] of each target cell, and their weights [coarse, n].

    n is the largest number of source cells, rounded up to a multiple of 4; weights beyond the end are 0.
    """

    begins: NDArray[np.int64]
    ends: NDArray[np.int64]
    weights: Array


def box_filter(fine: int, coarse: int, measure: Callable[[Array, Array], Array]) -> BoxFilter:
    """Weights of `fine` equal cells of the unit interval in the means over `coarse` equal cells.

    measure: of intervals with ends [S] and beginnings [S] in [0, 1]; weights are proportional to that of the overlap.
    """
    cuts = np.union1d(np.arange(fine + 1) * coarse, np.arange(coarse + 1) * fine)  # in parts of fine · coarse, exact
    begins, ends = cuts[:-1], cuts[1:]
    within, part = begins // fine, begins // coarse
    size = measure(ends / (fine * coarse), begins / (fine * coarse))
    size /= np.bincount(within, size)[within]
    count = np.bincount(within)
    first = part[np.cumsum(count) - count]
    weights = np.zeros((coarse, -(-int(count.max()) // 4) * 4))
    weights[within, part - first[within]] = size
    return BoxFilter(first, first + count, weights)


def zone(end: Array, begin: Array) -> Array:
    """Solid angle, up to a factor, between two latitudes in [0, 1] from pole to pole."""
    return np.asarray(np.sin(math.pi * 0.5 * (begin + end)) * np.sin(math.pi * 0.5 * (end - begin)))
