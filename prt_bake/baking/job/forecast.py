"""Progress of a bake and a forecast of the time that it still takes, extrapolated from the blocks done so far."""

import math
import time
from dataclasses import dataclass, field
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

COST_EXPONENT = 1.5
"""Evaluations grow with this power of 1 / error, at small errors."""
COARSE_EXPONENT = 0.9
"""The same from a coarse pass to a fine one: 0.7 to 1.1 on the shipped networks. Used until two passes are measured."""
EXPONENT_RANGE = 0.7, 3.0


class ErrorFigures(NamedTuple):
    """Estimated relative RMSE so far."""

    total: float
    """Of the object."""
    percentile_95: float
    """95th percentile over vertices."""

    @property
    def worst(self) -> float:
        """The figure that decides whether a requested error is reached."""
        return max(self)

    def __str__(self) -> str:
        name = "object" if self.total > self.percentile_95 else "95 % of vertices"
        return f"{name} {100.0 * self.worst:.2g} %"


class BakeStatus(tuple[float, float, float]):
    """A row (seconds, evaluations, estimated relative error) of a bake in progress; the error is nan until measured.

    Attributes:
        left: predicted seconds until the target; None without a prediction.
        stage: which part of the bake runs, empty for bakes of one part.
        figures: the errors so far; None until they are measured.
    """

    left: float | None
    stage: str
    figures: ErrorFigures | None

    def __new__(
        cls,
        row: tuple[float, float, float],
        left: float | None,
        stage: str = "",
        figures: ErrorFigures | None = None,
    ) -> Self:
        """The row, with attributes."""
        status = super().__new__(cls, row)
        status.left, status.stage, status.figures = left, stage, figures
        return status


@dataclass(frozen=True)
class Forecast:
    """Time of one pass over the vertices, and of the work that follows it."""

    work: NDArray[np.float64]
    """Work at each vertex [n] of the pass, in any unit; 0 where it was done before."""
    predicted: float | None = None
    """Seconds of the pass according to a pilot."""
    after: float = 0.0
    """Time of all work after the pass, over that of the pass."""
    deadline: float = math.inf
    """By the monotonic clock."""
    began: float = field(default_factory=lambda: time.monotonic())

    def of_pass(self, done: int) -> float | None:
        """Predicted seconds of the whole pass, after its first `done` vertices; None without a prediction."""
        work_done, total_work = float(self.work[:done].sum()), float(self.work.sum())
        if total_work == 0.0:
            return 0.0
        return (time.monotonic() - self.began) * total_work / work_done if work_done > 0.0 else self.predicted

    def left(self, done: int) -> float | None:
        """Predicted seconds until the target, after the first `done` vertices of the pass."""
        now = time.monotonic()
        work_done, total_work = float(self.work[:done].sum()), float(self.work.sum())
        seconds = self.of_pass(done)
        by_deadline = self.deadline - now if math.isfinite(self.deadline) else None
        if seconds is None or not math.isfinite(self.after):
            return by_deadline
        remaining = 1.0 - (work_done / total_work if total_work else 1.0)
        by_target = max(0.0, seconds * remaining + seconds * self.after)
        return by_target if by_deadline is None else max(0.0, min(by_target, by_deadline))


def error_exponent(rows: list[tuple[float, float, float]]) -> float:
    """The power of 1 / error by which the time of a pass grows, fitted to rows (seconds, evaluations, error) after
    complete passes. A pass took the difference between its seconds and those of the row before.
    """
    seconds = np.diff([0.0] + [row[0] for row in rows])
    errors = np.array([row[2] for row in rows])
    usable = (seconds > 0.0) & (errors > 0.0)
    if usable.sum() < 2 or np.ptp(np.log(errors[usable])) < math.log(1.2):
        return COARSE_EXPONENT
    return float(np.clip(-np.polyfit(np.log(errors[usable]), np.log(seconds[usable]), 1)[0], *EXPONENT_RANGE))
