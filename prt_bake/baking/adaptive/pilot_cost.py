"""Cost of the trials of a pilot, and the time of one evaluation that follows from it."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class PilotCost:
    """New evaluations, evaluations from the cache, and seconds of one worker."""

    evaluations: int = 0
    recalled: int = 0
    seconds: float = 0.0

    def __add__(self, other: "PilotCost") -> "PilotCost":
        recalled = self.recalled + other.recalled
        return PilotCost(self.evaluations + other.evaluations, recalled, self.seconds + other.seconds)

    @property
    def requested(self) -> int:
        """All evaluations, new or from the cache."""
        return self.evaluations + self.recalled


def seconds_per_evaluation(trials: list[PilotCost]) -> float:
    """Seconds of one evaluation and its further processing, fitted to trials with different shares of cached values."""
    from scipy.optimize import nnls

    counts = np.array([[trial.evaluations, trial.requested] for trial in trials], np.float64)
    largest = max(counts.max(), 1.0)
    return float(nnls(counts / largest, [trial.seconds for trial in trials])[0].sum() / largest)
