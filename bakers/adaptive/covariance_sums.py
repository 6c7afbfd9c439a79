"""Gathers how the errors of a block's vertices hang together, while its bins are integrated, each in its own way."""

import numpy as np
from numpy.typing import NDArray

from bakers.error_covariance import of_errors, shape_of, trace
from formats.asset.error_covariance import ErrorShape, pairs

Array = NDArray[np.float64]
Index = NDArray[np.int64]

FORETOLD, SHARED, ALONE = range(3)
"""Whence errors come: of prediction; of lattices that bins of a vertex share; of lattices of their own."""


class ShapeSums:
    """Sums over the bins of n vertices, in the frames of their views, for each origin of errors."""

    def __init__(self, n: int, count: int) -> None:
        self._count = count
        self._covariance, self._channels = np.zeros((3, n, pairs(count))), np.zeros((3, n, 3))

    def add(self, origin: int, rows: Index, covariance: Array, channels: Array, variance: Array) -> None:
        """Takes in bins of vertices `rows` [M]: shapes [M,P], [M,3] of any size, and their variance [M]."""
        for sums, shapes, size in (
            (self._covariance, covariance, trace(covariance, self._count)),
            (self._channels, channels, channels.sum(axis=1)),
        ):
            known = (size > 0.0) & np.isfinite(size) & np.isfinite(variance)
            share = np.divide(variance, size, out=np.zeros(len(size)), where=known)
            np.add.at(sums[origin], rows[known], shapes[known] * share[known, None])

    def add_errors(self, origin: int, rows: Index, errors: Array) -> None:
        """Takes in errors [M,K,3] of bins."""
        covariance, channels = of_errors(errors[:, None])
        sound = np.isfinite(covariance).all(axis=1)
        np.add.at(self._covariance[origin], rows[sound], covariance[sound])
        np.add.at(self._channels[origin], rows[sound], channels[sound])

    def finished(self, sizes: Array, apart: Array) -> ErrorShape:
        """The shape of it all: `sizes` [3,n] are the variances of the three origins, summed over bins, `apart` [n] the
        share that each bin has of its own. An origin of which nothing is known takes after the others.
        """
        sums = []
        for shapes, size in (
            (self._covariance, trace(self._covariance, self._count)),
            (self._channels, self._channels.sum(axis=2)),
        ):
            known = size > 0.0
            share = np.divide(np.where(known, sizes, 0.0), size, out=np.zeros(size.shape), where=known)
            sums.append(np.einsum("on,onp->np", share, shapes))
        return shape_of(sums[0], sums[1], apart, self._count)
