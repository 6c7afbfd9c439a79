"""What trials of a pilot take, and what that says of the time of one evaluation."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Spent:
    """By trials: evaluations, those that were recalled apart, and seconds of one worker."""

    evaluations: int = 0
    recalled: int = 0
    seconds: float = 0.0

    def __add__(self, other: "Spent") -> "Spent":
        recalled = self.recalled + other.recalled
        return Spent(self.evaluations + other.evaluations, recalled, self.seconds + other.seconds)

    @property
    def wanted(self) -> int:
        """Evaluations, those that were recalled among them."""
        return self.evaluations + self.recalled


def seconds_each(trials: list[Spent]) -> float:
    """Seconds of one evaluation, and of what is done with it, by trials of which some recalled more than others."""
    from scipy.optimize import nnls

    counts = np.array([[trial.evaluations, trial.wanted] for trial in trials], np.float64)
    largest = max(counts.max(), 1.0)
    return float(nnls(counts / largest, [trial.seconds for trial in trials])[0].sum() / largest)
