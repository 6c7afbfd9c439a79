"""Triangle meshes: one record, read from and written to PLY, OBJ and glTF.

Vertices that share a position to the last bit are one vertex, whatever normals or texture coordinates a file splits
them by: a bake stores what leaves each point of the surface, and a point is one point.
"""

import dataclasses
import hashlib
import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from formats.atomic import existing, replacing
from formats.errors import MeshError
from formats.mesh import geometry
from formats.mesh.gltf import read_gltf
from formats.mesh.obj import read_obj, write_obj
from formats.mesh.ply import read_ply, write_ply
from formats.mesh.soup import TriangleSoup

_READERS: dict[str, Callable[[Path], TriangleSoup]] = {
    ".ply": read_ply,
    ".obj": read_obj,
    ".glb": read_gltf,
    ".gltf": read_gltf,
}
_WRITERS = {".ply": write_ply, ".obj": write_obj}


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh in object space, right-handed; faces are counter-clockwise seen from outside.

    Attributes:
        positions: float64 [V,3], in scene units.
        faces: int32 [F,3], indices into positions.
        normals: float64 [V,3], unit.
        uv: float64 [V,2], or None; where a seam splits a vertex, the first face's.
        corner_uv: float64 [F,3,2], the texture coordinates of each face's corners, v upwards, or None; where only `uv`
            is given, taken from it.
        source_vertex: int64 [n], from the file's vertex to the one kept (-1: used by no face), or None if all are as in
            the file.
        dropped_faces: faces without area that were left out on reading.
    """

    positions: NDArray[np.float64]
    faces: NDArray[np.int32]
    normals: NDArray[np.float64]
    uv: NDArray[np.float64] | None = None
    corner_uv: NDArray[np.float64] | None = None
    source_vertex: NDArray[np.int64] | None = None
    dropped_faces: int = 0

    def __post_init__(self) -> None:
        count, triangles = len(self.positions), len(self.faces)
        expected = {
            **{"positions": (count, 3), "faces": (triangles, 3), "normals": (count, 3)},
            **{"uv": (count, 2), "corner_uv": (triangles, 3, 2)},
        }
        for name, shape in expected.items():
            array = getattr(self, name)
            if array is None:
                continue
            if np.shape(array) != shape:
                raise MeshError(f"mesh: {name} has shape {np.shape(array)}, expected {shape}")
            kind = np.int32 if name == "faces" else np.float64
            object.__setattr__(self, name, np.ascontiguousarray(array, kind))
        if self.corner_uv is None and self.uv is not None:
            object.__setattr__(self, "corner_uv", self.uv[self.faces])

    @property
    def bounds(self) -> NDArray[np.float64]:
        """The corners of the bounding box [2,3], lowest and highest."""
        return np.stack([self.positions.min(axis=0), self.positions.max(axis=0)])

    @property
    def center(self) -> NDArray[np.float64]:
        """The middle of the bounding box [3]."""
        low, high = self.bounds
        middle: NDArray[np.float64] = low + 0.5 * (high - low)
        return middle

    @property
    def diagonal(self) -> float:
        """The length of the bounding box's diagonal."""
        low, high = self.bounds
        return float(np.linalg.norm(high - low))

    @cached_property
    def face_normals(self) -> NDArray[np.float64]:
        """The unit normal of each face [F,3]."""
        return geometry.face_normals(self.positions - self.center, self.faces)

    @cached_property
    def face_areas(self) -> NDArray[np.float64]:
        """The area of each face [F], in squared scene units."""
        return geometry.face_areas(self.positions - self.center, self.faces)

    @cached_property
    def content_hash(self) -> str:
        """SHA-256 of positions (little-endian float64) and faces (little-endian uint32), 64 hexadecimal digits."""
        digest = hashlib.sha256(self.positions.astype("<f8").tobytes())
        digest.update(self.faces.astype("<u4").tobytes())
        return digest.hexdigest()

    @property
    def seamless(self) -> bool:
        """Whether the texture coordinates are one pair a vertex, so that `uv` says all that `corner_uv` does."""
        if self.uv is None or self.corner_uv is None:
            return self.corner_uv is None
        return np.array_equal(self.uv[self.faces], self.corner_uv)


def read_mesh(path: str | os.PathLike[str], *, drop_flat_faces: bool = False) -> Mesh:
    """Read `.ply`, `.obj`, `.glb` or `.gltf`.

    Vertices at one position are merged and unused ones left out (`Mesh.source_vertex` remembers), polygons are cut into
    triangles, normals are the file's (averaged where merged) or else the angle-weighted mean of the faces'.

    Args:
        path: the file; its suffix says what it is.
        drop_flat_faces: leave faces without area out, and count them in `Mesh.dropped_faces`, instead of refusing them.

    Raises:
        MeshError: of another kind, truncated, without faces; NaN or infinite vertices, indices out of range, faces
            without area: with their count and the first.
        StorageError: the file is missing or cannot be opened.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in _READERS:
        raise MeshError(f"{path}: is not a mesh this can read; expected {', '.join(_READERS)}, found '{suffix}'")
    soup = _READERS[suffix](existing(path))
    _refuse_damaged(soup, path)
    kept, source_vertex = geometry.merged(soup.positions)
    faces = source_vertex[soup.faces]
    positions = soup.positions[kept]
    flat = geometry.faces_without_area(positions, faces)
    if flat.all() or (flat.any() and not drop_flat_faces):
        raise MeshError(
            f"{path}: {flat.sum()} of {len(flat)} faces have no area, the first is face {flat.argmax()} with corners "
            f"{soup.faces[flat.argmax()].tolist()}; remove them in a mesh editor (dissolve degenerate faces)"
        )
    return _assembled(soup, positions, faces, source_vertex, ~flat)


def build_mesh(positions: NDArray[np.float64], faces: NDArray[np.integer]) -> Mesh:
    """Return a mesh of these vertices [V,3] and triangles [F,3] as they are, with angle-weighted vertex normals."""
    positions = np.ascontiguousarray(positions, np.float64)
    centred = positions - 0.5 * (positions.min(axis=0) + positions.max(axis=0))
    return Mesh(positions, np.ascontiguousarray(faces, np.int32), geometry.vertex_normals(centred, faces))


def write_mesh(mesh: Mesh, path: str | os.PathLike[str]) -> None:
    """Write `.ply` (binary, float64) or `.obj` (17 digits), whole or not at all; reading gives the same numbers.

    Raises:
        MeshError: another suffix.
        StorageError: the disk is full or not writable.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in _WRITERS:
        raise MeshError(f"{path}: cannot write a mesh of this kind; expected {' or '.join(_WRITERS)}, found '{suffix}'")
    with replacing(path) as part:
        _WRITERS[suffix](part, mesh.positions, mesh.faces, mesh.normals, mesh.uv if mesh.seamless else mesh.corner_uv)


def open_edges(mesh: Mesh) -> int:
    """Count the edges that are not shared by exactly two faces; 0 on a closed surface."""
    uses, _ = geometry.edge_uses(mesh.faces)
    return int((uses != 2).sum())


def torn_edges(mesh: Mesh) -> int:
    """Count the edges whose two faces are wound against one another, so that inside and outside meet there."""
    uses, senses = geometry.edge_uses(mesh.faces)
    return int(((uses == 2) & (senses != 0)).sum())


def signed_volume(mesh: Mesh) -> float:
    """Return the volume enclosed, in cubed scene units; negative where faces are wound inside out."""
    a, b, c = (mesh.positions[mesh.faces[:, corner]] - mesh.center for corner in range(3))
    return float(np.einsum("fi,fi->", a, np.cross(b, c)) / 6)


def flipped(mesh: Mesh) -> Mesh:
    """Return the mesh with every face wound the other way and every normal reversed."""
    corner_uv = None if mesh.corner_uv is None else mesh.corner_uv[:, ::-1]
    return dataclasses.replace(mesh, faces=mesh.faces[:, ::-1], normals=-mesh.normals, corner_uv=corner_uv)


def check_mesh(path: str | os.PathLike[str]) -> list[str]:
    """Return every fault of a mesh file as sentences; an empty list means that it is a closed, sound surface."""
    faults = []
    try:
        mesh = read_mesh(path)
    except MeshError as fault:
        faults.append(str(fault))
        try:
            mesh = read_mesh(path, drop_flat_faces=True)
        except MeshError:
            return faults
    if count := open_edges(mesh):
        faults.append(f"{path}: {count} edges are not shared by exactly two faces; a closed surface has none")
    if count := torn_edges(mesh):
        faults.append(f"{path}: {count} edges lie between faces wound against one another; make the normals consistent")
    elif not faults and signed_volume(mesh) < 0:
        faults.append(f"{path}: the faces are wound inside out; flip the normals")
    step = _single_precision_step(mesh)
    edges = mesh.positions[mesh.faces] - mesh.positions[np.roll(mesh.faces, 1, axis=1)]
    edge = float(np.median(np.linalg.norm(edges, axis=2)))
    if step > 1e-3 * edge:
        faults.append(
            f"{path}: the positions were rounded to float32 far from the origin: steps of {step:.2g} on edges of "
            f"{edge:.2g}; move the object to the origin before it is saved"
        )
    return faults


def _refuse_damaged(soup: TriangleSoup, path: str | os.PathLike[str]) -> None:
    count = len(soup.positions)
    if len(soup.faces) == 0:
        raise MeshError(f"{path}: has no faces; a surface is needed, not a point cloud")
    outside = ((soup.faces < 0) | (soup.faces >= count)).any(axis=1)
    if outside.any():
        first = int(outside.argmax())
        raise MeshError(
            f"{path}: {outside.sum()} of {len(soup.faces)} faces use vertices that do not exist, the first is face "
            f"{first} with corners {soup.faces[first].tolist()}; expected indices from 0 to {count - 1}"
        )
    unfit = ~np.isfinite(soup.positions).all(axis=1)
    if unfit.any():
        first = int(unfit.argmax())
        raise MeshError(
            f"{path}: {unfit.sum()} of {count} vertices are NaN or infinite, the first is vertex {first} at "
            f"{soup.positions[first].tolist()}; repair the mesh"
        )


def _assembled(
    soup: TriangleSoup,
    positions: NDArray[np.float64],
    faces: NDArray[np.int64],
    source_vertex: NDArray[np.int64],
    kept_faces: NDArray[np.bool_],
) -> Mesh:
    """Leave out flat faces and unused vertices, and gather what corners carry at the vertices."""
    faces = faces[kept_faces]
    used, first_corner = np.unique(faces.ravel(), return_index=True)
    place = np.full(len(positions), -1, np.int64)
    place[used] = np.arange(len(used))
    positions, faces, source_vertex = positions[used], place[faces], place[source_vertex]
    centred = positions - 0.5 * (positions.min(axis=0) + positions.max(axis=0))
    corner_uv = None if soup.corner_uv is None else soup.corner_uv[kept_faces]
    return Mesh(
        positions=positions,
        faces=faces.astype(np.int32),
        normals=geometry.vertex_normals(centred, faces, _sound_normals(soup, kept_faces)),
        uv=None if corner_uv is None else corner_uv.reshape(-1, 2)[first_corner],
        corner_uv=corner_uv,
        source_vertex=None if len(used) == len(soup.positions) else source_vertex,
        dropped_faces=int((~kept_faces).sum()),
    )


def _sound_normals(soup: TriangleSoup, kept_faces: NDArray[np.bool_]) -> NDArray[np.float64] | None:
    """The file's normals at the corners, of unit length; None where any is missing, zero or not finite."""
    if soup.corner_normals is None or not np.isfinite(soup.corner_normals[kept_faces]).all():
        return None
    normals = geometry.unit(soup.corner_normals[kept_faces])
    return normals if np.abs(normals).max(axis=2).all() else None


def _single_precision_step(mesh: Mesh) -> float:
    """The spacing of float32 at the farthest coordinate, or 0 if the positions hold more than float32 does."""
    if not np.array_equal(mesh.positions, mesh.positions.astype(np.float32)):
        return 0.0
    return float(np.spacing(np.float32(np.abs(mesh.positions).max())))
