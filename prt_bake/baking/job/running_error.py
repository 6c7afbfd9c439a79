"""Running figures of a bake's error, estimated from its standard errors."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from bakers.baker import Block


@dataclass
class ErrorMeter:
    """Accumulates blocks. The relative RMSE is sqrt(Σ se² · K · 3 / Σ a²) over vertices, bins, K and channels."""

    squared_error: float = 0.0
    squared_estimate: float = 0.0
    """Σ â² of the noisy estimates."""
    _ratios: list[NDArray[np.float64]] = field(default_factory=list)

    def add(self, block: Block, times: float = 1.0) -> None:
        """Adds the valid vertices of a block; each counts `times` times in the total."""
        estimate = block.coefficients[block.valid].astype(np.float64)
        standard_error = block.standard_error[block.valid].astype(np.float64)
        error = (standard_error**2).sum(axis=1) * estimate.shape[2] * estimate.shape[3]
        squares = (estimate**2).sum(axis=(1, 2, 3))
        self.squared_error += times * float(error.sum())
        self.squared_estimate += times * float(squares.sum())
        self._ratios.append(_ratio(error, squares))

    @property
    def total(self) -> float:
        """Relative RMSE over all blocks so far; 0 without any."""
        return float(_ratio(np.array(self.squared_error), np.array(self.squared_estimate)))

    @property
    def percentile_95(self) -> float:
        """95th percentile over vertices of the relative RMSE of each vertex."""
        ratios = np.concatenate(self._ratios) if self._ratios else np.zeros(0)
        return float(np.percentile(ratios, 95, method="higher")) if ratios.size else 0.0


def _ratio(error: NDArray[np.float64], squares: NDArray[np.float64]) -> NDArray[np.float64]:
    """sqrt(error / Σ a²) with Σ a² = Σ â² − error, because noise adds to the squares of an estimate.

    At most half of the squares is subtracted: beyond that the error is as large as the signal.
    """
    signal = np.maximum(squares - error, squares / 2.0)
    return np.asarray(np.sqrt(np.divide(error, signal, out=np.zeros_like(error), where=signal > 0.0)))
