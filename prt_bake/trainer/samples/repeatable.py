"""Training rows in an order that depends on the seed alone, for runs that repeat to the last bit.

Rows come in blocks. Each block is shuffled with its own random numbers and passed over a given number of times. The
state is a single number, the rows drawn so far; the block at that position is rendered again on resuming.
"""

import time
from collections.abc import Callable

import numpy as np

from prt_bake.trainer.samples.rows import Batch, RowTracer, SourceStatistics, StreamSettings

_SHUFFLE_STREAM = 0x5F


class ShuffledRows:
    """An endless sequence of rows: passes over blocks of equal length, each pass in a different order."""

    def __init__(self, block: Callable[[int], Batch], rows: int, passes: int | None, seed: int, drawn: int = 0) -> None:
        """`block(k)` returns block k, of `rows` rows. Block k + 1 follows after `passes` passes (None: never)."""
        self.drawn = drawn
        self._make_block, self._rows, self._passes, self._seed = block, rows, passes, seed
        self._last_block: tuple[int, Batch] | None = None
        self._last_order: tuple[int, np.ndarray] | None = None

    def draw(self, count: int) -> Batch:
        """The next `count` rows."""
        parts = []
        while count > 0:
            number, at = divmod(self.drawn, self._rows)
            taken = min(count, self._rows - at)
            chosen = self._order(number)[at : at + taken]
            batch = self._block(0 if self._passes is None else number // self._passes)
            parts.append(Batch(batch.rows[chosen], batch.numbers[chosen]))
            self.drawn += taken
            count -= taken
        return parts[0] if len(parts) == 1 else Batch(*(np.concatenate(pieces) for pieces in zip(*parts, strict=True)))

    def _order(self, number: int) -> np.ndarray:
        """The order of the rows in pass `number`."""
        if self._last_order is None or self._last_order[0] != number:
            generator = np.random.default_rng((_SHUFFLE_STREAM, self._seed, number))
            self._last_order = number, generator.permutation(self._rows)
        return self._last_order[1]

    def _block(self, number: int) -> Batch:
        if self._last_block is None or self._last_block[0] != number:
            self._last_block = number, self._make_block(number)
        return self._last_block[1]


class AlternatingRenderer:
    """A renderer that takes turns with the learner: it traces the next block in the same thread when rows run out."""

    def __init__(
        self, tracer: RowTracer, settings: StreamSettings, threads: int, seed: int, state: dict[str, int] | None = None
    ) -> None:
        """Trace with `threads` threads, which do not affect the result; continue from `state` if given."""
        self.exits, self.traced = tracer.exits, tracer.traced
        self._tracer, self._settings, self._threads = tracer, settings, threads
        self._walking = 0.0
        self._blocks = 0 if state is None else state["blocks"]
        self._shuffled = ShuffledRows(
            self._render, settings.queries_a_batch, settings.reuse, seed, 0 if state is None else state["drawn"]
        )

    def start(self) -> None:
        """Do nothing: rows are traced when they are drawn."""

    def stop(self) -> None:
        """Do nothing: no thread runs beside the learner."""

    def draw(self, count: int) -> Batch:
        """The next `count` rows."""
        return self._shuffled.draw(count)

    def describe(self, number: int) -> str:
        """A query's number, seed and face, for messages."""
        return self._tracer.describe(number)

    def statistics(self) -> SourceStatistics:
        """Walks and rows so far; a block that is rendered again after resuming counts once."""
        queries = self._blocks * self._settings.queries_a_batch
        return SourceStatistics(queries * self._tracer.walks_per_query, queries, self._walking)

    def state(self) -> dict[str, int]:
        """State to continue from."""
        return {"drawn": self._shuffled.drawn, "blocks": self._blocks}

    def _render(self, number: int) -> Batch:
        import numba

        threads_before = numba.get_num_threads()
        numba.set_num_threads(self._threads)
        begun = time.perf_counter()
        try:
            batch = self._tracer.render(number * self._settings.queries_a_batch, self._settings.queries_a_batch)
        finally:
            numba.set_num_threads(threads_before)
        self._walking += time.perf_counter() - begun
        self._blocks = max(self._blocks, number + 1)
        return batch
