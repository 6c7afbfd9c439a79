"""Writes the head of an asset file: root attributes, mesh, basis and view bins."""

import datetime
import hashlib
import json
from typing import Any

import numpy as np
from numpy.typing import NDArray

from formats.asset.lobes import FORMAT_VERSION
from formats.asset.record import AssetHead
from formats.asset.total_error import ATTRIBUTE as NETWORK_ERROR
from formats.hdf5_file import attribute
from formats.version import program_version

FORMAT = "prtbake"
FORMULAS = {
    "transfer": "L[v,b,c] = sum over k of coefficients[v,b,k,c] * light[k,c]",
    "radiance": "L[v,b,c] = coefficients[v,b,0,c]",
}
BASIS = {
    "kind": "real spherical harmonics",
    "order": "l(l+1)+m",
    "sign": "no Condon-Shortley phase",
    "normalisation": "orthonormal",
}
_INTERPOLATION = (
    "bilinear in (cos theta, phi) between bin centres; phi wraps; between the normal and ring 0 linear in "
    "1 - cos theta, the value at the normal being the mean of ring 0; beyond the last ring's centre clamped"
)


def write_head(file: Any, head: AssetHead) -> None:
    """Write root attributes, /mesh, /basis and /bins into an open h5py file."""
    file.attrs.update(
        format=FORMAT,
        format_version=FORMAT_VERSION,
        generator=f"prtbake {program_version()}",
        created=datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        up=head.up,
        handedness=head.handedness,
        unit=head.unit,
        colour="linear, Rec.709 primaries, RGB",
        complete=np.uint8(0),
        left_out=json.dumps(head.left_out, allow_nan=False),
    )
    if head.network_error is not None:
        file.attrs[NETWORK_ERROR] = np.array(head.network_error, "<f8")
    _write_mesh(file.create_group("mesh"), head)
    basis = file.create_group("basis")
    basis.attrs.update(BASIS, degree=head.degree)
    basis.create_dataset("check_directions", data=_as(head.check_directions, "<f8"))
    basis.create_dataset("check_values", data=_as(head.check_values, "<f8"))
    bins = file.create_group("bins")
    bins.attrs.update(rings=head.rings, sectors=head.sectors, interpolation=_INTERPOLATION)
    bins.attrs["solid_angle"] = 2 * np.pi / (head.rings * head.sectors)
    bins.create_dataset("directions", data=_as(head.directions, "<f8"))


def _write_mesh(group: Any, head: AssetHead) -> None:
    mesh = head.mesh
    origin = mesh.center
    positions = group.create_dataset("positions", data=_as(mesh.positions - origin, "<f4"))
    positions.attrs["origin"] = origin
    group.create_dataset("normals", data=_as(mesh.normals, "<f4"))
    group.create_dataset("tangents", data=_as(head.tangents, "<f4"))
    group.create_dataset("faces", data=_as(mesh.faces, "<u4"))
    if mesh.uv is not None:
        group.create_dataset("uv", data=_as(mesh.uv, "<f4"))
    if mesh.source_vertex is not None:
        group.create_dataset("source_vertex", data=_as(mesh.source_vertex, "<i4"))
    if mesh.flat_shaded:
        group.attrs["flat_shaded"] = np.uint8(1)
    group.attrs["sha256"] = mesh_digest(group)


def mesh_digest(group: Any) -> str:
    """Return the SHA-256 of the origin, positions, normals, tangents and faces in the group /mesh of an asset."""
    digest = hashlib.sha256(_as(mesh_origin(group), "<f8").tobytes())
    for name in ("positions", "normals", "tangents", "faces"):
        digest.update(_as(group[name][...], "<u4" if name == "faces" else "<f4").tobytes())
    return digest.hexdigest()


def mesh_origin(group: Any) -> Any:
    """Return the position that the group /mesh of an asset counts its positions from."""
    positions = group["positions"]
    return attribute(positions, "origin") if "origin" in positions.attrs else np.zeros(3)


def _as(values: NDArray[Any], kind: str) -> NDArray[Any]:
    return np.ascontiguousarray(values, kind)
