"""An asset file during writing: the HDF5 file, its open datasets and the file object underneath."""

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
    """Return the number of vertices in a chunk of 1 MiB, at least one, for a dataset of shape [V,...]."""
    return max(1, min(shape[0], _CHUNK_BYTES // (math.prod(shape[1:]) * np.dtype(storage).itemsize)))


class AssetFile:
    """A new asset file with its head written; the datasets stay open, because closing them would flush their chunks.

    Every method raises OSError if the disk is full or fails.

    Attributes:
        file: the open h5py file.
    """

    def __init__(self, part: Path, head: AssetHead, shape: tuple[int, int, int, int], storage: Storage) -> None:
        """Create the file `part` for coefficients of this shape [V,B,K,C] and type."""
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
            self.check()
        except BaseException:
            self.discard()
            raise

    def write(self, rows: slice, values: NDArray[np.floating], errors: NDArray[np.floating]) -> None:
        """Write the coefficients [n,B,K,C] and errors [n,B] of the vertices `rows`."""
        self._rows.write(rows, values)
        self._standard_error[rows] = errors
        self.check()

    def stored(self, vertices: NDArray[np.int64]) -> NDArray[np.floating]:
        """Return the coefficients [n,B,K,C] of ascending vertices as they are stored; nothing can be written after."""
        self._rows.finish()
        self.check()
        return np.asarray(self._coefficients[vertices])

    def note(self, sentence: str) -> None:
        """Store a sentence about the type of the coefficients as their attribute."""
        self._coefficients.attrs["storage_note"] = sentence

    def check(self) -> None:
        """Raise the first error of the disk, if any."""
        if self._sink.error is not None:
            raise self._sink.error

    def close(self) -> None:
        """Write all pending data and close."""
        self._rows.finish()
        self.file.close()
        self.check()
        self._sink.close()

    def discard(self) -> None:
        """Close and ignore errors."""
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
