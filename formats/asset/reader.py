"""Reads and checks assets."""

import json
import math
import os
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from formats.asset.chunk_reader import can_read_chunks, read_chunks
from formats.asset.compact_file import read_compact
from formats.asset.compact_layout import GROUP, value_faults
from formats.asset.error_covariance import covariance_faults, read_covariance
from formats.asset.head import mesh_digest, mesh_origin
from formats.asset.layout import layout_faults, transfer_group
from formats.asset.lobes import lobe_faults, read_lobes
from formats.asset.record import Asset
from formats.asset.selftest import DATASETS, OF_LOBES
from formats.asset.total_error import read_network_error
from formats.errors import AssetError
from formats.hdf5_file import (
    HDF5_ERRORS,
    as_float32,
    attribute,
    describe_damage,
    first_fault,
    open_hdf5,
)
from formats.hdf5_strings import DamagedDataError, read_string
from formats.mesh import Mesh

_BLOCK_BYTES = 2**26
_UNIT_TOLERANCE = 1e-3  # accepts unit vectors that another writer stored as float16


def read_asset(path: str | os.PathLike[str], *, load: bool = True) -> Asset:
    """Read and check an asset.

    Args:
        path: the HDF5 file.
        load: read and check all coefficients, in the type of the file. If false, `Asset.coefficients` is the open
            dataset (see `Asset.close`), for assets larger than memory. Compact coefficients are always read, and stay
            compact.

    Raises:
        AssetError: the file is not HDF5, truncated or of another version; datasets are missing or have the wrong shape
            or type; values are not finite.
        StorageError: the file is missing.

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
    >>> with prt.read_asset("ball.h5", load=False) as stored:
    ...     stored.coefficients[:2].shape
    (2, 4, 9, 3)
    """
    file = _opened(path)
    try:
        faults = list(_faults(file))
        if faults:
            raise AssetError(f"{path}: {first_fault(faults, 'copy or bake it again')}")
        asset = _asset(file, load)
    except HDF5_ERRORS as cause:
        file.close()
        if isinstance(cause, AssetError):
            raise
        raise AssetError(f"{path}: {describe_damage(cause)}; copy or bake it again") from cause
    if load or GROUP in file:
        file.close()
    return asset


def check_asset(path: str | os.PathLike[str]) -> list[str]:
    """Return every fault of an asset, a sentence each; an empty list means a valid asset.

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
        except HDF5_ERRORS as cause:
            faults.append(f"{describe_damage(cause)}; copy or bake it again")
    return [f"{path}: {fault}" for fault in faults]


def _opened(path: str | os.PathLike[str]) -> Any:
    return open_hdf5(path, AssetError, "is not an asset", "bake it")


def _faults(file: Any) -> Iterator[str]:
    """Yield every fault except those of the coefficient values."""
    layout = list(layout_faults(file))
    yield from layout
    if layout:
        return
    for name in ("mesh/positions", "basis/check_directions", "basis/check_values", "bins/directions"):
        yield from _finite_faults(file, name)
    yield from _bin_faults(file["bins"])
    origin = np.asarray(mesh_origin(file["mesh"]))
    if origin.shape != (3,) or origin.dtype.kind != "f" or not np.isfinite(origin).all():
        yield "/mesh/positions: the attribute origin is not a finite point"
    normals, tangents = file["mesh/normals"][...].astype(np.float64), file["mesh/tangents"][...].astype(np.float64)
    for name, vectors in (("mesh/normals", normals), ("mesh/tangents", tangents)):
        unit = np.abs(np.linalg.norm(vectors, axis=1) - 1) < _UNIT_TOLERANCE
        yield from _row_faults(name, ~unit, "not of length 1")
    sine = np.abs(np.einsum("vi,vi->v", normals, tangents))
    yield from _row_faults("mesh/tangents", ~(sine < _UNIT_TOLERANCE), "not perpendicular to the normal")
    faces, vertices = file["mesh/faces"][...], len(normals)
    outside = ((faces < 0) | (faces >= vertices)).any(axis=1)
    yield from _row_faults("mesh/faces", outside, "out of the range of vertices")
    group = transfer_group(file)
    valid = file[f"{group}/valid"][...].astype(bool)
    errors = as_float32(file[f"{group}/standard_error"][...])
    wrong = valid & ~((errors >= 0) & np.isfinite(errors)).all(axis=1)
    yield from _row_faults(f"{group}/standard_error", wrong, "negative or not finite")
    if group == GROUP:
        yield from value_faults(file[GROUP])
    made_for_one_light = attribute(file[group], "quantity") == "radiance"
    terms = 1 if made_for_one_light else (int(attribute(file["basis"], "degree")) + 1) ** 2
    yield from covariance_faults(file[group], vertices, terms)
    yield from lobe_faults(file, vertices)
    if len(file.get("selftest", ())):
        outside = (file["selftest/vertex"][...] < 0) | (file["selftest/vertex"][...] >= vertices)
        yield from _row_faults("selftest/vertex", outside, "out of the range of vertices")
        for name in (*DATASETS, *OF_LOBES):
            if name in file:
                yield from _finite_faults(file, name)


def _bin_faults(group: Any) -> Iterator[str]:
    """Compare the bins' directions with the centres in (cosθ, φ) that follow from rings and sectors."""
    rings, sectors = int(attribute(group, "rings")), int(attribute(group, "sectors"))
    cosine = np.repeat(1.0 - (np.arange(rings) + 0.5) / rings, sectors)
    phi = np.tile(2.0 * np.pi * (np.arange(sectors) + 0.5) / sectors, rings)
    sine = np.sqrt(1.0 - cosine**2)
    centres = np.stack([sine * np.cos(phi), sine * np.sin(phi), cosine], axis=-1)
    near = (np.abs(group["directions"][...] - centres) < _UNIT_TOLERANCE).all(axis=1)
    yield from _row_faults("bins/directions", ~near, f"not the centres of {rings} rings of {sectors} sectors")


def _mesh_faults(group: Any) -> Iterator[str]:
    """Check the hash of the mesh: coefficients on vertices in another order would give silently wrong pictures."""
    if "sha256" in group.attrs and str(attribute(group, "sha256")) != mesh_digest(group):
        yield "/mesh: is not the mesh that was baked, or its vertices are in another order; bake it again"


def _finite_faults(file: Any, name: str) -> Iterator[str]:
    yield from _row_faults(name, ~np.isfinite(np.atleast_2d(file[name][...])).all(axis=1), "not finite")


def _row_faults(name: str, wrong: NDArray[np.bool_], problem: str) -> Iterator[str]:
    if wrong.any():
        yield f"/{name}: {wrong.sum()} of {len(wrong)} rows are {problem}, the first is row {wrong.argmax()}"


def _blocks(transfer: Any) -> Iterator[tuple[slice, NDArray[np.floating]]]:
    """Yield the coefficients in blocks of rows that fit in memory, without blocks that have no valid vertex."""
    dataset, valid = transfer["coefficients"], transfer["valid"][...].astype(bool)
    step = max(1, _BLOCK_BYTES // max(1, math.prod(dataset.shape[1:]) * dataset.dtype.itemsize))
    for start in range(0, len(valid), step):
        rows = slice(start, min(start + step, len(valid)))
        if valid[rows].any():
            yield rows, _block(dataset, rows)


def _block(dataset: Any, rows: slice) -> NDArray[np.floating]:
    try:
        return np.asarray(dataset[rows])
    except HDF5_ERRORS as cause:
        if isinstance(cause, OSError) and cause.errno is not None:
            raise
        where = f"rows {rows.start} to {rows.stop - 1}"
        raise DamagedDataError(f"{dataset.name}: {where} cannot be decompressed") from cause


def _coefficient_faults(file: Any) -> Iterator[str]:
    if GROUP in file:
        read_compact(file[GROUP])  # every integer is valid; damaged chunks raise
        return
    transfer = file["transfer"]
    valid = transfer["valid"][...].astype(bool)
    wrong = np.zeros(len(valid), np.bool_)
    for rows, block in _blocks(transfer):
        wrong[rows] = valid[rows] & ~_is_finite(_as_loaded(block))
    yield from _nan_faults(wrong)


def _as_loaded(block: NDArray[np.floating]) -> NDArray[np.floating]:
    """Coefficients as they are in memory: in float16 if the file has them in 16 bits, else in float32."""
    return block.astype(np.float16) if block.dtype.itemsize == 2 else as_float32(block)


def _nan_faults(wrong: NDArray[np.bool_]) -> Iterator[str]:
    if wrong.any():
        yield (
            f"/transfer/coefficients: {wrong.sum()} of {len(wrong)} vertices have NaN or infinite values in float32, "
            f"the first is vertex {wrong.argmax()}"
        )


def _is_finite(block: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Return whether all coefficients of each vertex of a block [n,B,K,C] are finite."""
    native = block.dtype.newbyteorder("=")
    infinity = np.array(np.inf, native).view(f"u{native.itemsize}")
    # Compares bits below the sign, because np.isfinite is slow for float16.
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
        rings=int(attribute(file["bins"], "rings")),
        sectors=int(attribute(file["bins"], "sectors")),
        directions=file["bins/directions"][...].astype(np.float64),
        degree=int(attribute(file["basis"], "degree")),
        check_directions=file["basis/check_directions"][...].astype(np.float64),
        check_values=file["basis/check_values"][...].astype(np.float64),
        up=attribute(file, "up"),
        handedness=attribute(file, "handedness"),
        unit=attribute(file, "unit"),
        quantity=attribute(transfer, "quantity"),
        folded_in=attribute(transfer, "folded_in"),
        left_out=json.loads(attribute(file, "left_out")),
        network_error=read_network_error(file),
        coefficients=coefficients,
        standard_error=transfer["standard_error"][...].astype(np.float32),
        valid=valid,
        complete=bool(attribute(file, "complete")),
        provenance=json.loads(read_string(file["provenance/json"])),
        error_vs_time=file["provenance/error_vs_time"][...].astype(np.float64),
        selftest={name: selftest[name][...] for name in selftest},
        storage="float16" if coefficients.dtype.itemsize == 2 else "float32",
        error_covariance=read_covariance(transfer),
        lobes=read_lobes(file),
    )


def _coefficients(file: Any, valid: NDArray[np.bool_], load: bool) -> Any:
    if GROUP in file:
        return read_compact(file[GROUP])
    return _load(file.filename, file["transfer"], valid) if load else file["transfer/coefficients"]


def _mesh(group: Any) -> Mesh:
    origin = np.asarray(mesh_origin(group), np.float64)
    return Mesh(
        positions=origin + group["positions"][...].astype(np.float64),
        faces=group["faces"][...].astype(np.int32),
        normals=group["normals"][...].astype(np.float64),
        uv=group["uv"][...].astype(np.float64) if "uv" in group else None,
        source_vertex=group["source_vertex"][...].astype(np.int64) if "source_vertex" in group else None,
        flat_shaded=bool(attribute(group, "flat_shaded")) if "flat_shaded" in group.attrs else False,
    )


def _load(path: str, transfer: Any, valid: NDArray[np.bool_]) -> NDArray[np.floating]:
    dataset = transfer["coefficients"]
    coefficients = np.zeros(dataset.shape, np.float16 if dataset.dtype.itemsize == 2 else np.float32)
    finite = np.ones(len(valid), np.bool_)

    def check(rows: slice) -> None:
        finite[rows] = _is_finite(coefficients[rows])

    if dataset.dtype == coefficients.dtype and can_read_chunks(dataset):
        read_chunks(dataset, coefficients, check)
    else:
        for rows, block in _blocks(transfer):
            coefficients[rows] = _as_loaded(block)
            check(rows)
    for fault in _nan_faults(valid & ~finite):
        raise AssetError(f"{path}: {fault}")
    return coefficients
