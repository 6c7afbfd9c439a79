"""Prefetches batches and their view encodings while the learner works.

The encoding of a view (its ray through the object and what the ray meets) does not depend on the network's weights, and
computing it takes up to half as long as a training step. Threads beside the learner compute it for the next batches.
"""

from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np

from prt_bake.trainer.learner import Learner
from prt_bake.trainer.samples.rows import Batch, RowSource


class PreparedBatch(NamedTuple):
    """Rows, and the encoding of their views (None for networks that have none)."""

    batch: Batch
    encoding: Any


class Prefetcher:
    """Hands batches of a source to a learner, in the source's order."""

    def __init__(self, source: RowSource, learner: Learner, generator: np.random.Generator, threads: int) -> None:
        """`threads` batches are prepared in advance; with 0 each batch is prepared when it is drawn."""
        self._source, self._learner, self._generator, self._threads = source, learner, generator, threads
        self._pool = ThreadPoolExecutor(threads, "prtbake-prefetch") if threads else None
        self._pending: deque[Future[PreparedBatch]] = deque()

    def draw(self) -> PreparedBatch:
        """The next batch; raises the source's error as soon as prefetching meets it."""
        if self._pool is None:
            return self._prepare(self._rows())
        while len(self._pending) <= self._threads:
            self._pending.append(self._pool.submit(self._prepare, self._rows()))
        return self._pending.popleft().result()

    def stop(self) -> None:
        """End the threads and discard prefetched batches."""
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)

    def _rows(self) -> Batch:
        return self._source.draw(self._learner.settings.batch, self._generator)

    def _prepare(self, batch: Batch) -> PreparedBatch:
        return PreparedBatch(batch, self._learner.encode_views(batch))
