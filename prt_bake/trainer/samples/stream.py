"""Renders training rows in a background thread and hands them to the learner through a ring buffer.

The renderer overwrites the oldest rows, and the learner reads the buffer in a circle. Queries are random already; rows
drawn at random from the buffer would be used unequally often, which doubles the noise of the walks if each row is drawn
once on average.

The renderer may use every core beside the learner. It traces more walks per query while it is ahead of the learner and
fewer while the learner waits, and it pauses only when it is half a buffer ahead: rows that are overwritten before they
are drawn would waste cores that could learn. If both share the cores, the learner waits instead of using rows more than
`reuse` times, since new walks carry more information.
"""

import math
import threading
import time

import numpy as np
from numpy.typing import NDArray

from prt_bake.trainer.samples.rows import Batch, RowTracer, SourceStatistics, StreamSettings

_FEW, _MANY = 1, 3
"""Batches ahead of the learner at which the renderer traces fewer walks per query, and at which it traces more."""
_PAUSE, _POLL = 0.002, 0.0005
"""Seconds between two checks by the renderer that is ahead, and by the learner that waits."""


class RingBuffer:
    """A ring of training rows and their query numbers (`prt_bake.trainer.samples.rows`)."""

    def __init__(self, capacity: int) -> None:
        """A buffer of `capacity` rows; the first rows determine the width."""
        self._capacity = capacity
        self.rows = np.zeros((0, 0), np.float32)
        self.numbers: NDArray[np.int64] = np.zeros(capacity, np.int64)
        self.filled = 0
        self._next = self._read = 0
        self._lock = threading.Lock()

    def put(self, batch: Batch) -> None:
        """Append rows, overwriting the oldest ones if the buffer is full."""
        capacity = self._capacity
        with self._lock:
            if not len(self.rows):
                self.rows = np.zeros((capacity, batch.rows.shape[1]), np.float32)
            at = (self._next + np.arange(len(batch.rows))) % capacity
            self.rows[at], self.numbers[at] = batch
            self._next = int((self._next + len(batch.rows)) % capacity)
            self.filled = min(capacity, self.filled + len(batch.rows))

    def draw(self, count: int) -> Batch:
        """The next `count` rows, starting again after the last."""
        with self._lock:
            at = (self._read + np.arange(count)) % self.filled
            self._read = int((self._read + count) % self.filled)
            return Batch(self.rows[at], self.numbers[at])


class BackgroundRenderer:
    """Traces rows in a separate thread until it is stopped."""

    def __init__(
        self,
        tracer: RowTracer,
        settings: StreamSettings,
        threads: int,
        least: int,
        state: dict[str, int] | None = None,
        reuse: float = math.inf,
    ) -> None:
        """Trace with `threads` threads; continue from `state` if given.

        `start` waits for `least` rows. `draw` waits for new rows once rows have been drawn `reuse` times on average.
        """
        begun = state or {"next_query": 0, "walks": 0, "rows": 0}
        self.exits, self.traced = tracer.exits, tracer.traced
        self._most_walks = tracer.walks_per_query
        tracer.walks_per_query = tracer.fewest_walks
        self.buffer = RingBuffer(settings.capacity)
        self._tracer, self._settings, self._threads = tracer, settings, threads
        self._least, self.reuse = min(least, settings.capacity), reuse
        self._next_query, self._walks, self._rows = begun["next_query"], begun["walks"], begun["rows"]
        self._walking = 0.0
        self._drawn = self._rows
        self._error: BaseException | None = None
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="prtbake-renderer", daemon=True)

    def start(self) -> None:
        """Start tracing and return once rows can be drawn; raises the thread's error."""
        self._thread.start()
        while self.buffer.filled < self._least and self._thread.is_alive():
            time.sleep(0.005)
        self._raise_error()

    def stop(self) -> None:
        """Finish the current batch and end the thread."""
        self._stop.set()
        self._thread.join()

    def draw(self, count: int) -> Batch:
        """The next `count` rows. Raises the thread's error."""
        self._raise_error()
        while self._drawn >= self.reuse * self._rows and self._thread.is_alive():
            time.sleep(_POLL)
        self._raise_error()
        self._drawn += count
        return self.buffer.draw(count)

    def describe(self, number: int) -> str:
        """A query's number, seed and face, for messages."""
        return self._tracer.describe(number)

    def statistics(self) -> SourceStatistics:
        """Walks and rows so far."""
        return SourceStatistics(self._walks, self._rows, self._walking)

    def state(self) -> dict[str, int]:
        """State to continue from, with queries that were not traced yet."""
        return {"next_query": self._next_query, "walks": self._walks, "rows": self._rows}

    def _raise_error(self) -> None:
        if self._error is not None:
            raise self._error

    def _run(self) -> None:
        import numba

        numba.set_num_threads(self._threads)
        try:
            while not self._stop.is_set():
                ahead = self._rows - self._drawn
                if ahead > max(self._settings.capacity // 2, self._least):
                    time.sleep(_PAUSE)
                    continue
                self._adapt_walks(ahead)
                self._trace_batch()
        except BaseException as error:
            self._error = error

    def _adapt_walks(self, ahead: int) -> None:
        """Change the walks per query by about a fifth, from the number of rows that the renderer is ahead."""
        walks, batch = self._tracer.walks_per_query, self._settings.queries_a_batch
        if ahead <= _FEW * batch:
            walks -= max(1, walks // 6)
        elif ahead >= _MANY * batch:
            walks += max(1, walks // 5)
        self._tracer.walks_per_query = min(max(walks, self._tracer.fewest_walks), self._most_walks)

    def _trace_batch(self) -> None:
        begun = time.perf_counter()
        walks = self._settings.queries_a_batch * self._tracer.walks_per_query
        batch = self._tracer.render(self._next_query, self._settings.queries_a_batch)
        self._walking += time.perf_counter() - begun
        self.buffer.put(batch)
        self._next_query += self._settings.queries_a_batch
        self._walks += walks
        self._rows += len(batch.rows)
