"""The renderer beside the learner: a thread that walks all the time and a bounded buffer that hands its values over.

The buffer is a ring. The renderer overwrites the oldest values, the learner draws at random from what is there:
neither waits for the other, but for the first fill.
"""

import threading
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prt_bake.trainer.prepared import PreparedScene
from prt_bake.trainer.queries import Queries, QuerySource


@dataclass(frozen=True)
class StreamSettings:
    """How the renderer asks; chosen by measured error after equal time (`make bench`)."""

    queries_a_batch: int = 4096
    directions: int = 8
    walks: int = 1
    connections: int = 4
    capacity: int = 1 << 20
    """Values that the buffer holds."""


class RingBuffer:
    """Values Ŝ [M,3] with their queries, float32: incident [M,3], positions [M,3] relative to the box, outgoing
    [M,3].
    """

    def __init__(self, capacity: int) -> None:
        """Room for `capacity` values."""
        self.rows = np.zeros((capacity, 12), np.float32)
        self.filled = 0
        self._next = 0
        self._lock = threading.Lock()

    def put(self, rows: NDArray[np.float32]) -> None:
        """Append rows [M,12], over the oldest ones where there is no room."""
        capacity = len(self.rows)
        with self._lock:
            at = (self._next + np.arange(len(rows))) % capacity
            self.rows[at] = rows
            self._next = int((self._next + len(rows)) % capacity)
            self.filled = min(capacity, self.filled + len(rows))

    def draw(self, count: int, generator: np.random.Generator) -> NDArray[np.float32]:
        """Rows [count,12] at random, with replacement."""
        with self._lock:
            return self.rows[generator.integers(0, self.filled, count)]


class Renderer:
    """Walks in a thread of its own until told to stop; `buffer` holds what it found, `walks` how much it did."""

    def __init__(
        self,
        prepared: PreparedScene,
        box_min: NDArray[np.float64],
        box_side: float,
        settings: StreamSettings,
        seed: int,
        first: int,
        threads: int,
    ) -> None:
        """Begin at query number `first`; `threads` cores are taken for the walks."""
        self.buffer = RingBuffer(settings.capacity)
        self.settings = settings
        self.next_query = first
        self.walks = 0
        self.values = 0
        self.fault: BaseException | None = None
        self._prepared, self._seed, self._threads = prepared, seed, threads
        self._box_min, self._box_side = box_min, box_side
        self._source = QuerySource(prepared, settings.directions, seed)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="prtbake-renderer", daemon=True)

    def start(self, least: int) -> None:
        """Start walking and return when the buffer holds `least` values; raises what broke the thread."""
        self._thread.start()
        while self.buffer.filled < least and self._thread.is_alive():
            time.sleep(0.01)
        self.check()

    def check(self) -> None:
        """Raise what broke the renderer, if anything did."""
        if self.fault is not None:
            raise self.fault

    def stop(self) -> None:
        """Finish the batch under way and end the thread."""
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        import numba

        numba.set_num_threads(self._threads)
        try:
            while not self._stop.is_set():
                self._one_batch()
        except BaseException as fault:
            self.fault = fault

    def _one_batch(self) -> None:
        settings = self.settings
        queries = self._source.draw(self.next_query, settings.queries_a_batch)
        mean = render(self._prepared, self._source, queries, settings.walks, settings.connections, self._seed)[0]
        self.buffer.put(self._rows(queries, mean))
        self.next_query += settings.queries_a_batch
        self.walks += settings.queries_a_batch * settings.walks
        self.values += mean.shape[0] * mean.shape[1]

    def _rows(self, queries: Queries, mean: NDArray[np.float64]) -> NDArray[np.float32]:
        shape = mean.shape
        rows = np.empty((*shape[:2], 12), np.float32)
        rows[..., 0:3] = queries.incident
        rows[..., 3:6] = ((queries.positions - self._box_min) / self._box_side)[:, None]
        rows[..., 6:9] = queries.outgoing[:, None]
        rows[..., 9:12] = mean
        return rows.reshape(-1, 12)


def render(
    prepared: PreparedScene, source: QuerySource, queries: Queries, walks: int, connections: int, seed: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Ŝ [N,D,3] of queries and its standard error (NaN for a single walk)."""
    from prt_bake.trainer.kernels import sum_transport

    count, directions = queries.incident.shape[:2]
    chunks = np.stack([np.arange(count), np.zeros(count, int), np.full(count, walks)], axis=1)
    sums = np.zeros((count, 4, directions * 3 + 4))
    placed: tuple[Any, ...] = source.for_kernel(queries)
    sum_transport(
        prepared.boundary,
        prepared.medium,
        placed,
        chunks,
        queries.incident,
        connections,
        prepared.aims,
        seed,
        sums,
    )
    mean = sums[:, 0, :-4] / walks
    with np.errstate(invalid="ignore", divide="ignore"):
        error = (
            np.sqrt(np.maximum(sums[:, 1, :-4] / walks - mean**2, 0.0) / (walks - 1)) if walks > 1 else mean * np.nan
        )
    return mean.reshape(count, directions, 3), error.reshape(count, directions, 3)
