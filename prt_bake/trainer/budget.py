"""The wall time of a training run, and how its parts divide it.

A run prepares and path traces validation queries, learns, measures its final figures, and may end with a report and an
importance module. Learning takes the time that the other parts leave.
"""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple


class _Part(NamedTuple):
    """A part's share of the time, and its limits in seconds on a machine that does nothing else."""

    share: float
    least: float
    most: float

    def seconds(self, total: float, slowness: float = 1.0) -> float:
        """Seconds of the part in a run of `total` seconds."""
        return min(max(self.share * total, self.least * slowness), self.most)


_VALIDATION = _Part(0.04, 1.0, 30.0)
_FIGURES = _Part(0.04, 2.0, 40.0)
_REPORT = _Part(0.08, 9.0, 90.0)
_IMPORTANCE = _Part(0.04, 4.0, 60.0)
_AFTER_LEARNING = 0.4
"""Largest share of all parts after learning."""
_LEARNING = 0.5
"""Share of the time that learning keeps when kernels are compiled first, even if the run takes longer then."""
_LEAST_LEARNING = 0.25
"""Share of the time that learning gets at least."""
_LATE = 0.5
"""Share of its own time below which a part is left out, because earlier parts took too long."""
_SLOWEST = 3.0


class Budget:
    """The seconds that the parts of a training run may take, by the clock.

    >>> budget = Budget(minutes=10.0, report=True)
    >>> 400.0 < budget.learning(0.0) < 540.0
    True
    """

    def __init__(
        self, minutes: float, began: float | None = None, *, report: bool = False, importance: bool = False
    ) -> None:
        """`minutes` of wall time from `began` (`time.perf_counter()`, by default now).

        report, importance: whether these follow the training.
        """
        self.total = 60.0 * minutes
        self.began = time.perf_counter() if began is None else began
        self.earlier = 0.0
        """Seconds of earlier runs, which a resumed run continues."""
        self.extension = 0.0
        """Seconds that are added because kernels were compiled before learning."""
        self._compiled = self._counted = 0.0
        self._compilation: Any = None
        self._cpu = time.process_time()
        self._chosen = (1, report, importance)
        self._divide()

    def _divide(self) -> None:
        """Set the time of the parts after learning."""
        passed, busy = time.perf_counter() - self.began, time.process_time() - self._cpu
        slowness = min(max(1.0, passed / max(busy, 1e-9)), _SLOWEST) if passed > 1.0 else 1.0
        parts = (_FIGURES, _REPORT, _IMPORTANCE)
        wanted = [x * part.seconds(self.total, slowness) for x, part in zip(self._chosen, parts, strict=True)]
        scale = min(1.0, _AFTER_LEARNING * self.total / sum(wanted))
        self._figures, self._report, self._importance = (scale * seconds for seconds in wanted)

    @property
    def spent(self) -> float:
        """Seconds so far, those of earlier runs included."""
        return self.earlier + time.perf_counter() - self.began

    @property
    def left(self) -> float:
        """Seconds until the end of the run."""
        return max(0.0, self._length - self.spent)

    @contextmanager
    def counting_compilation(self) -> Iterator[None]:
        """Count the time in which kernels are compiled."""
        from numba.core.event import TimingListener, install_listener

        self._compilation = TimingListener()  # type: ignore[no-untyped-call]
        try:
            with install_listener("numba:compile", self._compilation):
                yield
        finally:
            self._compiled, self._compilation = self.compiling, None

    @property
    def compiling(self) -> float:
        """Seconds in which kernels were compiled."""
        now = self._compilation
        return self._compiled + (float(now.duration) if now is not None and now.done else 0.0)

    @property
    def _length(self) -> float:
        """Seconds of the run: kernels that are compiled after learning make it longer."""
        return self.total + self.extension + max(0.0, self.compiling - self._counted)

    @property
    def share(self) -> float:
        """The share of the time that is over."""
        return min(1.0, self.spent / self._length)

    @property
    def validation(self) -> float:
        """Seconds for path tracing the validation queries."""
        return min(_VALIDATION.seconds(self.total), 0.1 * self.total)

    def learning(self, learned: float) -> float:
        """Seconds that learning may still take, after `learned` seconds of it in this run and earlier ones.

        The parts after it get more time where other programs have slowed down the parts before it.
        """
        self._divide()
        self._counted = self.compiling
        after = self._figures + self._report + self._importance
        left = self._length - self.spent - after
        kept = min(left + self.compiling, _LEARNING * self.total - learned)
        self.extension += max(0.0, kept - left)
        return max(left, kept, _LEAST_LEARNING * self.total - learned, 0.0)

    def figures(self) -> float:
        """Seconds for the final figures, from now."""
        return max(self.left - self._report - self._importance, _LATE * self._figures)

    def report(self, importance: bool = True) -> float:
        """Seconds for the report, from now; 0 if they are too few because earlier parts took too long.

        importance: whether the importance module still follows.
        """
        left = self.left - (self._importance if importance else 0.0)
        return left if left >= _LATE * self._report else 0.0

    def importance(self) -> float:
        """Seconds for the importance module, from now; 0 if they are too few."""
        return self.left if self.left >= _LATE * self._importance else 0.0
