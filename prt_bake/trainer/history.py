"""Progress of a training run: measured between two reports, and kept as the run's history."""

import time
from dataclasses import dataclass

from prt_bake.trainer.samples.rows import SourceStatistics


@dataclass(frozen=True)
class TrainingProgress:
    """One progress report. Rates and shares cover the time since the report before.

    Attributes:
        seconds, step: training time and optimiser steps so far, earlier runs that were resumed included.
        share: the same as a share of the complete run, from 0 to 1.
        loss: mean over the steps; on a GPU it is looked at every 64th step. The loss of exits omits a constant and may
            be negative.
        validation: relative RMSE on held-out queries, of Ŝ, or of a_lm where the boundary bends light.
        queries_per_second: rows that the learner consumed.
        walks_per_second: walks that the renderer traced.
        walks: walks since the beginning.
        waited: share of the time that the learner waited for rows, the time to fetch them included.
        walking: share of the time that the renderer traced walks; 0 on a GPU, where it is not measured.
        reuse: rows consumed over rows rendered, since the beginning. Above 1 rows are used repeatedly, below 1 some are
            never used. With a file of samples: passes over the file.
    """

    seconds: float
    step: int
    share: float
    loss: float
    validation: float
    queries_per_second: float
    walks_per_second: float
    walks: int = 0
    waited: float = 0.0
    walking: float = 0.0
    reuse: float = 0.0


class Meter:
    """Accumulates steps, losses and waiting times between two progress reports."""

    def __init__(self, statistics: SourceStatistics) -> None:
        """Start measuring; `statistics` are the row source's at this moment."""
        self._begun = time.perf_counter()
        self._before = statistics
        self._steps, self._rows = 0, 0
        self._loss, self._waited = 0.0, 0.0

    @property
    def seconds(self) -> float:
        """Seconds since the meter was started."""
        return time.perf_counter() - self._begun

    def add_wait(self, seconds: float) -> None:
        """Add time that the learner waited."""
        self._waited += seconds

    def add_step(self, loss: float, rows: int) -> None:
        """Add an optimiser step on `rows` rows."""
        self._steps += 1
        self._rows += rows
        self._loss += loss

    @property
    def empty(self) -> bool:
        """Whether no step was added."""
        return self._steps == 0

    def progress(
        self, seconds: float, step: int, share: float, consumed: int, now: SourceStatistics, validation: float
    ) -> TrainingProgress:
        """The report; `seconds`, `step`, `share` and `consumed` rows are totals of the run, `now` of the source."""
        passed = max(self.seconds, 1e-9)
        return TrainingProgress(
            seconds=seconds,
            step=step,
            share=share,
            loss=self._loss / max(self._steps, 1),
            validation=validation,
            queries_per_second=self._rows / passed,
            walks_per_second=(now.walks - self._before.walks) / passed,
            walks=now.walks,
            waited=min(1.0, self._waited / passed),
            walking=min(1.0, (now.walking - self._before.walking) / passed),
            reuse=consumed / max(now.rows, 1),
        )


def every_tenth(reports: list[TrainingProgress]) -> list[TrainingProgress]:
    """Every tenth report, the first and the last included."""
    return reports[::10] if len(reports) % 10 == 1 else reports[::10] + reports[-1:]
