"""Rows of a chunked HDF5 dataset, unpacked on several threads: what `formats.asset.chunk_writer` packs, read back.

HDF5 itself unpacks one chunk after the other, at 220 MB/s, and that is the most of what opening an asset takes.
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

from formats.hdf5_file import Damage

_GZIP_AND_SHUFFLE = (1, 2)
"""The numbers of HDF5's filters."""


def unpacks(dataset: Any) -> bool:
    """Whether it is split along its first axis alone, and packed with shuffle and gzip and nothing else."""
    native = dataset.dtype.isnative and sys.byteorder == "little"
    if dataset.chunks is None or dataset.chunks[1:] != dataset.shape[1:] or not native:
        return False
    filters = dataset.id.get_create_plist()
    numbers = [filters.get_filter(place)[0] for place in range(filters.get_nfilters())]
    return sorted(numbers) == list(_GZIP_AND_SHUFFLE)


def read_chunks(dataset: Any, rows: NDArray[np.floating], look: Callable[[slice], None]) -> None:
    """Fill `rows`, an array of zeros of the dataset's shape and type, and `look` at each part once it is there.

    Chunks that were never written stay 0. `look` is called on several threads. Raises Damage (an OSError) for a chunk
    that is damaged.
    """
    threads = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1

    def fill(chunk: tuple[int, bytes]) -> None:
        first, packed = chunk
        part = slice(first, min(first + dataset.chunks[0], len(rows)))
        try:
            _unpack(packed, math.prod(dataset.chunks), rows[part])
        except (zlib.error, ValueError) as cause:
            raise Damage(f"{dataset.name}: rows {part.start} to {part.stop - 1} cannot be unpacked") from cause
        look(part)

    with ThreadPoolExecutor(threads) as executor:
        chunks = _written(dataset)
        # Few at a time: what is packed need not be in memory as a whole.
        while some := list(islice(chunks, 4 * threads)):
            list(executor.map(fill, some))


def _written(dataset: Any) -> Iterator[tuple[int, bytes]]:
    """The first row of each chunk that was written, and its bytes."""
    for number in range(dataset.id.get_num_chunks()):
        corner = dataset.id.get_chunk_info(number).chunk_offset
        left_out, packed = dataset.id.read_direct_chunk(corner)
        if left_out:
            raise Damage(f"{dataset.name}: the chunk of row {corner[0]} is not packed as the others are")
        yield corner[0], packed


def _unpack(packed: bytes, count: int, rows: NDArray[np.floating]) -> None:
    """Fill the first rows of a chunk of `count` values."""
    kind = rows.dtype.itemsize
    bits = rows.reshape(-1).view(f"u{kind}")
    by_byte = np.frombuffer(zlib.decompress(packed, bufsize=count * kind), np.uint8).reshape(kind, count)
    # Shifted into place, which is many times as fast as copying bytes that lie apart.
    bits[...] = by_byte[0, : len(bits)]
    for place in range(1, kind):
        bits |= np.left_shift(by_byte[place, : len(bits)], 8 * place, dtype=bits.dtype)
