"""The renderer beside the learner: a thread that walks all the time and a bounded buffer that hands its rows over.

The buffer is a ring. The renderer overwrites the oldest rows, the learner goes round and round through what is there:
queries are drawn at random already, and rows drawn at random once more would be learnt from unequally often, which
doubles the noise of walks where each is drawn once on average. The renderer may use every core, beside the learner.
It walks more often from each query while it is ahead of the learner and less often while the learner waits for it, and
rests only while it is a buffer's half ahead: rows that are overwritten before they are drawn would be walked in vain,
on cores that could learn. And where both share the cores, the learner waits rather than learn from rows more than
`reuse` times: new walks say more.
"""

import math
import threading
import time

import numpy as np
from numpy.typing import NDArray

from prt_bake.trainer.samples.rows import Batch, RowTracer, SourceStatistics, StreamSettings, render

__all__ = ["BackgroundRenderer", "RingBuffer", "StreamSettings", "render"]


_SHORT, _AMPLE = 1, 3
"""Batches ahead of the learner up to which the renderer walks less often from each query, and from which more often."""
_REST, _GLANCE = 0.002, 0.0005
"""Seconds between two looks of the renderer at how far ahead it is, and of the learner at what is there."""


class RingBuffer:
    """Rows with the numbers of their queries; see `prt_bake.trainer.samples.rows`."""

    def __init__(self, capacity: int) -> None:
        """Room for `capacity` rows of any width, which the first ones decide."""
        self._capacity = capacity
        self.rows = np.zeros((0, 0), np.float32)
        self.numbers: NDArray[np.int64] = np.zeros(capacity, np.int64)
        self.filled = 0
        self._next = self._read = 0
        self._lock = threading.Lock()

    def put(self, batch: Batch) -> None:
        """Append rows, over the oldest ones where there is no room."""
        capacity = self._capacity
        with self._lock:
            if not len(self.rows):
                self.rows = np.zeros((capacity, batch.rows.shape[1]), np.float32)
            at = (self._next + np.arange(len(batch.rows))) % capacity
            self.rows[at], self.numbers[at] = batch
            self._next = int((self._next + len(batch.rows)) % capacity)
            self.filled = min(capacity, self.filled + len(batch.rows))

    def draw(self, count: int) -> Batch:
        """The next `count` rows, from the first again after the last."""
        with self._lock:
            at = (self._read + np.arange(count)) % self.filled
            self._read = int((self._read + count) % self.filled)
            return Batch(self.rows[at], self.numbers[at])


class BackgroundRenderer:
    """Walks in a thread of its own until told to stop."""

    def __init__(
        self,
        walks: RowTracer,
        settings: StreamSettings,
        threads: int,
        least: int,
        state: dict[str, int] | None = None,
        reuse: float = math.inf,
    ) -> None:
        """`threads` cores are taken for the walks; `start` waits for `least` rows, `draw` for new ones where rows have
        been drawn `reuse` times on average; `state` is another's, to go on.
        """
        begun = state or {"next_query": 0, "walks": 0, "rows": 0}
        self.exits = walks.exits
        self._most = walks.walks_per_query
        walks.walks_per_query = walks.fewest
        self.buffer = RingBuffer(settings.capacity)
        self._walks, self._settings, self._threads = walks, settings, threads
        self._least, self.reuse = min(least, settings.capacity), reuse
        self._next_query, self._walked, self._rows = begun["next_query"], begun["walks"], begun["rows"]
        self._walking = 0.0
        self._drawn = self._rows
        self._fault: BaseException | None = None
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="prtbake-renderer", daemon=True)

    def start(self) -> None:
        """Start walking and return when the buffer holds enough to draw from; raises what broke the thread."""
        self._thread.start()
        while self.buffer.filled < self._least and self._thread.is_alive():
            time.sleep(0.005)
        self._check()

    def stop(self) -> None:
        """Finish the batch under way and end the thread."""
        self._stop.set()
        self._thread.join()

    def draw(self, count: int, generator: np.random.Generator) -> Batch:
        """The next `count` rows, the generator left alone; raises what broke the thread."""
        self._check()
        while self._drawn >= self.reuse * self._rows and self._thread.is_alive():
            time.sleep(_GLANCE)
        self._check()
        self._drawn += count
        return self.buffer.draw(count)

    def where(self, number: int) -> str:
        """Words that name a query by its number."""
        return self._walks.where(number)

    def done(self) -> SourceStatistics:
        """What the thread has done so far."""
        return SourceStatistics(self._walked, self._rows, self._walking)

    def state(self) -> dict[str, int]:
        """What it takes to go on from here, with queries that were not asked yet."""
        return {"next_query": self._next_query, "walks": self._walked, "rows": self._rows}

    def _check(self) -> None:
        if self._fault is not None:
            raise self._fault

    def _run(self) -> None:
        import numba

        numba.set_num_threads(self._threads)
        try:
            while not self._stop.is_set():
                ahead = self._rows - self._drawn
                if ahead > max(self._settings.capacity // 2, self._least):
                    time.sleep(_REST)
                    continue
                self._pace(ahead)
                self._one_batch()
        except BaseException as fault:
            self._fault = fault

    def _pace(self, ahead: int) -> None:
        """Walk a fifth more or less often from each query, by how many rows the learner has before it."""
        now, batch = self._walks.walks_per_query, self._settings.queries_a_batch
        if ahead <= _SHORT * batch:
            now -= max(1, now // 6)
        elif ahead >= _AMPLE * batch:
            now += max(1, now // 5)
        self._walks.walks_per_query = min(max(now, self._walks.fewest), self._most)

    def _one_batch(self) -> None:
        begun = time.perf_counter()
        walks = self._settings.queries_a_batch * self._walks.walks_per_query
        batch = self._walks.render(self._next_query, self._settings.queries_a_batch)
        self._walking += time.perf_counter() - begun
        self.buffer.put(batch)
        self._next_query += self._settings.queries_a_batch
        self._walked += walks
        self._rows += len(batch.rows)
