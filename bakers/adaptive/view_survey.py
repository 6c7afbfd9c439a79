"""Detects view-dependent features that an adaptive bake would miss, at a few vertices with all bins evaluated.

A bin is evaluated where the prediction error of nearby bins is large, so a highlight between the evaluated bins stays
undetected. At a few vertices all bins are evaluated in the same few directions, so predictions can be compared with the
values without noise.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bakers.adaptive.view_levels import Level

Array = NDArray[np.float64]

FULL_LEVELS = 2
"""All bins of levels up to this one are evaluated: predictions from fewer bins are unreliable."""
DECAY = 0.45
"""Typical ratio of prediction errors from one level to the next."""
UNDETECTED = 16.0
"""Ratio of the squared error to the expected or tolerated one above which validation at a few bins would hardly detect
it.
"""
UNDETECTED_SHARE = 0.3
SECTOR_SHIFTS = 8
"""Rotations in azimuth for which a vertex's views are tested: a feature found by chance in one is missed in another."""
SCALE_LEVELS = 2
"""Levels that a vertex's scale is measured on."""


@dataclass(frozen=True)
class ViewSurvey:
    """Coefficients of all bins of a few vertices."""

    levels: list[Level]
    coefficients: Array
    """[B,n,C], over one lattice for each vertex."""
    floor: float
    """Least rms coefficient that the errors of a vertex are relative to."""
    residual_energy: float
    """Fraction of the energy of Ŝ outside the first few principal components of the light, as many as the first probe
    stage fits.
    """

    @classmethod
    def of(
        cls, levels: list[Level], directions: Array, coefficients: Array, floor: float, residual_energy: float = 1.0
    ) -> "ViewSurvey":
        """Survey of coefficients [B,n,C] at the view bins whose centres are the unit vectors `directions` [B,3]."""
        rings = len(np.unique(np.round(directions[:, 2], 9)))
        if len(directions) % rings:
            return cls(levels, coefficients, floor, residual_energy)
        by_ring = coefficients.reshape(rings, -1, *coefficients.shape[1:])
        sectors = by_ring.shape[1]
        shifts = np.unique(np.arange(SECTOR_SHIFTS) * sectors // SECTOR_SHIFTS)
        shifted = np.concatenate([np.roll(by_ring, shift, axis=1) for shift in shifts], axis=2)
        shifted = shifted.reshape(len(directions), -1, coefficients.shape[2])
        return cls(levels, shifted, floor, residual_energy)

    def full_levels_for(self, error: float, tolerance: float) -> int:
        """The number of the last level that must be evaluated fully so that the undetected error is well below the
        relative `error`, where a prediction error `tolerance`, relative to the rms coefficient of its vertex, is
        tolerated.
        """
        last = len(self.levels) - 1
        for full in range(min(FULL_LEVELS, last), last):
            if self._undetected_error(full, tolerance) <= UNDETECTED_SHARE * error:
                return full
        return max(last, FULL_LEVELS)

    def is_low_rank(self, error: float) -> bool:
        """Whether a few components of the light represent the bins to that relative error."""
        return bool(self.residual_energy <= error**2)

    def _undetected_error(self, full: int, tolerance: float) -> float:
        """Relative rms error that stays undetected if the levels up to `full` are evaluated fully."""
        found, prediction_error, missed = self.coefficients.copy(), np.zeros(self.coefficients.shape[:2]), 0.0
        tolerated = tolerance**2 * self._scale()
        for number, level in enumerate(self.levels[1:], start=1):
            predicted = (level.interpolation @ found.reshape(len(found), -1)).reshape(-1, *found.shape[1:])
            squared = ((found[level.bins] - predicted) ** 2).mean(axis=2)
            expected = DECAY**2 * (level.nearest_mean @ prediction_error)
            evaluated = (expected > tolerated) | (number <= full)
            missed += float(squared[~evaluated & (squared > UNDETECTED * (expected + tolerated))].sum())
            found[level.bins] = np.where(evaluated[..., None], found[level.bins], predicted)
            prediction_error[level.bins] = np.where(evaluated, squared, expected)
            if number == FULL_LEVELS:
                # The first levels had hardly any prediction: use the error of the last of them.
                for before in self.levels[:number]:
                    prediction_error[before.bins] = prediction_error[level.bins].mean(axis=0)
        signal = float((self.coefficients**2).mean(axis=2).sum())
        return float(np.sqrt(missed / signal)) if signal > 0.0 else 0.0

    def _scale(self) -> Array:
        known = np.concatenate([level.bins for level in self.levels[:SCALE_LEVELS]])
        return np.asarray(np.maximum((self.coefficients[known] ** 2).mean(axis=(0, 2)), self.floor**2))
