"""Runs work on several threads and yields results in order.

`Executor.map` would take all items, and hold all results, at once: its `buffersize` came with Python 3.14.
"""

from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


def in_order(
    work: Callable[[Item], Result], items: Iterable[Item], workers: int, ahead: Callable[[], int] | None = None
) -> Generator[Result, None, None]:
    """Yields work(item) for every item, in order, computed by `workers` threads ahead of the consumer: by as many items
    as there are threads, or as `ahead()` returns.

    Exceptions of the work are raised here. Closing the iterator waits for the running items.
    """
    if workers <= 1:
        for item in items:
            yield work(item)
        return
    executor = ThreadPoolExecutor(workers)
    running: deque[Future[Result]] = deque()
    try:
        for item in items:
            running.append(executor.submit(work, item))
            while len(running) > (workers if ahead is None else ahead()):
                yield running.popleft().result()
        while running:
            yield running.popleft().result()
    finally:
        executor.shutdown(wait=True, cancel_futures=True)
