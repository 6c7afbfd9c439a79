"""What a pass reports: the errors that it has measured so far, and the time that is left."""

import math
from collections.abc import Callable
from dataclasses import replace

from bakers.adaptive.calibration import Correction, Tally
from prt_bake.baking.job.forecast import BakeStatus, ErrorFigures, Forecast
from prt_bake.baking.job.work import Work

FIGURES = 100
"""How often a pass computes its errors."""


class PassProgress:
    """The status of a pass after each block.

    The correction of a first, coarse pass is only known when it is complete. Until then its errors are not reported,
    but they predict the time of what follows better than its tolerances do.
    """

    def __init__(
        self, forecast: Forecast, correction: Correction, vertices: int, time_after: Callable[[float], float]
    ) -> None:
        """time_after: time of what follows a pass with that error, over the time of the pass."""
        self._forecast, self._correction, self._vertices = forecast, correction, vertices
        self._time_after = time_after
        self._figures: ErrorFigures | None = None
        self._computed = 0

    def status(self, done: int, tally: Tally, work: Work, stage: str) -> BakeStatus:
        """After `done` vertices."""
        if tally.done.any() and (done * FIGURES // self._vertices > self._computed or done == self._vertices):
            self._computed = done * FIGURES // self._vertices
            self._measure(tally, done == self._vertices)
        error = math.nan if self._figures is None else self._figures.total
        row = work.seconds, float(work.evaluations + tally.new_evaluations), error
        return BakeStatus(row, self._forecast.left(done), stage, self._figures)

    def _measure(self, tally: Tally, complete: bool) -> None:
        correction = tally.correction(self._correction) if complete else self._correction
        figures, coarse = ErrorFigures(*tally.relative(correction)), self._correction == Correction()
        if coarse:
            self._forecast = replace(self._forecast, after=self._time_after(figures.worst))
        if complete or not coarse:
            self._figures = figures
