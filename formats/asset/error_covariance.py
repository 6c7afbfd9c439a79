"""The covariance of the errors of a vertex's coefficients, relative to the asset's `standard_error`.

Datasets in /transfer or /transfer_compact. They have N rows: one per vertex, one for all vertices (N = 1), or shared
rows that error_row selects:

    error_covariance   [N,P]  over harmonics: lower triangle, row by row, P = K(K+1)/2, trace K
    error_channels     [N,C]  relative variance of each channel, mean 1
    error_apart        [N,2]  fractions of the variance that are independent between view bins, and between vertices
    error_row          [V]    row of each vertex

The harmonics are those of the view frame: z is the normal, x the direction to the eye projected on the surface (the
tangent if the eye is on the normal). For a light b rotated into it, the variance of the radiance of a bin in channel c
is standard_error² · channels_c · b_cᵀ covariance b_c.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from formats.summary import summary

DATASETS: dict[str, tuple[str, tuple[str, ...]]] = {
    "error_covariance": ("f", ("N", "pairs")),
    "error_channels": ("f", ("N", "3|1")),
    "error_apart": ("f", ("N", "2")),
    "error_row": ("iu", ("V",)),
}
_FIELDS = {"covariance": "error_covariance", "channels": "error_channels", "apart": "error_apart"}
_TOLERANCE = 1e-2


@dataclass(frozen=True)
class ErrorCovariance:
    """The covariance of errors whose standard deviation is the asset's `standard_error`."""

    covariance: NDArray[np.floating]
    """[N,P], lower triangles of trace K; times the mean variance, the covariance averaged over bins and channels."""
    channels: NDArray[np.floating]
    """[N,C], mean 1; times the mean variance, the variance of each channel."""
    apart: NDArray[np.floating]
    """[N,2], fractions of the variance that are independent between view bins, and between vertices."""
    row: NDArray[np.integer] | None = None
    """[V], row of each vertex; None if N is V, or 1 for all vertices."""

    def at_vertices(self, vertices: NDArray[np.int64]) -> "ErrorCovariance":
        """Return the rows of some vertices [n]."""
        rows = vertices if self.row is None else self.row[vertices]
        rows = np.minimum(rows, len(self.covariance) - 1)
        return ErrorCovariance(self.covariance[rows], self.channels[rows], self.apart[rows])

    def variance_under(self, light: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return the variance of the radiance [N,C] over `standard_error`², for lights [N,K,C] in the view frame."""
        rows, columns = triangle(light.shape[1])
        products = np.where(rows == columns, 1.0, 2.0)[:, None] * light[:, rows] * light[:, columns]
        return np.asarray(np.maximum(np.einsum("np,npc->nc", self.covariance, products), 0.0) * self.channels)

    def truncated(self, count: int) -> "ErrorCovariance":
        """Return the covariance of the first `count` harmonics, scaled to trace `count`."""
        covariance = self.covariance[:, : pairs(count)].astype(np.float64)
        rows, columns = triangle(count)
        trace = covariance[:, rows == columns].sum(axis=1, keepdims=True)
        scaled = np.divide(count * covariance, trace, out=np.zeros_like(covariance), where=trace > 0.0)
        covariance = np.where(trace > 0.0, scaled, np.where(rows == columns, 1.0, 0.0))
        return replace(self, covariance=covariance.astype(np.float32))

    __repr__ = summary


def pairs(count: int) -> int:
    """Return P, the number of entries of a lower triangle over `count` harmonics."""
    return count * (count + 1) // 2


@cache
def triangle(count: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the row and column [P] of each entry of a lower triangle, row by row."""
    rows, columns = np.tril_indices(count)
    return rows.astype(np.int64), columns.astype(np.int64)


def write_covariance(group: Any, errors: ErrorCovariance) -> None:
    """Write the datasets into an open group."""
    for field, name in _FIELDS.items():
        _write_compressed(group, name, getattr(errors, field).astype("<f2"))
    if errors.row is not None:
        narrow = len(errors.covariance) <= 256
        _write_compressed(group, "error_row", errors.row.astype("<u1" if narrow else "<u2"))


def read_covariance(group: Any) -> ErrorCovariance | None:
    """Read the datasets of an open group of valid layout; None if it has none."""
    if "error_covariance" not in group:
        return None
    row = group["error_row"][...].astype(np.int64) if "error_row" in group else None
    covariance, channels, apart = (group[name][...].astype(np.float32) for name in _FIELDS.values())
    return ErrorCovariance(covariance, channels, apart, row)


def covariance_faults(group: Any, vertices: int, count: int) -> Iterator[str]:
    """Yield a sentence for every invalid value in a group of valid layout, with `count` harmonics."""
    if "error_covariance" not in group:
        return
    covariance, channels, apart = (group[name][...].astype(np.float64) for name in _FIELDS.values())
    if covariance.shape[1] != pairs(count):
        yield f"{group.name}/error_covariance has rows of {covariance.shape[1]}; expected {pairs(count)}"
        return
    rows, columns = triangle(count)
    trace = covariance[:, rows == columns].sum(axis=1)
    valid = {
        "error_covariance": (np.abs(trace - count) <= _TOLERANCE * count) & np.isfinite(covariance).all(axis=1),
        "error_channels": (np.abs(channels.mean(axis=1) - 1.0) <= _TOLERANCE) & (channels >= 0.0).all(axis=1),
        "error_apart": ((apart >= 0.0) & (apart <= 1.0)).all(axis=1),
    }
    for name, rows_valid in valid.items():
        if not rows_valid.all():
            wrong, first = (~rows_valid).sum(), rows_valid.argmin()
            yield f"{group.name}/{name}: {wrong} of {len(rows_valid)} rows are invalid, the first is row {first}"
    row = group["error_row"][...] if "error_row" in group else np.zeros(1, np.int64)
    if "error_row" not in group and len(covariance) not in (1, vertices):
        yield f"{group.name}/error_covariance has {len(covariance)} rows; expected 1 or {vertices}, or error_row"
    if (row.astype(np.int64) >= len(covariance)).any():
        yield f"{group.name}/error_row selects rows that do not exist; expected less than {len(covariance)}"


def _write_compressed(group: Any, name: str, values: NDArray[Any]) -> None:
    chunks = (max(1, min(len(values), 2**18 // max(1, values[:1].nbytes))), *values.shape[1:])
    group.create_dataset(name, data=values, compression=4, shuffle=True, chunks=chunks)
