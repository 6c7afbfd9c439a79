"""What a training run says of itself while it goes on."""

import time
from dataclasses import dataclass

from prt_bake.trainer.samples.rows import Done


@dataclass(frozen=True)
class TrainingRow:
    """One line of progress; rates and shares are of the time since the line before.

    Attributes:
        seconds, step: how far the run has come, resumed or not.
        share: the same, from 0 to 1.
        loss: mean over the steps (less a constant behind an interface, where it is negative).
        validation: relative RMSE on held-out queries, of Ŝ, or of a_lm behind an interface.
        queries_per_second: rows learnt from.
        walks_per_second: walks that the renderer walked.
        walks: walks since the beginning.
        waited: share of the time that the learner waited for rows, fetching them included.
        walking: share of the time that the renderer walked; the rest went into handing over, or into its turn's wait.
        reuse: since the beginning, rows learnt from over rows rendered: above 1 rows are drawn again, below 1 some are
            never drawn. Of a file, passes over it.
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
    """Adds up what happens between two lines of progress."""

    def __init__(self, done: Done) -> None:
        """Start a line; `done` is what the source had done."""
        self._begun = time.perf_counter()
        self._done = done
        self._steps, self._rows = 0, 0
        self._loss, self._waited = 0.0, 0.0

    @property
    def seconds(self) -> float:
        """Since the line was begun."""
        return time.perf_counter() - self._begun

    def add_wait(self, seconds: float) -> None:
        """The learner waited."""
        self._waited += seconds

    def add_step(self, loss: float, rows: int) -> None:
        """The learner took a step from `rows`."""
        self._steps += 1
        self._rows += rows
        self._loss += loss

    @property
    def empty(self) -> bool:
        """Whether there is no step to tell of."""
        return self._steps == 0

    def row(self, seconds: float, step: int, share: float, learnt: int, done: Done, validation: float) -> TrainingRow:
        """The line; `seconds`, `step`, `share` say how far the run is, `learnt` from how many rows in all.

        `done` is what the source has done by now.
        """
        passed = max(self.seconds, 1e-9)
        return TrainingRow(
            seconds=seconds,
            step=step,
            share=share,
            loss=self._loss / max(self._steps, 1),
            validation=validation,
            queries_per_second=self._rows / passed,
            walks_per_second=(done.walks - self._done.walks) / passed,
            walks=done.walks,
            waited=min(1.0, self._waited / passed),
            walking=min(1.0, (done.walking - self._done.walking) / passed),
            reuse=learnt / max(done.rows, 1),
        )


def every_tenth(rows: list[TrainingRow]) -> list[TrainingRow]:
    """Of the lines, with the first and the last."""
    return rows[::10] if len(rows) % 10 == 1 else rows[::10] + rows[-1:]
