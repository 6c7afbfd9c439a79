"""Accumulates the error covariance of a block's vertices while its bins are integrated."""

import numpy as np
from numpy.typing import NDArray

from bakers.error_covariance import error_sums, normalised_covariance, trace
from formats.asset.error_covariance import ErrorCovariance, pairs

Array = NDArray[np.float64]
Index = NDArray[np.int64]

PREDICTED, SHARED, OWN = range(3)
"""Sources of error: prediction, lattices that bins of a vertex share, and own lattices."""


class CovarianceSums:
    """Sums over the bins of n vertices, in the frames of their views, for each source of error."""

    def __init__(self, n: int, count: int) -> None:
        self._count = count
        self._covariance, self._channels = np.zeros((3, n, pairs(count))), np.zeros((3, n, 3))

    def add(self, source: int, rows: Index, covariance: Array, channels: Array, variance: Array) -> None:
        """Adds bins of vertices `rows` [M]: covariances [M,P], [M,3] up to a factor, and their variance [M]."""
        for sums, matrices, size in (
            (self._covariance, covariance, trace(covariance, self._count)),
            (self._channels, channels, channels.sum(axis=1)),
        ):
            known = (size > 0.0) & np.isfinite(size) & np.isfinite(variance)
            share = np.divide(variance, size, out=np.zeros(len(size)), where=known)
            np.add.at(sums[source], rows[known], matrices[known] * share[known, None])

    def add_errors(self, source: int, rows: Index, errors: Array) -> None:
        """Adds errors [M,K,3] of bins."""
        covariance, channels = error_sums(errors[:, None])
        sound = np.isfinite(covariance).all(axis=1)
        np.add.at(self._covariance[source], rows[sound], covariance[sound])
        np.add.at(self._channels[source], rows[sound], channels[sound])

    def finished(self, sizes: Array, independent: Array) -> ErrorCovariance:
        """The total error covariance. `sizes` [3,n] are the variances of the three sources, summed over bins;
        `independent` [n] is the fraction that is independent between bins. The other sources replace one without data.
        """
        sums = []
        for matrices, size in (
            (self._covariance, trace(self._covariance, self._count)),
            (self._channels, self._channels.sum(axis=2)),
        ):
            known = size > 0.0
            share = np.divide(np.where(known, sizes, 0.0), size, out=np.zeros(size.shape), where=known)
            sums.append(np.einsum("on,onp->np", share, matrices))
        return normalised_covariance(sums[0], sums[1], independent, self._count)
