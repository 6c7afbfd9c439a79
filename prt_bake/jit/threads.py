"""Runs kernels on several threads: ordinary kernels with a slice of the rows each, and numba's parallel loops.

numba's parallel loops compile a kernel several times: the loop's body, its scheduler and the function around both. They
are for loops of less than a millisecond. `in_threads` takes an ordinary kernel that releases Python's lock (`nogil`).
"""

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

from numba import get_num_threads, set_num_threads

_PIECES_A_THREAD = 8
_processes: set[int] = set()
"""This process, once it has run a parallel loop. If it is forked, the child finds its parent here."""


@contextmanager
def using_threads(count: int) -> Iterator[int]:
    """Let numba's parallel loops use at most `count` threads.

    Raises RuntimeError in a process that was forked from one that had run such loops: numba would end it, since threads
    do not survive a fork.
    """
    _processes.add(os.getpid())
    if len(_processes) > 1:
        raise RuntimeError(
            "this process was forked from one that had drawn or shaded, whose threads it lacks; "
            "start it by multiprocessing.get_context('spawn'), or fork before the first use"
        )
    most = get_num_threads()
    set_num_threads(min(most, count))
    try:
        yield count
    finally:
        set_num_threads(most)


def in_threads(kernel: Callable[..., None], rows: int, *arguments: Any, least: int = 1) -> None:
    """Call kernel(first, last, *arguments), which must release Python's lock, for slices that cover all `rows`.

    Slices have at least `least` rows, except the last. The result must not depend on the slices or on their order. Uses
    as many threads as `numba.get_num_threads` returns in the calling thread. An exception of the kernel is raised after
    all threads have ended.
    """
    threads = min(get_num_threads(), -(-rows // least))
    if threads <= 1:
        kernel(0, rows, *arguments)
        return
    size = max(least, -(-rows // (threads * _PIECES_A_THREAD)))

    def one_slice(first: int) -> None:
        kernel(first, min(first + size, rows), *arguments)

    with ThreadPoolExecutor(threads, "prtbake-loop") as pool:
        # After an error or an interrupt, `map` cancels the slices that have not begun.
        for _ in pool.map(one_slice, range(0, rows, size)):
            pass
