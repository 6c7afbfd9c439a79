"""What a long command says while it works, and how Ctrl-C stops it without losing what is done."""

import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from prt_bake.baking.job.forecast import Standing

PLAIN_INTERVAL = 5.0
"""Seconds between two lines where there is no terminal."""


SETTLING = 2.0
"""Seconds of work before it is foretold how long it still takes."""
NEARLY = 0.99
"""Share of a bake that it does not exceed before its end: a further pass may follow, and the asset is to be written."""


class Report(Protocol):
    """Shows how far the work is."""

    def __call__(self, share: float | None, words: str, left: float | None = None) -> None:
        """share: done, in [0, 1]; None where there is no telling. left: seconds that it still takes; as the share has
        grown so far, by default.
        """


def say(sentence: str) -> None:
    """Tell the user something beside the command's own output."""
    print(f"prtbake: {sentence}", file=sys.stderr, flush=True)


@contextmanager
def reporting(label: str, first: str = "") -> Iterator[Report]:
    """Yield a function that shows how far the work is: as a bar on a terminal, in a line now and then elsewhere.

    first: what the bar says is done before there is anything to tell.
    """
    pace = _Pace()
    with _bar(label, first) if sys.stderr.isatty() else _lines(label) as show:

        def report(share: float | None, words: str, left: float | None = None) -> None:
            if left is None and share:
                left = pace.left(share)
            show(share, words, "" if left is None else f"{in_words(left)} left")

        yield report


class _Pace:
    """How long work still takes by how its share has grown since it was first told: what was before, such as loading,
    compiling or the share of an earlier run, is no measure of what is to come.
    """

    def __init__(self) -> None:
        self._first: tuple[float, float] | None = None

    def left(self, share: float) -> float | None:
        """Seconds; None where there is too little to go by."""
        now = time.monotonic()
        if self._first is None:
            self._first = now, share
        since, grown = now - self._first[0], share - self._first[1]
        return since * (1.0 - share) / grown if since >= SETTLING and grown > 0.0 else None


def bake_progress(show: Report) -> Callable[[int, int, "Standing"], None]:
    """What a bake tells, shown as its share of the time to its target; where what is left turns out longer than was
    foretold the share stays until the bake has caught up.
    """
    furthest = 0.0

    def told(done: int, total: int, standing: "Standing") -> None:
        nonlocal furthest
        seconds, _evaluations, error = standing
        left = standing.left
        if left is not None:
            furthest = max(furthest, min(seconds / max(seconds + left, 1e-9), NEARLY))
        stage = f"{standing.stage}: " if standing.stage else ""
        show(None if left is None else furthest, f"{stage}{done} of {total} vertices, error {error:.2%}", left)

    return told


def in_words(seconds: float) -> str:
    """A time as people say it: 42 s, 3:20 min, 2:05 h."""
    whole = round(seconds)
    if whole < 100:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60}:{whole % 60:02d} min"
    return f"{whole // 3600}:{whole % 3600 // 60:02d} h"


@contextmanager
def stopping() -> Iterator[Callable[[], bool]]:
    """Yield a question that is answered with true after the first Ctrl-C (or SIGTERM); the second one stops at once."""
    asked = False

    def ask(number: int, frame: FrameType | None) -> None:
        nonlocal asked
        asked = True
        signal.signal(number, signal.default_int_handler)
        say("stopping after what is under way; press Ctrl-C again to stop at once")

    previous = {number: signal.signal(number, ask) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: asked
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


@contextmanager
def _bar(label: str, first: str) -> Iterator[Callable[[float | None, str, str], None]]:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn

    columns = (
        TextColumn(label, markup=False),
        BarColumn(),
        TextColumn("{task.fields[share]:>4}", markup=False),
        TextColumn("{task.fields[left]}", markup=False),
        TextColumn("{task.fields[words]}", markup=False),
    )
    with Progress(*columns, console=Console(stderr=True)) as progress:
        task = progress.add_task(label, total=1.0, words=first, left="", share="0%")

        def report(share: float | None, words: str, left: str) -> None:
            # Without an end the bar only shows that something is done.
            progress.tasks[0].total = None if share is None else 1.0
            progress.update(task, completed=share or 0.0, words=words, left=left, share=_percent(share))

        yield report


@contextmanager
def _lines(label: str) -> Iterator[Callable[[float | None, str, str], None]]:
    last = time.monotonic()

    def report(share: float | None, words: str, left: str) -> None:
        nonlocal last
        # Nothing to tell is the end, which what the command prints then tells as well.
        if words and time.monotonic() - last >= PLAIN_INTERVAL:
            last = time.monotonic()
            said = ", ".join(part for part in (words, left) if part)
            print(f"{label}: {_percent(share)} {said}".replace("  ", " "), file=sys.stderr, flush=True)

    yield report


def _percent(share: float | None) -> str:
    return "" if share is None else f"{share:.0%}"
