"""Rows in an order that depends on the seed alone: what a run that can be repeated to the last bit learns from.

Rows come in blocks, each shuffled by its own number, each passed over as often as is wanted. Where a run stands is one
number, the rows drawn so far; a block that it needs is made again from there.
"""

import time
from collections.abc import Callable

import numpy as np

from prt_bake.trainer.samples.rows import Batch, RowTracer, SourceStatistics, StreamSettings

_SHUFFLE_STREAM = 0x5F


class ShuffledRows:
    """An endless sequence of rows: passes over blocks of equal length, each in an order of its own."""

    def __init__(self, block: Callable[[int], Batch], rows: int, passes: int | None, seed: int, drawn: int = 0) -> None:
        """`block(k)` is block number k, of `rows` rows; after `passes` the next one follows, or never where None."""
        self.drawn = drawn
        self._block_of, self._rows, self._passes, self._seed = block, rows, passes, seed
        self._kept: tuple[int, Batch] | None = None
        self._order: tuple[int, np.ndarray] | None = None

    def draw(self, count: int) -> Batch:
        """The next `count` rows."""
        parts = []
        while count > 0:
            turn, at = divmod(self.drawn, self._rows)
            taken = min(count, self._rows - at)
            chosen = self._turn(turn)[at : at + taken]
            batch = self._block(0 if self._passes is None else turn // self._passes)
            parts.append(Batch(batch.rows[chosen], batch.numbers[chosen]))
            self.drawn += taken
            count -= taken
        return parts[0] if len(parts) == 1 else Batch(*(np.concatenate(pieces) for pieces in zip(*parts, strict=True)))

    def _turn(self, turn: int) -> np.ndarray:
        if self._order is None or self._order[0] != turn:
            generator = np.random.default_rng((_SHUFFLE_STREAM, self._seed, turn))
            self._order = turn, generator.permutation(self._rows)
        return self._order[1]

    def _block(self, number: int) -> Batch:
        if self._kept is None or self._kept[0] != number:
            self._kept = number, self._block_of(number)
        return self._kept[1]


class AlternatingRenderer:
    """A renderer that takes turns with the learner: whenever its rows are used up it walks on, in the same thread."""

    def __init__(
        self, walks: RowTracer, settings: StreamSettings, threads: int, seed: int, state: dict[str, int] | None = None
    ) -> None:
        """`threads` cores are taken for the walks, on which no number depends; `state` is another's, to go on."""
        self.exits = walks.exits
        self._walks, self._settings, self._threads = walks, settings, threads
        self._walking = 0.0
        self._blocks = 0 if state is None else state["blocks"]
        self._shuffled = ShuffledRows(
            self._render, settings.queries_a_batch, settings.reuse, seed, 0 if state is None else state["drawn"]
        )

    def start(self) -> None:
        """Nothing to wait for."""

    def stop(self) -> None:
        """Nothing goes on beside the learner."""

    def draw(self, count: int, generator: np.random.Generator) -> Batch:
        """The next `count` rows; the generator is left alone."""
        return self._shuffled.draw(count)

    def where(self, number: int) -> str:
        """Words that name a query by its number."""
        return self._walks.where(number)

    def done(self) -> SourceStatistics:
        """What the walks have come to; a block that had to be made again counts once."""
        queries = self._blocks * self._settings.queries_a_batch
        return SourceStatistics(queries * self._walks.walks_per_query, queries, self._walking)

    def state(self) -> dict[str, int]:
        """What it takes to go on from here."""
        return {"drawn": self._shuffled.drawn, "blocks": self._blocks}

    def _render(self, number: int) -> Batch:
        import numba

        before = numba.get_num_threads()
        numba.set_num_threads(self._threads)
        begun = time.perf_counter()
        try:
            batch = self._walks.render(number * self._settings.queries_a_batch, self._settings.queries_a_batch)
        finally:
            numba.set_num_threads(before)
        self._walking += time.perf_counter() - begun
        self._blocks = max(self._blocks, number + 1)
        return batch
