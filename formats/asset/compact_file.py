"""Writes and reads compact coefficients, the group /transfer_compact of an asset."""

import json
import os
import zlib
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from formats.asset.compact_layout import GROUP, digit_names
from formats.asset.compact_record import AddedError, CompactCoefficients, FactorisedViews, LearnedViews
from formats.asset.error_covariance import write_covariance
from formats.asset.head import write_head
from formats.asset.lobes import write_lobes
from formats.asset.record import Asset
from formats.asset.selftest import write_selftest
from formats.atomic import replacing
from formats.hdf5_file import attribute
from formats.hdf5_sink import Sink
from formats.interrupts import deferred

FORMULA = (
    "coefficients[v,b,k,c] = step * sum over p of codes[p,v] * view[view_component[p],b] * "
    "channel_basis[channel_component[p],k,c]; codes = sum over d of 256**d * digits_d; view = kron(ring_basis, "
    "sector_basis), or view_scale[r] * sum over d of 256**d * view_digits_d[r,b]"
)
SparseCodes = tuple[NDArray[np.int64], NDArray[np.uint32], NDArray[np.int32]]
"""Number of nonzero codes of each vertex, their components and their values."""
_CHUNK_BYTES = 2**18
_CHUNK_VERTICES = 4096
_KEPT_BITS = 8  # of the mantissa of standard errors: 0.4 %


def write_compact(asset: Asset, path: str | os.PathLike[str]) -> int:
    """Write an asset with compact coefficients atomically, and return the size of /transfer_compact in bytes.

    If the provenance has a table "compression", its "bytes_after" is set to that size.

    Raises:
        StorageError: the disk is full or read-only.
    """
    with replacing(path) as part, deferred():
        sink = Sink(part)
        with h5py.File(sink, "w") as file:
            write_head(file, asset)
            file.attrs["complete"] = np.uint8(asset.complete)
            file.flush()
            before = file.id.get_filesize()
            _write_transfer(file.create_group(GROUP), asset)
            file.flush()
            size = int(file.id.get_filesize() - before)
            write_selftest(file, asset.selftest)
            if asset.lobes is not None:
                write_lobes(file, asset.lobes)
            file.create_dataset("provenance/json", data=_provenance(asset, size))
            file.create_dataset("provenance/error_vs_time", data=np.asarray(asset.error_vs_time, "<f8"))
        if sink.error is not None:
            raise sink.error
        sink.close()
    return size


def read_compact(group: Any) -> CompactCoefficients:
    """Return the coefficients of an open group /transfer_compact of valid layout."""
    starts, components, values = _read_codes(group)
    return CompactCoefficients(
        step=float(attribute(group, "step")),
        views=_views(group),
        channels=group["channel_basis"][...].astype(np.float32),
        view_component=group["view_component"][...].astype(np.int64),
        channel_component=group["channel_component"][...].astype(np.int64),
        starts=starts,
        components=components,
        values=values,
        added=AddedError(
            requested=float(attribute(group, "error_asked")),
            total=float(attribute(group, "error")),
            percentile_95=float(attribute(group, "error_percentile_95")),
            worst=float(attribute(group, "error_worst")),
            per_vertex=group["added_error"][...].astype(np.float32),
        ),
    )


def digit_planes(codes: NDArray[np.integer]) -> list[NDArray[np.int8]]:
    """Split integers into digits from −128 to 127, the lowest first: codes = Σ 256^d digit_d."""
    rest = codes.astype(np.int64)
    planes: list[NDArray[np.int8]] = []
    while not planes or rest.any():
        low = (rest + 128) % 256 - 128
        planes.append(low.astype(np.int8))
        rest = (rest - low) // 256
    return planes


def to_sparse(dense: NDArray[np.integer]) -> SparseCodes:
    """Return the nonzero codes of dense codes [P,n]."""
    vertex, component = np.nonzero(dense.T)
    counts = np.bincount(vertex, minlength=dense.shape[1])
    return counts, component.astype(np.uint32), dense[component, vertex].astype(np.int32)


def join_sparse(
    parts: list[SparseCodes], components: int
) -> tuple[NDArray[np.int64], NDArray[np.unsignedinteger], NDArray[np.signedinteger]]:
    """Concatenate blocks of vertices into starts, components and values, in the smallest types."""
    counts = np.concatenate([part[0] for part in parts])
    starts = np.concatenate([[0], np.cumsum(counts)])
    narrow = all(np.abs(part[2]).max(initial=0) < 2**15 for part in parts)
    index: Any = np.uint16 if components <= 2**16 else np.uint32
    value: Any = np.int16 if narrow else np.int32
    return (
        starts,
        np.concatenate([part[1].astype(index) for part in parts]),
        np.concatenate([part[2].astype(value) for part in parts]),
    )


def _write_transfer(group: Any, asset: Asset) -> None:
    compact: CompactCoefficients = asset.coefficients
    added = compact.added
    group.attrs.update(
        quantity=asset.quantity,
        folded_in=asset.folded_in,
        formula=FORMULA,
        step=compact.step,
        error_asked=added.requested,
        error=added.total,
        error_percentile_95=added.percentile_95,
        error_worst=added.worst,
    )
    _write_compressed(group, "valid", asset.valid.astype(np.uint8))
    _write_compressed(group, "standard_error", round_up(asset.standard_error))
    _write_compressed(group, "added_error", round_up(added.per_vertex))
    if asset.error_covariance is not None:
        write_covariance(group, asset.error_covariance)
    _write_compressed(group, "view_component", compact.view_component.astype("<u4"))
    _write_compressed(group, "channel_component", compact.channel_component.astype("<u4"))
    _write_compressed(group, "channel_basis", compact.channels.astype("<f4"))
    if isinstance(compact.views, FactorisedViews):
        _write_compressed(group, "ring_basis", compact.views.rings.astype("<f4"))
        _write_compressed(group, "sector_basis", compact.views.sectors.astype("<f4"))
    else:
        _write_compressed(group, "view_scale", compact.views.scale.astype("<f4"))
        view_planes = digit_planes(compact.views.codes)
        group.attrs["view_digits"] = len(view_planes)
        for d, plane in enumerate(view_planes):
            _write_plane(_digits(group, f"view_digits_{d}", plane.shape, plane.shape[1]), plane, 0)
    _write_digits(group, compact)


def _write_digits(group: Any, compact: CompactCoefficients) -> None:
    """Write the codes as digit datasets; chunks of zeros are not written, nor higher digits that are all zero."""
    shape = len(compact.view_component), len(compact)
    columns = min(shape[1], _CHUNK_VERTICES)
    planes: list[Any] = []
    for first in range(0, shape[1], columns):
        for d, plane in enumerate(digit_planes(_dense(compact, first, min(first + columns, shape[1])))):
            if d == len(planes):
                planes.append(_digits(group, f"digits_{d}", shape, columns))
            _write_plane(planes[d], plane, first)
    group.attrs["digits"] = len(planes)


def _digits(group: Any, name: str, shape: tuple[int, int], columns: int) -> Any:
    chunks = max(1, min(shape[0], _CHUNK_BYTES // columns)), columns
    return group.create_dataset(name, shape, "i1", chunks=chunks, compression=9)


def _write_plane(dataset: Any, plane: NDArray[np.int8], first: int) -> None:
    """Write digits [P,n] to the columns from `first` on, except chunks of zeros."""
    rows, columns = dataset.chunks
    for row in range(0, len(plane), rows):
        block = plane[row : row + rows]
        if block.any():
            chunk = np.zeros((rows, columns), np.int8)
            chunk[: len(block), : block.shape[1]] = block
            dataset.id.write_direct_chunk((row, first), deflate(chunk))


def deflate(digits: NDArray[np.int8]) -> bytes:
    """Compress digits for the gzip filter, to 7 % fewer bytes than the filter's own.

    Only runs are matched: a match between independent digits takes more bits than the digits.
    """
    compressor = zlib.compressobj(9, zlib.DEFLATED, zlib.MAX_WBITS, 8, zlib.Z_RLE)
    return compressor.compress(np.ascontiguousarray(digits).tobytes()) + compressor.flush()


def _dense(compact: CompactCoefficients, first: int, end: int) -> NDArray[np.int32]:
    codes = np.zeros((len(compact.view_component), end - first), np.int32)
    nonzero = slice(compact.starts[first], compact.starts[end])
    vertex = np.repeat(np.arange(end - first), np.diff(compact.starts[first : end + 1]))
    codes[compact.components[nonzero], vertex] = compact.values[nonzero]
    return codes


def _read_codes(group: Any) -> Any:
    planes = [group[name] for name in digit_names(group, "digits")]
    vertices = planes[0].shape[1]
    parts = []
    for first in range(0, vertices, _CHUNK_VERTICES):
        codes = np.zeros((planes[0].shape[0], min(_CHUNK_VERTICES, vertices - first)), np.int32)
        for d, plane in enumerate(planes):
            codes += plane[:, first : first + _CHUNK_VERTICES].astype(np.int32) << 8 * d
        parts.append(to_sparse(codes))
    return join_sparse(parts, planes[0].shape[0])


def _views(group: Any) -> FactorisedViews | LearnedViews:
    if "ring_basis" in group:
        return FactorisedViews(*(group[name][...].astype(np.float32) for name in ("ring_basis", "sector_basis")))
    planes = [group[name][...].astype(np.int32) << 8 * d for d, name in enumerate(digit_names(group, "view_digits"))]
    return LearnedViews(np.sum(planes, axis=0, dtype=np.int32), group["view_scale"][...].astype(np.float32))


def round_up(errors: NDArray[np.floating]) -> NDArray[np.float32]:
    """Round errors up to float32 of few mantissa bits, which compress well."""
    dropped = np.uint32(2 ** (23 - _KEPT_BITS) - 1)
    bits = np.ascontiguousarray(errors, np.float32).view(np.uint32)
    return np.asarray(((bits + dropped) & ~dropped).view(np.float32))


def _write_compressed(group: Any, name: str, values: NDArray[Any]) -> None:
    group.create_dataset(name, data=values, compression=9, shuffle=True, chunks=values.shape)


def _provenance(asset: Asset, size: int) -> str:
    provenance = dict(asset.provenance)
    if "compression" in provenance:
        provenance["compression"] = {**provenance["compression"], "bytes_after": size}
    return json.dumps(provenance, ensure_ascii=False, allow_nan=False)
