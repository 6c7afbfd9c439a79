"""Sinks for baked blocks: an array in memory, or an asset file that is written block by block."""

from pathlib import Path
from types import TracebackType
from typing import Any, Protocol, Self, cast

import numpy as np
from numpy.typing import NDArray

from bakers.baker import Block
from bakers.transport import transport_property
from formats.asset import Asset, AssetHead, Storage, read_asset
from formats.asset.total_error import ErrorInterval
from formats.asset.writer import AssetWriter
from formats.errors import QueryError
from formats.mesh import Mesh
from prt_bake.baking.output.covariance_rows import CovarianceRows
from prt_bake.baking.output.selftest import selftest, selftest_vertices
from prt_bake.mathematics import sh, sphere

CHECK_DIRECTIONS = np.array([[2.0, 3.0, 6.0], [-6.0, 2.0, -3.0]]) / 7.0


class Sink(Protocol):
    """Takes blocks in order and finishes the asset; a file is discarded if the context ends without `finish`."""

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, fault: BaseException | None, trace: TracebackType | None
    ) -> None: ...

    def write(self, block: Block) -> None:
        """Takes the valid vertices of a block."""

    def finish(self, provenance: dict[str, Any], error_vs_time: NDArray[np.float64], complete: bool) -> Asset:
        """Ends the writing and returns the asset, complete or partial."""


def open_sink(
    out: str | Path | None,
    head: AssetHead,
    storage: str,
    views: int | None = None,
    channels: int = 3,
    light: NDArray[np.float64] | None = None,
) -> Sink:
    """A sink in memory, or one that streams to the file `out`; raises QueryError on an unknown storage type.

    views: length of the view axis, B by default. channels: length of the last axis. light: coefficients [K,3] of the
    light of an asset of radiance.
    """
    if storage not in ("float16", "float32"):
        raise QueryError(f"storage must be float16 or float32, found {storage!r}")
    kind = cast(Storage, storage)
    axes = views or len(head.directions), channels
    return ArraySink(head, kind, axes, light) if out is None else FileSink(head, kind, axes, light, out)


def asset_head(
    mesh: Mesh, tangents: NDArray[np.float64], rings: int, sectors: int, degree: int, transport: Any
) -> AssetHead:
    """The asset's data that is known before the bake; up, unit and the network's error are those of the transport."""
    return AssetHead(
        mesh=mesh,
        tangents=tangents,
        rings=rings,
        sectors=sectors,
        directions=sphere.view_bins(rings, sectors),
        degree=degree,
        check_directions=CHECK_DIRECTIONS,
        check_values=sh.evaluate(CHECK_DIRECTIONS, degree),
        up=str(transport_property(transport, "up", "y")),
        unit=str(transport_property(transport, "unit", "unit")),
        network_error=network_error(transport),
    )


def network_error(transport: Any) -> ErrorInterval | None:
    """The error that the trainer measured, from the transport's metadata; None if it is unknown."""
    metadata = getattr(transport, "metadata", None) or {}
    training = metadata.get("training")
    figures = training.get("relative_rmse") if isinstance(training, dict) else None
    if not isinstance(figures, dict) or figures.get("coefficients") is None:
        return None
    return ErrorInterval(figures["coefficients"], *(figures.get("coefficients_interval") or ()))


class ArraySink:
    """Keeps the coefficients in memory, in float32."""

    def __init__(
        self, head: AssetHead, storage: Storage, axes: tuple[int, int], light: NDArray[np.float64] | None
    ) -> None:
        vertices, (views, channels) = len(head.mesh.positions), axes
        self._head, self._storage, self._light = head, storage, light
        terms = sh.count(head.degree) if head.quantity == "transfer" else 1
        self._coefficients = np.zeros((vertices, views, terms, channels), dtype=np.float32)
        self._standard_error = np.zeros((vertices, views), dtype=np.float32)
        self._valid = np.zeros(vertices, dtype=np.bool_)
        self._covariances = CovarianceRows(self._coefficients.shape)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, fault: BaseException | None, trace: TracebackType | None
    ) -> None:
        pass

    def write(self, block: Block) -> None:
        """Takes the block's valid vertices."""
        rows = slice(block.first_vertex, block.first_vertex + len(block.valid))
        self._coefficients[rows] = block.coefficients
        self._standard_error[rows] = block.standard_error
        self._valid[rows] = block.valid
        self._covariances.add(block)

    def finish(self, provenance: dict[str, Any], error_vs_time: NDArray[np.float64], complete: bool) -> Asset:
        """Returns the asset, in memory."""
        vertices = selftest_vertices(self._valid)
        return Asset(
            **vars(self._head),
            coefficients=self._coefficients,
            standard_error=self._standard_error,
            valid=self._valid,
            complete=complete,
            provenance=provenance,
            error_vs_time=error_vs_time,
            selftest=selftest(self._head, vertices, self._coefficients[vertices], self._light),
            storage=self._storage,
            error_covariance=self._covariances.finished(),
        )


class FileSink:
    """Streams the coefficients to an asset file.

    An existing file `out` is replaced only by a complete asset; a partial asset is then written beside it as
    partial-NAME.
    """

    def __init__(
        self,
        head: AssetHead,
        storage: Storage,
        axes: tuple[int, int],
        light: NDArray[np.float64] | None,
        out: str | Path,
    ) -> None:
        self._head, self._light, self._out = head, light, Path(out)
        replaces = self._out.is_file()
        self._target = self._out.with_name(f"partial-{self._out.name}") if replaces else self._out
        self._writer = AssetWriter(self._target, head, storage=storage, views=axes[0], channels=axes[1])
        self._covariances = CovarianceRows(self._writer.shape)

    def __enter__(self) -> Self:
        self._writer.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, fault: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._writer.__exit__(kind, fault, trace)

    def write(self, block: Block) -> None:
        """Takes the block's valid vertices."""
        good = np.flatnonzero(block.valid)
        for run in np.split(good, np.flatnonzero(np.diff(good) > 1) + 1):
            if run.size:
                rows = slice(int(run[0]), int(run[-1]) + 1)
                self._writer.write_block(
                    block.first_vertex + rows.start, block.coefficients[rows], block.standard_error[rows]
                )
        self._covariances.add(block)

    def finish(self, provenance: dict[str, Any], error_vs_time: NDArray[np.float64], complete: bool) -> Asset:
        """Closes the file and returns the asset, read back; raises StorageError if it cannot be written."""
        vertices = selftest_vertices(self._writer.valid)
        check = selftest(self._head, vertices, self._writer.stored(vertices), self._light)
        if self._writer.storage_note:
            provenance = provenance | {"storage_note": self._writer.storage_note}
        shape = self._covariances.finished()
        self._writer.finish(provenance, error_vs_time, check, complete=complete, error_covariance=shape)
        if complete and self._target != self._out:
            self._target.replace(self._out)
        return read_asset(self._out if complete else self._target, load=False)
