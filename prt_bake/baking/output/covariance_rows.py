"""How errors hang together, kept vertex by vertex until an asset is closed."""

import numpy as np

from bakers.baker import Block
from bakers.error_covariance import gathered, unshaped
from formats.asset.error_covariance import ErrorShape


class ShapeRows:
    """The shapes of all vertices of an asset with coefficients [V,B,K,C], as half floats, and how large their errors
    are.
    """

    def __init__(self, axes: tuple[int, ...]) -> None:
        self._axes, self._size = axes, np.zeros(axes[0])
        self._shape: ErrorShape | None = None

    def keep(self, block: Block) -> None:
        """Takes the shapes of the block's valid vertices, where it has any."""
        if block.shape is None:
            return
        if self._shape is None:
            vertices, _views, count, channels = self._axes
            none = unshaped(1, count, channels)
            covariance, shares, apart = (
                np.repeat(part.astype(np.float16), vertices, axis=0)
                for part in (none.covariance, none.channels, none.apart)
            )
            self._shape = ErrorShape(covariance, shares, apart)
        rows = block.first_vertex + np.flatnonzero(block.valid)
        self._shape.covariance[rows] = block.shape.covariance[block.valid]
        self._shape.channels[rows] = block.shape.channels[block.valid]
        self._shape.apart[rows] = block.shape.apart[block.valid]
        self._size[rows] = (block.standard_error[block.valid].astype(np.float64) ** 2).mean(axis=1)

    def finished(self) -> ErrorShape | None:
        """Of all vertices; None where no block told any."""
        return None if self._shape is None else gathered(self._shape, self._size)
