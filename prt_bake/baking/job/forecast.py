"""How long a bake still takes until it has come to what it is for: from what its blocks have taken so far."""

import math
import time
from dataclasses import dataclass, field
from typing import Self

import numpy as np
from numpy.typing import NDArray

COST = 1.5
"""Evaluations grow with that power of 1 / error, at small errors."""
FROM_COARSE = 0.9
"""The same between a coarse pass and a fine one (0.7 to 1.1 on the shipped networks), until a pilot tells better."""
POWERS = 0.7, 3.0


class Standing(tuple[float, float, float]):
    """A row (seconds, evaluations, estimated relative error), and how long it still takes.

    Attributes:
        left: seconds until the target, as they are foretold; None where nothing tells.
        stage: what is being done, where a bake has several parts.
    """

    left: float | None
    stage: str

    def __new__(cls, row: tuple[float, float, float], left: float | None, stage: str = "") -> Self:
        """The row, with attributes."""
        standing = super().__new__(cls, row)
        standing.left, standing.stage = left, stage
        return standing


@dataclass(frozen=True)
class Forecast:
    """Of one pass over the vertices, and of what comes after it."""

    work: NDArray[np.float64]
    """What is to be done at each vertex [n] of the pass, in any unit; 0 where it is there already."""
    foretold: float | None = None
    """Seconds that a pilot says the pass takes."""
    after: float = 0.0
    """Times the pass's own seconds, that all that comes after it takes."""
    deadline: float = math.inf
    """By the monotonic clock."""
    began: float = field(default_factory=time.monotonic)

    def left(self, done: int) -> float | None:
        """Seconds until the target, once the first `done` vertices of the pass are."""
        now = time.monotonic()
        ours, whole = float(self.work[:done].sum()), float(self.work.sum())
        seconds = (now - self.began) * whole / ours if ours > 0.0 else self.foretold
        if whole == 0.0:
            seconds = 0.0
        by_time = self.deadline - now if math.isfinite(self.deadline) else None
        if seconds is None or not math.isfinite(self.after):
            return by_time
        by_target = max(0.0, seconds * (1.0 - (ours / whole if whole else 1.0)) + seconds * self.after)
        return by_target if by_time is None else max(0.0, min(by_target, by_time))


def power_of_error(rows: list[tuple[float, float, float]]) -> float:
    """The power of 1 / error that seconds grow with, from the rows (seconds, evaluations, error) of whole passes, each
    of which took what lies between its row and the one before.
    """
    taken = np.diff([0.0] + [row[0] for row in rows])
    errors = np.array([row[2] for row in rows])
    good = (taken > 0.0) & (errors > 0.0)
    if good.sum() < 2 or np.ptp(np.log(errors[good])) < math.log(1.2):
        return FROM_COARSE
    return float(np.clip(-np.polyfit(np.log(errors[good]), np.log(taken[good]), 1)[0], *POWERS))
