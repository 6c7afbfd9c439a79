"""What a long command says while it works, and how Ctrl-C stops it without losing what is done."""

import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

PLAIN_INTERVAL = 5.0
"""Seconds between two lines where there is no terminal."""

Report = Callable[[float, str], None]
"""report(share done in [0, 1], a few words)."""


def say(sentence: str) -> None:
    """Tell the user something beside the command's own output."""
    print(f"prtbake: {sentence}", file=sys.stderr, flush=True)


@contextmanager
def reporting(label: str) -> Iterator[Report]:
    """Yield a function that shows how far the work is: as a bar on a terminal, in a line now and then elsewhere."""
    with _bar(label) if sys.stderr.isatty() else _lines(label) as report:
        yield report


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
def _bar(label: str) -> Iterator[Report]:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn(label, markup=False),
        BarColumn(),
        TaskProgressColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[words]}", markup=False),
    )
    with Progress(*columns, console=Console(stderr=True)) as progress:
        task = progress.add_task(label, total=1.0, words="")
        yield lambda share, words: progress.update(task, completed=share, words=words)


@contextmanager
def _lines(label: str) -> Iterator[Report]:
    last = time.monotonic()

    def report(share: float, words: str) -> None:
        nonlocal last
        if time.monotonic() - last >= PLAIN_INTERVAL:
            last = time.monotonic()
            print(f"{label}: {share:.0%} {words}", file=sys.stderr, flush=True)

    yield report
