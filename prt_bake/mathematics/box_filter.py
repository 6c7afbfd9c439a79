"""Means over the parts of a line cut finely and coarsely: the rows or columns of a picture and of a smaller one."""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class LineMeans(NamedTuple):
    """The fine parts of a line that each of its coarse ones meets, from begins to ends [coarse], and their shares in
    its mean [coarse, most of them up to a multiple of 4], 0 beyond the end.
    """

    begins: NDArray[np.int64]
    ends: NDArray[np.int64]
    shares: Array


def line_means(fine: int, coarse: int, measure: Callable[[Array, Array], Array]) -> LineMeans:
    """Shares of `fine` equal parts of a line in the mean over each of `coarse` parts, by the measure of what they have
    in common.

    measure: of stretches between ends [S] and beginnings [S], as parts of the line.
    """
    cuts = np.union1d(np.arange(fine + 1) * coarse, np.arange(coarse + 1) * fine)  # in parts of fine · coarse, exact
    begins, ends = cuts[:-1], cuts[1:]
    within, part = begins // fine, begins // coarse
    size = measure(ends / (fine * coarse), begins / (fine * coarse))
    size /= np.bincount(within, size)[within]
    count = np.bincount(within)
    first = part[np.cumsum(count) - count]
    shares = np.zeros((coarse, -(-int(count.max()) // 4) * 4))
    shares[within, part - first[within]] = size
    return LineMeans(first, first + count, shares)


def zone(end: Array, begin: Array) -> Array:
    """Solid angle, up to a factor, between two parts of the way from pole to pole."""
    return np.asarray(np.sin(math.pi * 0.5 * (begin + end)) * np.sin(math.pi * 0.5 * (end - begin)))
