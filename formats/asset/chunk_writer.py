"""Writes a chunked HDF5 dataset and compresses the chunks on several threads.

HDF5 itself compresses in the writing thread, chunk by chunk, and a bake would wait for it. Complete chunks are shuffled
and deflated here, as by HDF5's filters, and written directly; rows of incomplete chunks go through HDF5.
"""

import os
import zlib
from collections import OrderedDict, deque
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import NDArray

LEVEL = 4
"""The deflation level, HDF5's default."""
MAX_OPEN = 16
"""Incomplete chunks that are held in memory."""


class ChunkWriter:
    """Writes rows, in any order, to a dataset with `chunks` along its first axis, gzip and shuffle."""

    def __init__(self, dataset: Any) -> None:
        self._dataset = dataset
        self._rows = dataset.chunks[0]
        self._open: OrderedDict[int, tuple[NDArray[Any], NDArray[np.bool_]]] = OrderedDict()
        self._closed: set[int] = set()
        self._threads = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        self._executor = ThreadPoolExecutor(self._threads)
        self._compressed: deque[tuple[int, Future[bytes]]] = deque()

    def write(self, rows: slice, values: NDArray[Any]) -> None:
        """Write the values of a slice of rows; the array may change afterwards."""
        for number in range(rows.start // self._rows, (rows.stop - 1) // self._rows + 1):
            begin = number * self._rows
            first, last = max(rows.start, begin), min(rows.stop, begin + self._rows)
            self._fill_chunk(number, slice(first - begin, last - begin), values[first - rows.start : last - rows.start])

    def finish(self) -> None:
        """Write all pending rows; the writer is then closed."""
        while self._compressed:
            self._write_oldest_compressed()
        while self._open:
            self._write_oldest_incomplete()
        self._executor.shutdown()

    def discard(self) -> None:
        """Drop all pending rows; the writer is then closed."""
        self._compressed.clear()
        self._open.clear()
        self._executor.shutdown(cancel_futures=True)

    def _fill_chunk(self, number: int, rows: slice, values: NDArray[Any]) -> None:
        begin = number * self._rows
        count = min(self._rows, self._dataset.shape[0] - begin)
        if number in self._closed:
            # The chunk was written incomplete, or its rows are written again.
            while any(other == number for other, _future in self._compressed):
                self._write_oldest_compressed()
            self._dataset[begin + rows.start : begin + rows.stop] = values
            return
        if number not in self._open:
            while len(self._open) >= MAX_OPEN:
                self._write_oldest_incomplete()
            self._open[number] = np.zeros(self._dataset.chunks, self._dataset.dtype), np.zeros(count, bool)
        chunk, filled = self._open[number]
        chunk[rows], filled[rows] = values, True
        if filled.all():
            del self._open[number]
            self._closed.add(number)
            self._compressed.append((number, self._executor.submit(_compress, chunk)))
            while len(self._compressed) > 2 * self._threads:
                self._write_oldest_compressed()

    def _write_oldest_compressed(self) -> None:
        """Write the chunk that was submitted first."""
        number, compressed = self._compressed.popleft()
        corner = (number * self._rows, *(0,) * (len(self._dataset.shape) - 1))
        self._dataset.id.write_direct_chunk(corner, compressed.result())

    def _write_oldest_incomplete(self) -> None:
        """Write the known rows of the oldest incomplete chunk through HDF5."""
        number, (chunk, filled) = self._open.popitem(last=False)
        self._closed.add(number)
        begin = number * self._rows
        rows = np.flatnonzero(filled)
        for run in np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1):
            self._dataset[begin + run[0] : begin + run[-1] + 1] = chunk[run[0] : run[-1] + 1]


def _compress(chunk: NDArray[Any]) -> bytes:
    """Apply HDF5's filters: shuffle (the first bytes of all values, then the second bytes, …) and deflate."""
    planes = chunk.reshape(-1).view(np.uint8).reshape(-1, chunk.itemsize).T
    return zlib.compress(planes.tobytes(), LEVEL)
