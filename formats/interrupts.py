"""Ctrl-C, kept waiting or only noticed while a library that cannot bear it is at work.

No library: the standard library sets handlers, but does not defer a signal until a block ends.
"""

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from types import FrameType


@contextlib.contextmanager
def deferred() -> Iterator[None]:
    """Hold an interrupt back until the block ends, then deliver it; only the main thread has interrupts."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    waiting: list[int] = []

    def remember(number: int, frame: FrameType | None) -> None:
        waiting.append(number)

    handler = signal.signal(signal.SIGINT, remember)
    try:
        yield
    finally:
        # None stands for a handler that was not set from Python, and cannot be set again from here.
        signal.signal(signal.SIGINT, signal.SIG_DFL if handler is None else handler)
        if waiting:
            signal.raise_signal(signal.SIGINT)


@contextlib.contextmanager
def noticed() -> Iterator[Callable[[], bool]]:
    """Yield a question that is answered with true once there was an interrupt, which then does nothing else; only the
    main thread has interrupts.
    """
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    seen: list[int] = []
    handler = signal.signal(signal.SIGINT, lambda number, _: seen.append(number))
    try:
        yield lambda: bool(seen)
    finally:
        signal.signal(signal.SIGINT, signal.SIG_DFL if handler is None else handler)
