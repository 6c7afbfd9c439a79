"""Prefetches batches and their view encodings while the learner works.

The encoding of a view (its ray through the object and what the ray meets) does not depend on the network's weights, and
computing it takes up to half as long as a training step. Threads beside the learner compute it for the next batches.
"""

import itertools
from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, NamedTuple, TypeVar

from prt_bake.trainer.learning.learner import Learner
from prt_bake.trainer.samples.rows import Batch, RowSource

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


class PreparedBatch(NamedTuple):
    """Rows, and the encoding of their views (None for networks that have none)."""

    batch: Batch
    encoding: Any


class Prefetcher:
    """Hands batches of a source to a learner, in the source's order."""

    def __init__(self, source: RowSource, learner: Learner, threads: int) -> None:
        """`threads` batches are prepared in advance; with 0 each batch is prepared when it is drawn."""
        batches = (source.draw(learner.settings.batch) for _ in itertools.count())
        self._prepared = in_advance(lambda batch: PreparedBatch(batch, learner.encode_views(batch)), batches, threads)

    def draw(self) -> PreparedBatch:
        """The next batch; raises the source's error as soon as prefetching meets it."""
        return next(self._prepared)

    def stop(self) -> None:
        """End the threads and discard prefetched batches."""
        self._prepared.close()


def in_advance(
    function: Callable[[_Item], _Result], items: Iterable[_Item], threads: int
) -> Generator[_Result, None, None]:
    """The function's result for each item, in order; `threads` threads compute as many results in advance."""
    if threads == 0:
        yield from map(function, items)
        return
    pending: deque[Future[_Result]] = deque()
    pool = ThreadPoolExecutor(threads, "prtbake-prefetch")
    try:
        for item in items:
            pending.append(pool.submit(function, item))
            if len(pending) > threads:
                yield pending.popleft().result()
        while pending:
            yield pending.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)
