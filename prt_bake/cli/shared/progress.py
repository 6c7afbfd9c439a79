"""Progress of long commands, messages beside their output, and Ctrl-C that stops them without losing work."""

import math
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from types import FrameType
from typing import TYPE_CHECKING, Protocol

from prt_bake.cli.shared import signals

if TYPE_CHECKING:
    from prt_bake.baking.job.forecast import BakeStatus

PLAIN_INTERVAL = 5.0
"""Seconds between two lines if stderr is not a terminal."""

NEARLY = 0.99
"""Largest share that a bake shows before its end: another pass may follow, and the asset is not yet written."""


class Report(Protocol):
    """Shows the progress of the work."""

    def __call__(self, share: float | None, text: str, left: float | None = None) -> None:
        """share: done, in [0, 1], or None if unknown. left: remaining seconds; by default extrapolated."""


def say(sentence: str) -> None:
    """Print a message on stderr, beside the command's own output."""
    print(f"prtbake: {sentence}", file=sys.stderr, flush=True)


@contextmanager
def reporting(label: str, first: str = "") -> Iterator[Report]:
    """Yield a function that shows the progress: as a bar on a terminal, else as a line every few seconds.

    The time left is extrapolated from the growth of the share since its first report, so that loading, compiling and
    the share of an earlier run do not count.

    Args:
        label: name of the work.
        first: text of the bar before the first report.
    """
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn

    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TaskProgressColumn(),
        TextColumn("{task.fields[left]}", markup=False),
        TextColumn("{task.fields[text]}", markup=False),
    )
    plain = not sys.stderr.isatty()
    last_line = time.monotonic()
    progress = Progress(
        *columns,
        console=Console(stderr=True),
        speed_estimate_period=math.inf,
        get_time=time.monotonic,
        disable=plain,
    )
    # Older versions of rich print an empty line when they leave a disabled bar.
    with nullcontext() if plain else progress:
        number = progress.add_task(label, total=1.0, text=first, left="")
        task = progress.tasks[0]

        def report(share: float | None, text: str, left: float | None = None) -> None:
            nonlocal last_line
            # Without a total the bar only pulses. `update` would forget the pace along with the old total.
            task.total = None if share is None else 1.0
            progress.update(number, completed=share or 0.0)
            seconds = task.time_remaining if left is None else left
            remaining = "" if seconds is None else f"{in_words(seconds)} left"
            progress.update(number, text=text, left=remaining)
            # A report without text is the last one; the command's output follows it.
            if plain and text and time.monotonic() - last_line >= PLAIN_INTERVAL:
                last_line = time.monotonic()
                percent = "" if share is None else f" {share:.0%}"
                line = ", ".join(part for part in (text, remaining) if part)
                print(f"{label}:{percent} {line}", file=sys.stderr, flush=True)

        yield report


def bake_progress(show: Report, requested: float | None = None) -> Callable[[int, int, "BakeStatus"], None]:
    """Return a bake's progress callback. It shows the share of the predicted time, which never decreases, and the error
    that decides, beside the `requested` one.
    """
    asked = "" if requested is None else f" ({100.0 * requested:g} % asked)"
    furthest = 0.0

    def report(done: int, total: int, status: "BakeStatus") -> None:
        nonlocal furthest
        seconds, left = status[0], status.left
        if left is not None:
            furthest = max(furthest, min(seconds / max(seconds + left, 1e-9), NEARLY))
        counted = f"{done} of {total} vertices" if status.figures is None else f"{status.figures}{asked}"
        show(None if left is None else furthest, ": ".join(filter(None, (status.stage, counted))), left)

    return report


def in_words(seconds: float) -> str:
    """Format a time: 42 s, 3:20 min, 2:05 h."""
    whole = round(seconds)
    if whole < 100:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60}:{whole % 60:02d} min"
    return f"{whole // 3600}:{whole % 3600 // 60:02d} h"


@contextmanager
def stopping() -> Iterator[Callable[[], bool]]:
    """Yield a function that returns True after the first Ctrl-C (or SIGTERM); the second one interrupts at once."""
    requested = False

    def request(number: int, frame: FrameType | None) -> None:
        nonlocal requested
        requested = True
        signals.record(number)
        signal.signal(number, signal.default_int_handler)
        say("stopping after the current step; press Ctrl-C again to stop at once")

    previous = {number: signal.signal(number, request) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: requested
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
