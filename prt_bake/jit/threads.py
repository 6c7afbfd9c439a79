"""Runs a kernel on several threads, each with a slice of the rows.

numba's own parallel loops compile a kernel several times: the loop's body, its scheduler and the function around both.
Here it is an ordinary kernel that releases Python's lock (`nogil`) and computes the rows of a slice.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from numba import get_num_threads

_PIECES_A_THREAD = 8


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
