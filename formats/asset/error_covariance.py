"""How the errors of a vertex's coefficients hang together, as assets keep it beside their size.

In /transfer or /transfer_compact, N rows, of each vertex, of all of them (N = 1), or those that error_row names:

    error_covariance   [N,P]  over harmonics, lower triangle row by row, P = K(K+1)/2, of trace K
    error_channels     [N,C]  of each channel, of mean 1
    error_apart        [N,2]  share of the variance that a view bin, and a vertex, has of its own
    error_row          [V]    which row a vertex has

The harmonics are those of the view's frame: z along the normal, x towards the eye, laid into the surface (along the
normal: the tangent). With a light b turned into it, the variance of what a bin sends in channel c is
standard_error² · channels_c · b_cᵀ covariance b_c.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

DATASETS: dict[str, tuple[str, tuple[str, ...]]] = {
    "error_covariance": ("f", ("N", "pairs")),
    "error_channels": ("f", ("N", "3|1")),
    "error_apart": ("f", ("N", "2")),
    "error_row": ("iu", ("V",)),
}
_FIELDS = {"covariance": "error_covariance", "channels": "error_channels", "apart": "error_apart"}
_TOLERANCE = 1e-2


@dataclass(frozen=True)
class ErrorShape:
    """The shape of errors whose size is an asset's `standard_error`."""

    covariance: NDArray[np.floating]
    """[N,P], lower triangles of trace K: times the mean variance, that of the errors, mean over view bins and
    channels.
    """
    channels: NDArray[np.floating]
    """[N,C], of mean 1: times that variance, the variance of each channel."""
    apart: NDArray[np.floating]
    """[N,2], share of the variance that a view bin has of its own, and no bin beside it; and that a vertex has."""
    row: NDArray[np.integer] | None = None
    """[V], which of the N a vertex has; None where N is V, or 1 for all of them."""

    def of(self, vertices: NDArray[np.int64]) -> "ErrorShape":
        """A row for each of these vertices [n]."""
        rows = vertices if self.row is None else self.row[vertices]
        rows = np.minimum(rows, len(self.covariance) - 1)
        return ErrorShape(self.covariance[rows], self.channels[rows], self.apart[rows])

    def under(self, light: NDArray[np.floating]) -> NDArray[np.float64]:
        """The variance [N,C] in each channel of what is sent under lights [N,K,C], each in the frame of the view, over
        `standard_error`².
        """
        rows, columns = triangle(light.shape[1])
        twice = np.where(rows == columns, 1.0, 2.0)[:, None] * light[:, rows] * light[:, columns]
        return np.asarray(np.maximum(np.einsum("np,npc->nc", self.covariance, twice), 0.0) * self.channels)

    def of_first(self, count: int) -> "ErrorShape":
        """Of the first `count` harmonics alone."""
        covariance = self.covariance[:, : pairs(count)].astype(np.float64)
        rows, columns = triangle(count)
        trace = covariance[:, rows == columns].sum(axis=1, keepdims=True)
        scaled = np.divide(count * covariance, trace, out=np.zeros_like(covariance), where=trace > 0.0)
        covariance = np.where(trace > 0.0, scaled, np.where(rows == columns, 1.0, 0.0))
        return replace(self, covariance=covariance.astype(np.float32))


def pairs(count: int) -> int:
    """P for K = `count` harmonics."""
    return count * (count + 1) // 2


@cache
def triangle(count: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows and columns [P] of a lower triangle, row by row."""
    rows, columns = np.tril_indices(count)
    return rows.astype(np.int64), columns.astype(np.int64)


def write_shape(group: Any, shape: ErrorShape) -> None:
    """Write the datasets into an open group."""
    for field, name in _FIELDS.items():
        _packed(group, name, getattr(shape, field).astype("<f2"))
    if shape.row is not None:
        narrow = len(shape.covariance) <= 256
        _packed(group, "error_row", shape.row.astype("<u1" if narrow else "<u2"))


def read_shape(group: Any) -> ErrorShape | None:
    """What an open group of sound layout holds; None where it says nothing."""
    if "error_covariance" not in group:
        return None
    row = group["error_row"][...].astype(np.int64) if "error_row" in group else None
    covariance, channels, apart = (group[name][...].astype(np.float32) for name in _FIELDS.values())
    return ErrorShape(covariance, channels, apart, row)


def shape_faults(group: Any, vertices: int, count: int) -> Iterator[str]:
    """Yield a sentence for every fault of the values in a group of sound layout, of so many vertices and harmonics."""
    if "error_covariance" not in group:
        return
    covariance, channels, apart = (group[name][...].astype(np.float64) for name in _FIELDS.values())
    if covariance.shape[1] != pairs(count):
        yield f"{group.name}/error_covariance has rows of {covariance.shape[1]}; expected {pairs(count)}"
        return
    rows, columns = triangle(count)
    trace = covariance[:, rows == columns].sum(axis=1)
    wrong = {
        "error_covariance": ~(np.abs(trace - count) <= _TOLERANCE * count) | ~np.isfinite(covariance).all(axis=1),
        "error_channels": ~(np.abs(channels.mean(axis=1) - 1.0) <= _TOLERANCE) | ~(channels >= 0.0).all(axis=1),
        "error_apart": ~((apart >= 0.0) & (apart <= 1.0)).all(axis=1),
    }
    for name, bad in wrong.items():
        if bad.any():
            yield f"{group.name}/{name}: {bad.sum()} of {len(bad)} rows mean nothing, the first is row {bad.argmax()}"
    known = group["error_row"][...] if "error_row" in group else np.zeros(1, np.int64)
    if "error_row" not in group and len(covariance) not in (1, vertices):
        yield f"{group.name}/error_covariance has {len(covariance)} rows; expected 1 or {vertices}, or error_row"
    if (known.astype(np.int64) >= len(covariance)).any():
        yield f"{group.name}/error_row names rows from {len(covariance)} on, which do not exist"


def _packed(group: Any, name: str, values: NDArray[Any]) -> None:
    chunks = (max(1, min(len(values), 2**18 // max(1, values[:1].nbytes))), *values.shape[1:])
    group.create_dataset(name, data=values, compression=4, shuffle=True, chunks=chunks)
