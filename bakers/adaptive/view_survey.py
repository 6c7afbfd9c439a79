"""What a bake that foretells view bins would miss without telling, from a few vertices that are seen in all of them.

A bin is looked at where bins beside it came as a surprise; a highlight that lies between those that are looked at
surprises nobody. At a few vertices all bins are seen, in few directions that they share, so that what is foretold of a
bin can be held against it without noise.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bakers.adaptive.view_levels import Level

Array = NDArray[np.float64]

ALWAYS = 2
"""Levels up to this one are evaluated whole: what fewer bins say of the others is not to be relied on."""
DECAY = 0.45
"""Of the error of prediction, from one level to the next, as it usually is."""
UNFORESEEN = 16.0
"""Times the squared error that is expected or tolerated, from which on checks of a few bins would hardly know of it."""
MISSED_OF_ERROR = 0.3
TURNS = 8
"""Ways round that a vertex's views are put to the test in: what was found by luck in one is missed in another."""
SCALED_BY = 2
"""Levels that a vertex's scale is taken from."""


@dataclass(frozen=True)
class ViewSurvey:
    """Coefficients of all bins of a few vertices."""

    levels: list[Level]
    coefficients: Array
    """[B,n,C], over one lattice for each vertex."""
    floor: float
    """Least root mean square of a vertex's coefficients that errors are held against."""
    left: float
    """Of the energy of Ŝ, what the first few principal functions of the light leave over, as many as are soon told."""

    @classmethod
    def of(
        cls, levels: list[Level], directions: Array, coefficients: Array, floor: float, left: float = 1.0
    ) -> "ViewSurvey":
        """Of coefficients [B,n,C] at the view bins whose centres are the unit vectors `directions` [B,3]."""
        rings = len(np.unique(np.round(directions[:, 2], 9)))
        if len(directions) % rings:
            return cls(levels, coefficients, floor, left)
        wheel = coefficients.reshape(rings, -1, *coefficients.shape[1:])
        sectors = wheel.shape[1]
        turned = [np.roll(wheel, turn, axis=1) for turn in np.unique(np.arange(TURNS) * sectors // TURNS)]
        return cls(
            levels, np.concatenate(turned, axis=2).reshape(len(directions), -1, coefficients.shape[2]), floor, left
        )

    def always_for(self, error: float, view: float) -> int:
        """The level up to which all must be evaluated so that hardly any of that relative error is missed untold, where
        an error of prediction `view`, over the root mean square coefficient of its vertex, is tolerated.
        """
        last = len(self.levels) - 1
        for always in range(min(ALWAYS, last), last):
            if self._unforeseen(always, view) <= MISSED_OF_ERROR * error:
                return always
        return max(last, ALWAYS)

    def learnable(self, error: float) -> bool:
        """Whether bins are made of so few functions of the light, to that relative error."""
        return bool(self.left <= error**2)

    def _unforeseen(self, always: int, view: float) -> float:
        """The relative root mean square error that nothing foretells, where levels up to `always` are seen whole."""
        found, surprise, missed = self.coefficients.copy(), np.zeros(self.coefficients.shape[:2]), 0.0
        tolerated = view**2 * self._scale()
        for number, level in enumerate(self.levels[1:], start=1):
            foretold = (level.combining @ found.reshape(len(found), -1)).reshape(-1, *found.shape[1:])
            off = ((found[level.bins] - foretold) ** 2).mean(axis=2)
            expected = DECAY**2 * (level.nearest @ surprise)
            seen = (expected > tolerated) | (number <= always)
            missed += float(off[~seen & (off > UNFORESEEN * (expected + tolerated))].sum())
            found[level.bins] = np.where(seen[..., None], found[level.bins], foretold)
            surprise[level.bins] = np.where(seen, off, expected)
            if number == ALWAYS:
                # The first levels were hardly foretold: they take after the last of them.
                for before in self.levels[:number]:
                    surprise[before.bins] = surprise[level.bins].mean(axis=0)
        signal = float((self.coefficients**2).mean(axis=2).sum())
        return float(np.sqrt(missed / signal)) if signal > 0.0 else 0.0

    def _scale(self) -> Array:
        known = np.concatenate([level.bins for level in self.levels[:SCALED_BY]])
        return np.asarray(np.maximum((self.coefficients[known] ** 2).mean(axis=(0, 2)), self.floor**2))
