"""Loops of kernels shared out among threads.

A kernel of numba's own parallel loops is compiled several times over: as the loop's body, as what hands it out, and as
the function about both. Here it is an ordinary kernel that leaves Python's lock alone and does the rows of a slice.
"""

from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from numba import get_num_threads

_PIECES_A_THREAD = 8


def in_threads(kernel: Callable[..., None], rows: int, *arguments: Any, least: int = 1) -> None:
    """Call kernel(first, last, *arguments), which leaves Python's lock alone, for slices that make up all of `rows`.

    As many threads as numba may take in this one (`numba.set_num_threads`) draw slices of `least` rows or more; which
    rows come together and in which order must not matter. Raises what a kernel raises, when all threads have ended.
    """
    threads = min(get_num_threads(), -(-rows // least))
    if threads <= 1:
        kernel(0, rows, *arguments)
        return
    size = max(least, -(-rows // (threads * _PIECES_A_THREAD)))
    waiting = deque(range(0, rows, size))

    def work() -> None:
        while True:
            try:
                first = waiting.popleft()
            except IndexError:
                return
            kernel(first, min(first + size, rows), *arguments)

    with ThreadPoolExecutor(threads - 1, "prtbake-loop") as others:
        working = [others.submit(work) for _ in range(threads - 1)]
        try:
            work()
        finally:
            # After an interrupt nobody begins another slice.
            waiting.clear()
        for one in working:
            one.result()
