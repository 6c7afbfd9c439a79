"""Rows of a chunked HDF5 dataset, whole chunks of which are packed on several threads.

HDF5 itself packs in the thread that writes, one chunk after the other, at 24 MB/s: 9.5 of the 106 seconds that a bake
of spot to 1 % takes on one core (docs/baking.md) would stay serial.
Chunks that are written whole are shuffled and deflated here, just as its own filters do it, and handed to it as they
are; what is left of others goes the usual way.
"""

import os
import zlib
from collections import OrderedDict, deque
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import NDArray

LEVEL = 4
"""Of deflation: HDF5's own."""
MOST_OPEN = 16
"""Chunks that are kept until the rest of their rows come."""


class ChunkWriter:
    """Takes rows of a dataset that was made with `chunks`, gzip and shuffle, in any order."""

    def __init__(self, dataset: Any) -> None:
        self._dataset = dataset
        self._rows = dataset.chunks[0]
        self._open: OrderedDict[int, tuple[NDArray[Any], NDArray[np.bool_]]] = OrderedDict()
        self._there: set[int] = set()
        self._threads = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        self._executor = ThreadPoolExecutor(self._threads)
        self._packed: deque[tuple[int, Future[bytes]]] = deque()

    def write(self, rows: slice, values: NDArray[Any]) -> None:
        """Rows rows.start … rows.stop − 1 of the dataset; the array may change afterwards."""
        for number in range(rows.start // self._rows, (rows.stop - 1) // self._rows + 1):
            begin = number * self._rows
            first, last = max(rows.start, begin), min(rows.stop, begin + self._rows)
            self._part(number, slice(first - begin, last - begin), values[first - rows.start : last - rows.start])

    def finish(self) -> None:
        """Writes what is still under way. Nothing can be written afterwards."""
        while self._packed:
            self._hand_over()
        while self._open:
            self._give_up_oldest()
        self._executor.shutdown()

    def discard(self) -> None:
        """Drops what is still under way."""
        self._packed.clear()
        self._open.clear()
        self._executor.shutdown(cancel_futures=True)

    def _part(self, number: int, rows: slice, values: NDArray[Any]) -> None:
        begin = number * self._rows
        many = min(self._rows, self._dataset.shape[0] - begin)
        if number in self._there:
            # Its other rows went the usual way, or these are written again.
            while any(other == number for other, _packing in self._packed):
                self._hand_over()
            self._dataset[begin + rows.start : begin + rows.stop] = values
            return
        if number not in self._open:
            while len(self._open) >= MOST_OPEN:
                self._give_up_oldest()
            self._open[number] = np.zeros(self._dataset.chunks, self._dataset.dtype), np.zeros(many, bool)
        chunk, filled = self._open[number]
        chunk[rows], filled[rows] = values, True
        if filled.all():
            del self._open[number]
            self._there.add(number)
            self._packed.append((number, self._executor.submit(_packed, chunk)))
            while len(self._packed) > 2 * self._threads:
                self._hand_over()

    def _hand_over(self) -> None:
        """Writes the chunk that was packed first."""
        number, packing = self._packed.popleft()
        corner = (number * self._rows, *(0,) * (len(self._dataset.shape) - 1))
        self._dataset.id.write_direct_chunk(corner, packing.result())

    def _give_up_oldest(self) -> None:
        """Writes the rows that are there of a chunk, the usual way."""
        number, (chunk, filled) = self._open.popitem(last=False)
        self._there.add(number)
        begin = number * self._rows
        rows = np.flatnonzero(filled)
        for run in np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1):
            self._dataset[begin + run[0] : begin + run[-1] + 1] = chunk[run[0] : run[-1] + 1]


def _packed(chunk: NDArray[Any]) -> bytes:
    """As HDF5's filters have it: the first bytes of all values, then the second ones, and so on, deflated."""
    by_byte = chunk.reshape(-1).view(np.uint8).reshape(-1, chunk.itemsize).T
    return zlib.compress(by_byte.tobytes(), LEVEL)
