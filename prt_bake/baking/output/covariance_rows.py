"""Error covariances, collected vertex by vertex until an asset is closed."""

import numpy as np

from bakers.baker import Block
from bakers.error_covariance import clustered, unknown_covariance
from formats.asset.error_covariance import ErrorCovariance


class CovarianceRows:
    """Covariances of all vertices of an asset with coefficients [V,B,K,C] in half floats, and their error variances."""

    def __init__(self, axes: tuple[int, ...]) -> None:
        self._axes, self._variance = axes, np.zeros(axes[0])
        self._shape: ErrorCovariance | None = None

    def add(self, block: Block) -> None:
        """Adds the covariances of the block's valid vertices, if it has any."""
        if block.error_covariance is None:
            return
        if self._shape is None:
            vertices, _views, count, channels = self._axes
            initial = unknown_covariance(1, count, channels)
            covariance, shares, apart = (
                np.repeat(part.astype(np.float16), vertices, axis=0)
                for part in (initial.covariance, initial.channels, initial.apart)
            )
            self._shape = ErrorCovariance(covariance, shares, apart)
        rows = block.first_vertex + np.flatnonzero(block.valid)
        self._shape.covariance[rows] = block.error_covariance.covariance[block.valid]
        self._shape.channels[rows] = block.error_covariance.channels[block.valid]
        self._shape.apart[rows] = block.error_covariance.apart[block.valid]
        self._variance[rows] = (block.standard_error[block.valid].astype(np.float64) ** 2).mean(axis=1)

    def finished(self) -> ErrorCovariance | None:
        """The covariances of all vertices; None if no block had any."""
        return None if self._shape is None else clustered(self._shape, self._variance)
