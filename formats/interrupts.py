"""Ctrl-C, deferred or turned into a flag while a library that cannot be interrupted is at work.

No library: the standard library sets handlers, but cannot defer a signal until a block ends.
"""

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from typing import Any


@contextlib.contextmanager
def deferred() -> Iterator[None]:
    """Delay an interrupt until the block ends. Does nothing outside the main thread, which alone gets interrupts."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    received: list[int] = []
    handler = signal.signal(signal.SIGINT, lambda number, _: received.append(number))
    try:
        yield
    finally:
        _restore(handler)
        if received:
            signal.raise_signal(signal.SIGINT)


@contextlib.contextmanager
def interrupt_flag() -> Iterator[Callable[[], bool]]:
    """Yield a function that returns whether there was an interrupt; the interrupt does nothing else.

    Other threads than the main one receive no interrupts.
    """
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    received: list[int] = []
    handler = signal.signal(signal.SIGINT, lambda number, _: received.append(number))
    try:
        yield lambda: bool(received)
    finally:
        _restore(handler)


def _restore(handler: Any) -> None:
    """Restore a handler. None means that it was not set from Python; Python cannot restore it."""
    signal.signal(signal.SIGINT, signal.SIG_DFL if handler is None else handler)
