"""What the learner takes next, made ready while it learns.

What a network is told of a view (where its ray runs, what it meets there) does not change while the network learns, and
takes up to half as long as learning from it. Threads beside the learner work it out for the next batches.
"""

from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from prt_bake.network.features.view_features import Told
from prt_bake.trainer.learner import Learner
from prt_bake.trainer.samples.rows import Batch, RowSource


class Ready(NamedTuple):
    """Rows, and what the network is told of their views."""

    batch: Batch
    told: Told | None


class Ahead:
    """Batches of a source for a learner, in the source's order."""

    def __init__(self, source: RowSource, learner: Learner, generator: np.random.Generator, threads: int) -> None:
        """As many batches as there are threads are made ready beforehand; with none, each when it is asked for."""
        self._source, self._learner, self._generator, self._threads = source, learner, generator, threads
        self._pool = ThreadPoolExecutor(threads, "prtbake-ahead") if threads else None
        self._coming: deque[Future[Ready]] = deque()

    def draw(self) -> Ready:
        """The next batch; raises what broke the source, once it is asked for what comes after this one."""
        if self._pool is None:
            return self._ready(self._rows())
        while len(self._coming) <= self._threads:
            self._coming.append(self._pool.submit(self._ready, self._rows()))
        return self._coming.popleft().result()

    def stop(self) -> None:
        """End the threads; what they have made ready is lost."""
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)

    def _rows(self) -> Batch:
        return self._source.draw(self._learner.settings.batch, self._generator)

    def _ready(self, batch: Batch) -> Ready:
        return Ready(batch, self._learner.told(batch))
