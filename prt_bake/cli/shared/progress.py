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

_BAR, _LEAST_BAR, _BESIDE_BAR = 40, 10, 68
"""Widths in characters: of the bar, of the narrowest one, and of what stands beside it."""

NEARLY = 0.99
"""Largest share that a bake shows before its end: another pass may follow, and the asset is not yet written."""


class Report(Protocol):
    """Shows the progress of the work."""

    def __call__(self, share: float | None, text: str, left: float | None = None, details: str = "") -> None:
        """share: done, in [0, 1], or None if unknown. left: remaining seconds; by default extrapolated.

        details: shown on terminals that are wide enough.
        """


def say(sentence: str) -> None:
    """Print a message on stderr, beside the command's own output."""
    print(f"prtbake: {sentence}", file=sys.stderr, flush=True)


@contextmanager
def reporting(label: str, first: str = "") -> Iterator[Report]:
    """Yield a function that shows the progress: as a bar on a terminal, else as a line every few seconds.

    Both say `label  42% · 3:10 left · text`; narrow terminals have no bar. The time left is extrapolated from the
    growth of the share since its first report, so that loading, compiling and the share of an earlier run do not count.

    Args:
        label: name of the work.
        first: text of the bar before the first report.
    """
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn

    plain = not sys.stderr.isatty()
    last_line = time.monotonic()
    console = Console(stderr=True)
    bar = min(_BAR, console.width - _BESIDE_BAR)
    columns = [TextColumn("{task.description}", markup=False), TextColumn("{task.fields[line]}", markup=False)]
    progress = Progress(
        *([columns[0], BarColumn(bar), columns[1]] if bar >= _LEAST_BAR else columns),
        console=console,
        speed_estimate_period=math.inf,
        get_time=time.monotonic,
        disable=plain,
    )
    # Older versions of rich print an empty line when they leave a disabled bar.
    with nullcontext() if plain else progress:
        number = progress.add_task(label, total=1.0, line=first)
        task = progress.tasks[0]

        def report(share: float | None, text: str, left: float | None = None, details: str = "") -> None:
            nonlocal last_line
            # Without a total the bar only pulses. `update` would forget the pace along with the old total.
            task.total = None if share is None else 1.0
            progress.update(number, completed=share or 0.0)
            seconds = task.time_remaining if left is None else left
            percent = "" if share is None else f"{share:.0%}"
            remaining = "" if seconds is None else f"{as_clock(seconds)} left"
            line = " · ".join(part for part in (percent, remaining, text) if part)
            room = console.width - len(label) - 2 - (bar + 1 if bar >= _LEAST_BAR else 0)
            detailed = f"{line} · {details}"
            shown = line if len(line) <= room else f"{line[: max(room, 1) - 1]}…"
            progress.update(number, line=detailed if details and len(detailed) <= room else shown)
            # A report without text is the last one; the command's output follows it.
            if plain and text and time.monotonic() - last_line >= PLAIN_INTERVAL:
                last_line = time.monotonic()
                print(f"{label}  {line}", file=sys.stderr, flush=True)

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


def as_clock(seconds: float) -> str:
    """Format a remaining time: 0:42, 3:20, 2:05 h."""
    whole = round(seconds)
    if whole < 3600:
        return f"{whole // 60}:{whole % 60:02d}"
    return f"{whole // 3600}:{whole % 3600 // 60:02d} h"


def in_words(seconds: float) -> str:
    """Format a time: 42 s, 3:20 min, 2:05 h."""
    whole = round(seconds)
    if whole < 100:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60}:{whole % 60:02d} min"
    return f"{whole // 3600}:{whole % 3600 // 60:02d} h"


class Stop:
    """Whether Ctrl-C was pressed, or SIGTERM sent.

    at_once: whether the first one interrupts at once, because the current work has nothing to finish.
    """

    def __init__(self) -> None:
        self.requested = self.at_once = False

    def __call__(self) -> bool:
        """Whether to stop."""
        return self.requested


@contextmanager
def stopping() -> Iterator[Stop]:
    """Yield a function that returns True after the first Ctrl-C (or SIGTERM); the second one interrupts at once."""
    stop = Stop()

    def request(number: int, frame: FrameType | None) -> None:
        stop.requested = True
        signals.record(number)
        signal.signal(number, signal.default_int_handler)
        if stop.at_once:
            raise KeyboardInterrupt
        say("stopping after the current step; press Ctrl-C again to stop at once")

    previous = {number: signal.signal(number, request) for number in signals.STOPPING}
    try:
        yield stop
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
