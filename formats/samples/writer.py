"""Writes a sample file block by block, in constant memory."""

import contextlib
import datetime
import json
import os
from collections.abc import Iterator
from types import TracebackType
from typing import Any, Self

import h5py
import numpy as np
from numpy.typing import ArrayLike

from formats.atomic import replacing
from formats.errors import SamplesError
from formats.hdf5_sink import Sink
from formats.interrupts import deferred
from formats.samples.reader import DATASETS, FORMAT, FORMAT_VERSION, SamplesHead
from formats.version import program_version

_CHUNK_BYTES = 2**20


class SamplesWriter:
    """Writes one sample file: the head on creation, then blocks of queries, then `finish`.

    The write is atomic: the file grows under a temporary name and replaces `path` in `finish`.

    Attributes:
        count: number of queries written so far.
    """

    def __init__(self, path: str | os.PathLike[str], head: SamplesHead) -> None:
        """Open the file and write its head; raises StorageError if that fails."""
        self._path, self._directions = path, head.directions
        self.count = 0
        self._open, self._file = True, None
        self._stack = contextlib.ExitStack()
        part = self._stack.enter_context(replacing(path))
        try:
            with self._guarded():
                self._sink = Sink(part)
                self._file = h5py.File(self._sink, "w", libver="v110")  # its metadata has checksums
                _write_head(self._file, head)
                self._check()
        except BaseException as cause:
            self._abandon(cause)
            raise

    def append(
        self,
        keys: ArrayLike,
        positions: ArrayLike,
        outgoing: ArrayLike,
        incident: ArrayLike,
        mean: ArrayLike,
        standard_error: ArrayLike,
    ) -> None:
        """Append n queries: keys [n], positions and outgoing [n,3], incident, mean and standard_error [n,D,3].

        Raises:
            SamplesError: wrong shapes, or values that are not finite.
            StorageError: the disk is full; the writer is then closed.
        """
        arrays = (keys, positions, outgoing, incident, mean, standard_error)
        count = len(np.asarray(keys))
        lengths = {"N": count, "D": self._directions}
        blocks = {}
        for (name, (kind, axes)), values in zip(DATASETS.items(), arrays, strict=True):
            array = np.asarray(values)
            shape = tuple(int(axis) if axis.isdigit() else lengths[axis] for axis in axes)
            if array.shape != shape:
                raise SamplesError(f"{self._path}: {name} has shape {list(array.shape)}; expected {list(shape)}")
            with np.errstate(over="ignore", invalid="ignore"):
                block = array.astype(kind)
            if not (np.isfinite(array).all() and np.isfinite(block).all()):
                raise SamplesError(f"{self._path}: {name} has values that are not finite in {block.dtype}")
            blocks[name] = block
        with self._guarded():
            file = self._writable()
            for name, block in blocks.items():
                file[name].resize(self.count + count, axis=0)
                file[name][self.count :] = block
            self._check()
        self.count += count

    def finish(self, complete: bool = True) -> None:
        """Close the file and move it to `path`; `complete` is false if sampling was stopped early."""
        with self._guarded():
            file = self._writable()
            file.attrs["complete"] = np.uint8(complete)
            file.close()
            self._check()
            self._sink.close()
            self._stack.close()
        self._open = False

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, cause: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._abandon(cause)

    def _writable(self) -> Any:
        if not self._open:
            raise SamplesError(f"{self._path}: the writer is closed")
        return self._file

    def _check(self) -> None:
        if self._sink.error is not None:
            raise self._sink.error

    def _abandon(self, cause: BaseException | None) -> None:
        """Close without finishing; an error of the operating system about space or permission becomes StorageError."""
        if not self._open:
            return
        self._open = False
        cause = cause or SamplesError(f"{self._path}: the file was not finished")
        with deferred(), contextlib.suppress(SamplesError):
            if self._file is not None:
                self._sink.close()
                with contextlib.suppress(OSError, RuntimeError, ValueError):
                    self._file.close()
            self._stack.__exit__(type(cause), cause, cause.__traceback__)

    @contextlib.contextmanager
    def _guarded(self) -> Iterator[None]:
        with deferred():
            try:
                yield
            except OSError as cause:
                self._abandon(cause)
                raise


def _write_head(file: Any, head: SamplesHead) -> None:
    source = {"scene": head.scene, "scene_hash": head.scene_hash, "unit": head.unit, "settings": head.settings}
    texts = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "generator": f"prtbake {program_version()}",
        "created": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "source": json.dumps(source, allow_nan=False),
    }
    file.attrs.update({name: np.bytes_(text.encode()) for name, text in texts.items()})
    file.attrs.update(complete=np.uint8(0), seed=np.uint64(head.seed), walks=np.uint64(head.walks))
    for name, (kind, axes) in DATASETS.items():
        rest = tuple(int(axis) if axis.isdigit() else head.directions for axis in axes[1:])
        rows = max(1, _CHUNK_BYTES // (int(np.prod(rest)) * np.dtype(kind).itemsize))
        file.create_dataset(
            name,
            (0, *rest),
            np.dtype(kind),
            maxshape=(None, *rest),
            chunks=(rows, *rest),
            compression="gzip",
            compression_opts=1,
            shuffle=True,
            fletcher32=True,
        )
