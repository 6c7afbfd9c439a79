"""Ctrl-C and SIGTERM, deferred or turned into a flag while a library that cannot be interrupted is at work.

No library: the standard library sets handlers, but cannot defer a signal until a block ends.
"""

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator


@contextlib.contextmanager
def deferred() -> Iterator[None]:
    """Delay an interrupt until the block ends. Does nothing outside the main thread, which alone gets interrupts."""
    received: list[int] = []
    try:
        with _recorded(received):
            yield
    finally:
        if received:
            signal.raise_signal(received[0])


@contextlib.contextmanager
def interrupt_flag() -> Iterator[Callable[[], int]]:
    """Yield a function that returns the number of an interrupt, or 0; the interrupt does nothing else.

    Other threads than the main one receive no interrupts.
    """
    received: list[int] = []
    with _recorded(received):
        yield lambda: received[0] if received else 0


@contextlib.contextmanager
def _recorded(received: list[int]) -> Iterator[None]:
    """Add the numbers of interrupts to a list, in the main thread, and do nothing else with them."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    numbers = (signal.SIGINT, signal.SIGTERM)
    handlers = {number: signal.signal(number, lambda number, _: received.append(number)) for number in numbers}
    try:
        yield
    finally:
        for number, handler in handlers.items():
            # None means that it was not set from Python; Python cannot restore it.
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
