"""Reads a chunked HDF5 dataset and decompresses the chunks on several threads.

HDF5 itself decompresses chunk by chunk, at 220 MB/s, which is most of the time to open an asset.
"""

import math
import os
import sys
import zlib
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from formats.hdf5_strings import DamagedDataError

_GZIP_AND_SHUFFLE = (1, 2)
"""The ids of HDF5's filters."""


def can_read_chunks(dataset: Any) -> bool:
    """Whether a dataset is chunked along its first axis only, with exactly the filters shuffle and gzip."""
    native = dataset.dtype.isnative and sys.byteorder == "little"
    if dataset.chunks is None or dataset.chunks[1:] != dataset.shape[1:] or not native:
        return False
    filters = dataset.id.get_create_plist()
    ids = [filters.get_filter(index)[0] for index in range(filters.get_nfilters())]
    return sorted(ids) == list(_GZIP_AND_SHUFFLE)


def read_chunks(dataset: Any, rows: NDArray[np.floating], on_rows: Callable[[slice], None]) -> None:
    """Read a dataset into `rows`, an array of zeros of its shape and type; chunks that were never written stay 0.

    Args:
        dataset: an open dataset for which `can_read_chunks` is true.
        rows: the array to fill.
        on_rows: called with each slice of rows after it was read, on several threads.

    Raises:
        DamagedDataError: a chunk is damaged.
    """
    threads = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1

    def fill(chunk: tuple[int, bytes]) -> None:
        first, compressed = chunk
        part = slice(first, min(first + dataset.chunks[0], len(rows)))
        try:
            _decompress(compressed, math.prod(dataset.chunks), rows[part])
        except (zlib.error, ValueError) as cause:
            where = f"rows {part.start} to {part.stop - 1}"
            raise DamagedDataError(f"{dataset.name}: {where} cannot be decompressed") from cause
        on_rows(part)

    with ThreadPoolExecutor(threads) as executor:
        chunks = _written_chunks(dataset)
        # In batches, so that the compressed data is never completely in memory.
        while batch := list(islice(chunks, 4 * threads)):
            list(executor.map(fill, batch))


def _written_chunks(dataset: Any) -> Iterator[tuple[int, bytes]]:
    """Yield the first row and the bytes of each chunk that was written."""
    for number in range(dataset.id.get_num_chunks()):
        corner = dataset.id.get_chunk_info(number).chunk_offset
        skipped_filters, compressed = dataset.id.read_direct_chunk(corner)
        if skipped_filters:
            raise DamagedDataError(f"{dataset.name}: the chunk at row {corner[0]} lacks a filter that the others have")
        yield corner[0], compressed


def _decompress(compressed: bytes, count: int, rows: NDArray[np.floating]) -> None:
    """Fill `rows` with the first values of a chunk of `count` values."""
    size = rows.dtype.itemsize
    bits = rows.reshape(-1).view(f"u{size}")
    planes = np.frombuffer(zlib.decompress(compressed, bufsize=count * size), np.uint8).reshape(size, count)
    # Shifts are many times as fast as strided copies of bytes.
    bits[...] = planes[0, : len(bits)]
    for byte in range(1, size):
        bits |= np.left_shift(planes[byte, : len(bits)], 8 * byte, dtype=bits.dtype)
