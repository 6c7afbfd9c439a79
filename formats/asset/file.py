"""An asset file being written: the HDF5 file, its open datasets, and the disk underneath."""

import contextlib
import math
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from formats.asset.chunk_writer import LEVEL, ChunkWriter
from formats.asset.head import FORMULAS, write_head
from formats.asset.record import AssetHead, Storage
from formats.hdf5_sink import Sink

_CHUNK_BYTES = 2**20


def chunk_vertices(shape: tuple[int, ...], storage: Storage) -> int:
    """Return how many whole vertices fit in a chunk of 1 MiB, at least one; `shape` is that of the dataset, [V,...]."""
    return max(1, min(shape[0], _CHUNK_BYTES // (math.prod(shape[1:]) * np.dtype(storage).itemsize)))


class AssetFile:
    """A new asset file with its head written; the datasets stay open, or every block would flush their chunks.

    Every method raises OSError if the disk does not take what is written.

    Attributes:
        file: the open h5py file.
    """

    def __init__(self, part: Path, head: AssetHead, shape: tuple[int, int, int, int], storage: Storage) -> None:
        """Open `part` anew for coefficients of this shape [V,B,K,C] and type."""
        self._sink = Sink(part)
        cache = max(2**22, 2 * math.prod(shape[1:]) * np.dtype(storage).itemsize)
        self.file: Any = h5py.File(self._sink, "w", rdcc_nbytes=cache)
        try:
            write_head(self.file, head)
            transfer = self.file.create_group("transfer")
            transfer.attrs.update(quantity=head.quantity, formula=FORMULAS[head.quantity], folded_in=head.folded_in)
            self._coefficients = _dataset(transfer, "coefficients", shape, storage)
            self._rows = ChunkWriter(self._coefficients)
            self._standard_error = _dataset(transfer, "standard_error", shape[:2], "float32")
            self.file.create_group("selftest")
            self.check()
        except BaseException:
            self.discard()
            raise

    def write(self, rows: slice, values: NDArray[np.floating], errors: NDArray[np.floating]) -> None:
        """Write the coefficients [n,B,K,C] and errors [n,B] of the vertices `rows`."""
        self._rows.write(rows, values)
        self._standard_error[rows] = errors
        self.check()

    def note(self, sentence: str) -> None:
        """Keep a sentence about the coefficients' type beside them."""
        self._coefficients.attrs["storage_note"] = sentence

    def check(self) -> None:
        """Raise the disk's fault, if there was one."""
        if self._sink.fault is not None:
            raise self._sink.fault

    def close(self) -> None:
        """Write what HDF5 still holds back, and close."""
        self._rows.finish()
        self.file.close()
        self.check()
        self._sink.close()

    def discard(self) -> None:
        """Close without caring for the contents."""
        self._sink.close()
        if hasattr(self, "_rows"):
            self._rows.discard()
        with contextlib.suppress(OSError, RuntimeError, ValueError):
            self.file.close()


def _dataset(group: Any, name: str, shape: tuple[int, ...], storage: Storage) -> Any:
    return group.create_dataset(
        name,
        shape,
        np.dtype(storage).newbyteorder("<"),
        chunks=(chunk_vertices(shape, storage), *shape[1:]),
        compression="gzip",
        compression_opts=LEVEL,
        shuffle=True,
    )
