"""Loops of kernels shared out among threads.

A kernel of numba's own parallel loops is compiled several times over: as the loop's body, as what hands it out, and as
the function about both. Here it is an ordinary kernel that leaves Python's lock alone and does the rows of a slice.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from numba import get_num_threads

_PIECES_A_THREAD = 8


def in_threads(kernel: Callable[..., None], rows: int, *arguments: Any, least: int = 1) -> None:
    """Call kernel(first, last, *arguments), which leaves Python's lock alone, for slices that make up all of `rows`.

    As many threads as numba may use in this one (`numba.set_num_threads`) take slices of `least` rows or more; which
    rows come together and in which order must not matter. Raises what a kernel raises, when all threads have ended.
    """
    threads = min(get_num_threads(), -(-rows // least))
    if threads <= 1:
        kernel(0, rows, *arguments)
        return
    size = max(least, -(-rows // (threads * _PIECES_A_THREAD)))

    def one_slice(first: int) -> None:
        kernel(first, min(first + size, rows), *arguments)

    with ThreadPoolExecutor(threads, "prtbake-loop") as pool:
        # After an error or an interrupt, `map` cancels what has not begun.
        for _ in pool.map(one_slice, range(0, rows, size)):
            pass
