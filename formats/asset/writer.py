"""Writes an asset in blocks of vertices, in constant memory."""

import contextlib
import json
import math
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import h5py
import numpy as np
from numpy.typing import NDArray

from formats.asset.asset_file import AssetFile, chunk_vertices
from formats.asset.compact_file import write_compact
from formats.asset.compact_record import CompactCoefficients
from formats.asset.error_covariance import ErrorCovariance, write_covariance
from formats.asset.head import FORMULAS
from formats.asset.lobes import Lobes, write_lobes
from formats.asset.record import Asset, AssetHead, Storage
from formats.asset.selftest import write_selftest
from formats.atomic import replacing, temporary_path
from formats.errors import AssetError
from formats.interrupts import deferred

_FLOAT16_LIMIT = 65520.0  # the smallest number that float16 rounds to infinity
_ROUNDING_LIMIT = 0.1  # largest error of rounding to float16, relative to the error of the coefficients


class AssetWriter:
    """Writes one asset: the head on creation, then blocks of vertices in any order, then `finish`.

    The write is atomic: the file grows under a temporary name and replaces `path` in `finish`. If the context ends
    without `finish`, the temporary file is removed and an older file is unchanged.

    float16 changes to float32 if a coefficient exceeds 65504, or if the rounding error (root mean square over all
    blocks so far) exceeds a tenth of the standard error and of the network's error, added as squares. The blocks so far
    are then written again.

    Attributes:
        block_vertices: vertices in a chunk of the file; blocks aligned to its multiples are written fastest.
        shape: of the coefficients, [V,B,K,C].
        valid: [V], 1 for vertices that were written.
        storage: the current type in the file, "float16" or "float32".
        storage_note: the reason for the change to float32, one sentence, or empty.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        head: AssetHead,
        *,
        storage: Storage = "float16",
        views: int | None = None,
        channels: int = 3,
    ) -> None:
        """Open the file and write its head.

        Args:
            path: the file of the finished asset.
            head: the head of the asset; an `Asset` is one too.
            storage: the preferred type, "float16" or "float32".
            views: length of the view axis: B (default), or 1 if the view does not matter.
            channels: length of the channel axis: 3, or 1 if the channels are equal.
        """
        _refuse_invalid(path, head, views, channels)
        self._path, self._head = path, head
        terms = 1 if head.quantity == "radiance" else (head.degree + 1) ** 2
        self.shape = (len(head.mesh.positions), views or len(head.directions), terms, channels)
        self.storage: Storage = storage
        self.storage_note = ""
        self.block_vertices = chunk_vertices(self.shape, storage)
        self.valid = np.zeros(self.shape[0], np.uint8)
        self._rounding_sum = 0.0
        self._error_sum = 0.0
        self._network_error = 0.0 if head.network_error is None else head.network_error.value
        self._finished = False
        self._file: AssetFile | None = None
        self._stack = contextlib.ExitStack()
        self._part = self._stack.enter_context(replacing(path))
        try:
            with self._guarded():
                self._file = AssetFile(self._part, head, self.shape, storage)
        except BaseException as cause:
            self._abandon(cause)
            raise

    def write_block(
        self, first_vertex: int, coefficients: NDArray[np.floating], standard_error: NDArray[np.floating]
    ) -> None:
        """Write a block of vertices and mark them as valid.

        Args:
            first_vertex: index of the block's first vertex.
            coefficients: [n,B,K,C], of the axis lengths given on creation.
            standard_error: [n,B] or [n,1], one sigma, root mean square over K and C.

        Raises:
            AssetError: wrong shapes, values that are not finite, negative errors.
            StorageError: the disk is full; the writer is then closed.
        """
        rows = slice(first_vertex, first_vertex + len(coefficients))
        values, errors = self._check_block(rows, coefficients, standard_error)
        with self._guarded():
            if self.storage == "float16" and (reason := self._float16_problem(values, errors)):
                self._widen(reason)
            self._open.write(rows, values.astype(self.storage), errors)
        self.valid[rows] = 1

    def stored(self, vertices: NDArray[np.int64]) -> NDArray[np.floating]:
        """Return the coefficients [n,B,K,C] of ascending vertices as they are stored; only `finish` may follow.

        Raises:
            StorageError: the disk is full; the writer is then closed.
        """
        with self._guarded():
            return self._open.stored(vertices)

    def finish(
        self,
        provenance: Mapping[str, Any],
        error_vs_time: NDArray[np.floating] | None = None,
        selftest: Mapping[str, NDArray[Any]] | None = None,
        complete: bool = True,
        error_covariance: ErrorCovariance | None = None,
        lobes: Lobes | None = None,
    ) -> str:
        """Write the results of the bake, close the file and move it to `path`.

        Args:
            provenance: JSON values: command, resolved settings, seed, hashes, device, credits, eta.
            error_vs_time: [rows,3]: seconds, evaluations, estimated relative error.
            selftest: light [K,3], vertex [S], outgoing [S,3], radiance [S,3]; optional: sun [3], lobes [S,3].
            complete: false for a bake that was stopped early; vertices never written have valid = 0.
            error_covariance: covariance of the errors of each vertex, if known.
            lobes: what the transport holds beyond the harmonics, if known.

        Returns:
            `storage_note`, for the user.

        Raises:
            StorageError: the disk is full.
        """
        rows = np.zeros((0, 3)) if error_vs_time is None else np.asarray(error_vs_time, "<f8").reshape(-1, 3)
        text = json.dumps(dict(provenance), ensure_ascii=False, allow_nan=False)
        with self._guarded():
            file = self._open.file
            file.attrs["complete"] = np.uint8(complete)
            file.create_dataset("transfer/valid", data=self.valid)
            if error_covariance is not None:
                write_covariance(file["transfer"], error_covariance)
            if lobes is not None:
                write_lobes(file, lobes)
            file.create_dataset("provenance/json", data=text)
            file.create_dataset("provenance/error_vs_time", data=rows)
            write_selftest(file, selftest or {})
            self._open.close()
            self._stack.close()
        self._finished = True
        return self.storage_note

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, cause: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._abandon(cause)

    def _abandon(self, cause: BaseException | None) -> None:
        """Close without finishing; an error of the operating system about space or permission becomes StorageError."""
        if self._finished:
            return
        self._finished = True
        cause = cause or AssetError(f"{self._path}: the asset was not finished")
        with deferred(), contextlib.suppress(AssetError):
            if self._file is not None:
                self._file.discard()
            self._stack.__exit__(type(cause), cause, cause.__traceback__)

    @contextlib.contextmanager
    def _guarded(self) -> Iterator[None]:
        with deferred():
            try:
                yield
            except OSError as cause:
                self._abandon(cause)
                raise

    @property
    def _open(self) -> AssetFile:
        if self._file is None or self._finished:
            raise AssetError(f"{self._path}: the writer is closed")
        return self._file

    def _check_block(
        self, rows: slice, coefficients: NDArray[np.floating], standard_error: NDArray[np.floating]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Check a block and return it in float32, with errors [n,B]."""
        count = len(coefficients)
        if np.shape(coefficients)[1:] != self.shape[1:] or not 0 <= rows.start <= rows.stop <= self.shape[0]:
            raise AssetError(
                f"{self._path}: the block at vertex {rows.start} has shape {list(np.shape(coefficients))}; expected "
                f"[n, {', '.join(map(str, self.shape[1:]))}] within {self.shape[0]} vertices"
            )
        if np.shape(standard_error) not in {(count, self.shape[1]), (count, 1)}:
            found = list(np.shape(standard_error))
            raise AssetError(f"{self._path}: standard errors have shape {found}; expected {[count, self.shape[1]]}")
        with np.errstate(over="ignore"):
            values = np.asarray(coefficients).astype(np.float32)
            errors = np.broadcast_to(standard_error, (count, self.shape[1])).astype(np.float32)
        invalid = ~np.isfinite(values).all(axis=(2, 3)) | ~np.isfinite(errors) | (errors < 0)
        if invalid.any():
            vertex, view = np.argwhere(invalid)[0]
            raise AssetError(
                f"{self._path}: {invalid.sum()} view bins have coefficients that are not finite, or errors that are "
                f"negative or not finite; the first is bin {view} of vertex {rows.start + vertex}"
            )
        return values, errors

    def _float16_problem(self, values: NDArray[np.float32], errors: NDArray[np.float32]) -> str:
        """Return why float16 cannot store the block, or an empty text."""
        largest = float(np.abs(values).max(initial=0))
        if largest >= _FLOAT16_LIMIT:
            return f"coefficients up to {largest:.4g} exceed 65504, the largest float16"
        rounding = values.astype(np.float16).astype(np.float32) - values
        size = math.prod(self.shape[2:])
        self._rounding_sum += float(np.square(rounding, dtype=np.float64).sum()) / size
        self._error_sum += float(np.square(errors, dtype=np.float64).sum())
        self._error_sum += self._network_error**2 * float(np.square(values, dtype=np.float64).sum()) / size
        if self._rounding_sum <= _ROUNDING_LIMIT**2 * self._error_sum:
            return ""
        return "rounding to float16 would add more than a tenth of the error"

    def _widen(self, reason: str) -> None:
        """Change to float32: start a new file and copy the vertices written so far."""
        narrow_path = temporary_path(Path(os.path.realpath(self._path)))
        self._open.close()
        os.replace(self._part, narrow_path)
        self.storage = "float32"
        self.storage_note = f"coefficients are stored as float32: {reason}"
        try:
            self._file = AssetFile(self._part, self._head, self.shape, self.storage)
            self._file.note(self.storage_note)
            with h5py.File(narrow_path, "r") as narrow:
                transfer = narrow["transfer"]
                for start in range(0, self.shape[0], self.block_vertices):
                    rows = slice(start, min(start + self.block_vertices, self.shape[0]))
                    if self.valid[rows].any():
                        self._file.write(rows, transfer["coefficients"][rows], transfer["standard_error"][rows])
        finally:
            narrow_path.unlink(missing_ok=True)
        self.block_vertices = chunk_vertices(self.shape, self.storage)


def write_asset(asset: Asset, path: str | os.PathLike[str]) -> None:
    """Write an asset atomically, as `asset.storage` if float16 can store the coefficients.

    Compact coefficients stay compact.

    Raises:
        AssetError: inconsistent shapes, coefficients that are not finite.
        StorageError: the disk is full or read-only.

    >>> import trimesh
    >>> import numpy as np
    >>> import prt_bake as prt
    >>> class White:
    ...     def evaluate(self, incident, positions, outgoing):
    ...         return np.full((len(positions), incident.shape[-2], 3), 0.1)
    >>> ball = trimesh.creation.icosphere(subdivisions=0)
    >>> mesh = prt.Mesh(ball.vertices, ball.faces, ball.vertex_normals)
    >>> asset = prt.bake(White(), mesh, rings=1, sectors=4)
    >>> prt.write_asset(asset, "ball.h5")
    >>> np.array_equal(prt.read_asset("ball.h5").coefficients, asset.coefficients)
    True
    """
    if isinstance(asset.coefficients, CompactCoefficients):
        write_compact(asset, path)
        return
    if len(asset.coefficients.shape) != 4:
        found = list(asset.coefficients.shape)
        raise AssetError(f"{path}: coefficients have shape {found}; expected [V, B, K, 3]")
    _, views, _, channels = asset.coefficients.shape
    with AssetWriter(path, asset, storage=asset.storage, views=views, channels=channels) as writer:
        baked = np.flatnonzero(asset.valid)
        for start in range(0, len(asset.valid), writer.block_vertices):
            rows = baked[(baked >= start) & (baked < start + writer.block_vertices)]
            for run in np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1):
                if len(run):
                    span = slice(int(run[0]), int(run[-1]) + 1)
                    writer.write_block(span.start, asset.coefficients[span], asset.standard_error[span])
        writer.finish(
            asset.provenance,
            asset.error_vs_time,
            asset.selftest,
            asset.complete,
            asset.error_covariance,
            asset.lobes,
        )


def _refuse_invalid(path: str | os.PathLike[str], head: AssetHead, views: int | None, channels: int) -> None:
    vertices, bins, terms = len(head.mesh.positions), head.rings * head.sectors, (head.degree + 1) ** 2
    expected = {
        "tangents": (vertices, 3),
        "directions": (bins, 3),
        "check_directions": (2, 3),
        "check_values": (2, terms),
    }
    for name, shape in expected.items():
        found = np.shape(getattr(head, name))
        if found != shape:
            raise AssetError(f"{path}: {name} has shape {list(found)}; expected {list(shape)}")
    if views not in (None, 1, bins) or channels not in (1, 3) or head.quantity not in FORMULAS:
        raise AssetError(
            f"{path}: expected 1 or {bins} views, 1 or 3 channels and quantity 'transfer' or 'radiance', found {views} "
            f"views, {channels} channels and quantity '{head.quantity}'"
        )
