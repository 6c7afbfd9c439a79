"""Reads an asset, checking first everything that a user relies on."""

import json
import math
import os
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from formats.asset.chunk_reader import read_chunks, unpacks
from formats.asset.compact_file import read_compact
from formats.asset.compact_layout import GROUP, value_faults
from formats.asset.error_covariance import read_shape, shape_faults
from formats.asset.head import mesh_digest
from formats.asset.layout import layout_faults, transfer_group
from formats.asset.record import Asset
from formats.errors import AssetError
from formats.hdf5_file import DAMAGE, Damage, damage, open_hdf5
from formats.mesh import Mesh

_BLOCK_BYTES = 2**26
_UNIT_TOLERANCE = 1e-3  # half floats of other writers pass, wrong lengths do not


def read_asset(path: str | os.PathLike[str], *, load: bool = True) -> Asset:
    """Read an asset and check everything in it that a user relies on.

    Args:
        path: the HDF5 file.
        load: read the coefficients into memory, as the type that the file keeps, and check each; without it they are
            the open dataset (see `Asset.close`), for assets larger than memory. Compact ones are always read into
            memory, as they are.

    Raises:
        AssetError: not HDF5, truncated, of another version, datasets missing or of the wrong shape or type, values that
            are not finite.
        StorageError: the file is missing.
    """
    file = _opened(path)
    try:
        faults = list(_faults(file))
        if faults:
            more = f" (and {len(faults) - 1} more faults)" if len(faults) > 1 else ""
            raise AssetError(f"{path}: {faults[0]}{more}")
        asset = _asset(file, load)
    except DAMAGE as cause:
        file.close()
        if isinstance(cause, AssetError):
            raise
        raise AssetError(f"{path}: {damage(cause)}; copy or bake it again") from cause
    if load or GROUP in file:
        file.close()
    return asset


def check_asset(path: str | os.PathLike[str]) -> list[str]:
    """Return every fault of an asset as sentences; an empty list means that it is sound.

    Raises:
        StorageError: the file is missing.
    """
    try:
        file = _opened(path)
    except AssetError as fault:
        return [str(fault)]
    faults: list[str] = []
    with file:
        try:
            faults.extend(_faults(file))
            if not faults:
                faults.extend(_mesh_faults(file["mesh"]))
                faults.extend(_coefficient_faults(file))
        except DAMAGE as cause:
            faults.append(f"{damage(cause)}; copy or bake it again")
    return [f"{path}: {fault}" for fault in faults]


def _opened(path: str | os.PathLike[str]) -> Any:
    return open_hdf5(path, AssetError, "is no asset", "bake it")


def _faults(file: Any) -> Iterator[str]:
    """Yield every fault but those of the coefficients themselves."""
    layout = list(layout_faults(file))
    yield from layout
    if layout:
        return
    for name in ("mesh/positions", "basis/check_directions", "basis/check_values", "bins/directions"):
        yield from _not_finite(file, name)
    origin = np.asarray(file["mesh/positions"].attrs.get("origin", np.zeros(3)))
    if origin.shape != (3,) or origin.dtype.kind != "f" or not np.isfinite(origin).all():
        yield "/mesh/positions: the attribute origin is no point"
    normals, tangents = file["mesh/normals"][...].astype(np.float64), file["mesh/tangents"][...].astype(np.float64)
    for name, vectors in (("mesh/normals", normals), ("mesh/tangents", tangents)):
        yield from _marked(name, ~(np.abs(np.linalg.norm(vectors, axis=1) - 1) < _UNIT_TOLERANCE), "not of length 1")
    sine = np.abs(np.einsum("vi,vi->v", normals, tangents))
    yield from _marked("mesh/tangents", ~(sine < _UNIT_TOLERANCE), "not perpendicular to the normal")
    faces, vertices = file["mesh/faces"][...], len(normals)
    yield from _marked("mesh/faces", ((faces < 0) | (faces >= vertices)).any(axis=1), "of vertices that do not exist")
    group = transfer_group(file)
    valid = file[f"{group}/valid"][...].astype(bool)
    errors = file[f"{group}/standard_error"][...]
    yield from _marked(f"{group}/standard_error", valid & ~(errors >= 0).all(axis=1), "negative or NaN")
    if group == GROUP:
        yield from value_faults(file[GROUP])
    terms = 1 if file[group].attrs["quantity"] == "radiance" else (int(file["basis"].attrs["degree"]) + 1) ** 2
    yield from shape_faults(file[group], vertices, terms)
    if len(file.get("selftest", ())):
        outside = (file["selftest/vertex"][...] < 0) | (file["selftest/vertex"][...] >= vertices)
        yield from _marked("selftest/vertex", outside, "of vertices that do not exist")
        for name in ("selftest/light", "selftest/outgoing", "selftest/radiance"):
            yield from _not_finite(file, name)


def _mesh_faults(group: Any) -> Iterator[str]:
    """Coefficients belong to vertices by their number alone: a mesh in another order would be shown without a word."""
    told = group.attrs.get("sha256")
    if told is not None and told != mesh_digest(group):
        yield "/mesh: is not the one that was baked, or its vertices are in another order; bake it again"


def _not_finite(file: Any, name: str) -> Iterator[str]:
    yield from _marked(name, ~np.isfinite(file[name][...]).all(axis=1), "not finite")


def _marked(name: str, wrong: NDArray[np.bool_], what: str) -> Iterator[str]:
    if wrong.any():
        yield f"/{name}: {wrong.sum()} of {len(wrong)} rows are {what}, the first is row {wrong.argmax()}"


def _blocks(transfer: Any) -> Iterator[tuple[slice, NDArray[np.floating]]]:
    """Yield the coefficients of the valid vertices in runs of memory-sized blocks."""
    dataset, valid = transfer["coefficients"], transfer["valid"][...].astype(bool)
    step = max(1, _BLOCK_BYTES // max(1, math.prod(dataset.shape[1:]) * dataset.dtype.itemsize))
    for start in range(0, len(valid), step):
        rows = slice(start, min(start + step, len(valid)))
        if valid[rows].any():
            yield rows, _block(dataset, rows)


def _block(dataset: Any, rows: slice) -> NDArray[np.floating]:
    try:
        return np.asarray(dataset[rows])
    except DAMAGE as cause:
        if isinstance(cause, OSError) and cause.errno is not None:
            raise
        raise Damage(f"{dataset.name}: rows {rows.start} to {rows.stop - 1} cannot be unpacked") from cause


def _coefficient_faults(file: Any) -> Iterator[str]:
    if GROUP in file:
        read_compact(file[GROUP])  # every whole number is one; what cannot be unpacked is damage
        return
    transfer = file["transfer"]
    valid = transfer["valid"][...].astype(bool)
    wrong = np.zeros(len(valid), np.bool_)
    for rows, block in _blocks(transfer):
        wrong[rows] = valid[rows] & ~_finite(block)
    yield from _unfit(wrong)


def _unfit(wrong: NDArray[np.bool_]) -> Iterator[str]:
    """The fault of vertices [V] that are wrong."""
    if wrong.any():
        yield (
            f"/transfer/coefficients: {wrong.sum()} of {len(wrong)} vertices have NaN or infinite values, the first is "
            f"vertex {wrong.argmax()}"
        )


def _finite(block: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Whether all of a vertex is finite, of a block [n,B,K,C]."""
    native = block.dtype.newbyteorder("=")
    infinity = np.array(np.inf, native).view(f"u{native.itemsize}")
    # By the bits below the sign: NumPy has no fast way for half floats.
    bits: Any = np.ascontiguousarray(block, native).view(infinity.dtype)
    magnitudes = bits & infinity.dtype.type(2 ** (8 * native.itemsize - 1) - 1)
    return np.asarray(magnitudes.reshape(len(block), -1).max(axis=1, initial=0) < infinity)


def _asset(file: Any, load: bool) -> Asset:
    mesh, transfer = file["mesh"], file[transfer_group(file)]
    valid = transfer["valid"][...].astype(bool)
    coefficients = _coefficients(file, valid, load)
    selftest = file.get("selftest", {})
    return Asset(
        mesh=_mesh(mesh),
        tangents=mesh["tangents"][...].astype(np.float64),
        rings=int(file["bins"].attrs["rings"]),
        sectors=int(file["bins"].attrs["sectors"]),
        directions=file["bins/directions"][...].astype(np.float64),
        degree=int(file["basis"].attrs["degree"]),
        check_directions=file["basis/check_directions"][...].astype(np.float64),
        check_values=file["basis/check_values"][...].astype(np.float64),
        up=file.attrs["up"],
        handedness=file.attrs["handedness"],
        unit=file.attrs["unit"],
        quantity=transfer.attrs["quantity"],
        folded_in=transfer.attrs["folded_in"],
        left_out=json.loads(file.attrs["left_out"]),
        coefficients=coefficients,
        standard_error=transfer["standard_error"][...].astype(np.float32),
        valid=valid,
        complete=bool(file.attrs["complete"]),
        provenance=json.loads(file["provenance/json"][()]),
        error_vs_time=file["provenance/error_vs_time"][...].astype(np.float64),
        selftest={name: selftest[name][...] for name in selftest},
        storage="float16" if coefficients.dtype.itemsize == 2 else "float32",
        error_shape=read_shape(transfer),
    )


def _coefficients(file: Any, valid: NDArray[np.bool_], load: bool) -> Any:
    if GROUP in file:
        return read_compact(file[GROUP])
    return _loaded(file.filename, file["transfer"], valid) if load else file["transfer/coefficients"]


def _mesh(group: Any) -> Mesh:
    origin = np.asarray(group["positions"].attrs.get("origin", np.zeros(3)), np.float64)
    return Mesh(
        positions=origin + group["positions"][...].astype(np.float64),
        faces=group["faces"][...].astype(np.int32),
        normals=group["normals"][...].astype(np.float64),
        uv=group["uv"][...].astype(np.float64) if "uv" in group else None,
        source_vertex=group["source_vertex"][...].astype(np.int64) if "source_vertex" in group else None,
    )


def _loaded(path: str, transfer: Any, valid: NDArray[np.bool_]) -> NDArray[np.floating]:
    dataset = transfer["coefficients"]
    kind = np.float16 if dataset.dtype.itemsize == 2 else np.float32
    coefficients = np.zeros(dataset.shape, kind)
    finite = np.ones(len(valid), np.bool_)

    def look(rows: slice) -> None:
        finite[rows] = _finite(coefficients[rows])

    if unpacks(dataset):
        read_chunks(dataset, coefficients, look)
    else:
        for rows, block in _blocks(transfer):
            coefficients[rows] = block
            look(rows)
    for fault in _unfit(valid & ~finite):
        raise AssetError(f"{path}: {fault}")
    return coefficients
