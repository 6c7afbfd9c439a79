"""Reads meshes from PLY, OBJ, STL and glTF, and writes PLY and OBJ; the suffix selects the format.

Vertices at bitwise equal positions are merged, even if a file splits them by normals or texture coordinates: a bake
stores the light that leaves each point of the surface, once per point.
"""

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from formats.atomic import existing, replacing
from formats.errors import MeshError, warn
from formats.mesh import geometry
from formats.mesh.creases import is_flat_shaded
from formats.mesh.edges import inside_out, opens_edges, welded
from formats.mesh.gltf import read_gltf
from formats.mesh.normals import agreeing_normals
from formats.mesh.obj import read_obj, write_obj
from formats.mesh.ply import read_ply, write_ply
from formats.mesh.record import SPLIT_ANGLE, Mesh
from formats.mesh.stl import read_stl
from formats.triangle_soup import TriangleSoup

_READERS: dict[str, Callable[[Path], TriangleSoup]] = {
    ".ply": read_ply,
    ".obj": read_obj,
    ".stl": read_stl,
    ".glb": read_gltf,
    ".gltf": read_gltf,
}
_WRITERS = {".ply": write_ply, ".obj": write_obj}
READABLE = tuple(_READERS)
"""Suffixes of the meshes that `read_mesh` reads."""


def read_mesh(path: str | os.PathLike[str], *, drop_flat_faces: bool = False) -> Mesh:
    """Read a mesh from `.ply`, `.obj`, `.stl`, `.glb` or `.gltf`.

    Merges vertices at equal positions and removes unused ones (see `Mesh.source_vertex`), and triangulates polygons.
    Normals come from the file, averaged over merged vertices, or else are the angle-weighted mean of the face normals.

    Three faults are repaired with an InputWarning. Normals that contradict the faces are replaced by those of the faces
    (`formats.mesh.normals`). Faces without area are dropped if no face loses its neighbour by that.
    Loose vertices within a rounding to float32 of one another are merged if that closes the surface.

    Args:
        path: the file; its suffix selects the format.
        drop_flat_faces: drop all faces without area, without a warning; `Mesh.dropped_faces` counts them.

    Raises:
        MeshError: an unknown format, a truncated file, no faces; NaN, infinite or huge vertices, indices out of range,
            faces without area between others, polygons that cross themselves (the message has the first).
        StorageError: the file is missing or cannot be opened.

    >>> import prt_bake as prt
    >>> mesh = prt.read_mesh(prt.example("spot.obj"))
    >>> mesh.positions.shape, mesh.faces.shape
    ((2930, 3), (5856, 3))
    """
    suffix = Path(path).suffix.lower()
    if suffix not in _READERS:
        raise MeshError(f"{path}: is not a readable mesh; expected {', '.join(_READERS)}, found '{suffix}'; convert it")
    soup = _READERS[suffix](existing(path))
    _refuse_invalid(soup, path)
    first, source_vertex = geometry.merge_positions(soup.positions)
    faces = source_vertex[soup.faces]
    positions = soup.positions[first]
    flat = geometry.faces_without_area(positions, faces)
    if flat.any():
        _accept_flat_faces(soup, faces, flat, path, drop_flat_faces)
    merging = welded(positions, faces[~flat])
    if merging is not None:
        target, distance = merging
        warn(
            f"{path}: {(target != np.arange(len(target))).sum()} vertices at open edges are within {distance:.2g} of "
            f"others, a rounding to float32; they were merged, which closes the surface"
        )
        faces, source_vertex = target[faces], target[source_vertex]
    return _assemble(path, soup, positions, faces, source_vertex, ~flat)


def write_mesh(mesh: Mesh, path: str | os.PathLike[str]) -> None:
    """Write `.ply` (binary, float64) or `.obj` (17 digits) atomically; both preserve the numbers exactly.

    Raises:
        MeshError: another suffix.
        StorageError: the disk is full or read-only.

    >>> import numpy as np
    >>> import prt_bake as prt
    >>> triangle = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    >>> mesh = prt.Mesh(triangle, np.array([[0, 1, 2]]), np.array([[0.0, 0.0, 1.0]] * 3))
    >>> prt.write_mesh(mesh, "triangle.ply")
    >>> np.array_equal(prt.read_mesh("triangle.ply").positions, triangle)
    True
    """
    suffix = Path(path).suffix.lower()
    if suffix not in _WRITERS:
        raise MeshError(f"{path}: cannot write a mesh of this kind; expected {' or '.join(_WRITERS)}, found '{suffix}'")
    with replacing(path) as part:
        _WRITERS[suffix](part, mesh.positions, mesh.faces, mesh.normals, mesh.uv if mesh.seamless else mesh.corner_uv)


def _refuse_invalid(soup: TriangleSoup, path: str | os.PathLike[str]) -> None:
    count = len(soup.positions)
    if len(soup.faces) == 0:
        raise MeshError(f"{path}: has no faces; expected a surface, not a point cloud")
    outside = ((soup.faces < 0) | (soup.faces >= count)).any(axis=1)
    if outside.any():
        first = int(outside.argmax())
        raise MeshError(
            f"{path}: {outside.sum()} of {len(soup.faces)} faces use vertices that do not exist, the first is face "
            f"{first} with corners {soup.faces[first].tolist()}; expected indices from 0 to {count - 1}"
        )
    invalid = np.asarray(~(np.abs(soup.positions) <= geometry.MOST_COORDINATE).all(axis=1))
    invalid[np.setdiff1d(np.arange(count), soup.faces)] = False  # vertices of no face are removed
    if invalid.any():
        first = int(invalid.argmax())
        raise MeshError(
            f"{path}: {invalid.sum()} of {count} vertices are NaN, infinite or beyond ±{geometry.MOST_COORDINATE:g}, "
            f"the first is {soup.vertex_in_file(first)} at {soup.positions[first].tolist()}; repair the mesh"
        )


def _accept_flat_faces(
    soup: TriangleSoup, faces: NDArray[np.int64], flat: NDArray[np.bool_], path: str | os.PathLike[str], silent: bool
) -> None:
    """Warn that the flat faces [F] are dropped, or raise MeshError if nothing is left or other faces need them."""
    count, first = int(flat.sum()), int(flat.argmax())
    found = f"{path}: {count} of {len(flat)} faces have no area, the first is {soup.face_in_file(first)}"
    if flat.all() or (not silent and opens_edges(faces, flat)):
        raise MeshError(f"{found}; remove them in a mesh editor (dissolve degenerate faces)")
    if not silent:
        warn(f"{found}; they were dropped, since no other face needs them")


def _assemble(
    path: str | os.PathLike[str],
    soup: TriangleSoup,
    positions: NDArray[np.float64],
    faces: NDArray[np.int64],
    source_vertex: NDArray[np.int64],
    kept_faces: NDArray[np.bool_],
) -> Mesh:
    """Remove flat faces and unused vertices, and average the corner attributes at the vertices."""
    faces = faces[kept_faces]
    used, first_corner = np.unique(faces.ravel(), return_index=True)
    new_index = np.full(len(positions), -1, np.int64)
    new_index[used] = np.arange(len(used))
    positions, faces, source_vertex = positions[used], new_index[faces], new_index[source_vertex]
    centred = positions - 0.5 * (positions.min(axis=0) + positions.max(axis=0))
    corner_uv = None if soup.corner_uv is None else soup.corner_uv[kept_faces]
    at_corners = None if soup.corner_normals is None else geometry.normalise(soup.corner_normals[kept_faces])
    of_faces, cancelled = geometry.vertex_normals(centred, faces)
    given = None if at_corners is None else _given_normals(at_corners, centred, faces)
    normals, computed = agreeing_normals(path, given, of_faces, cancelled, lambda: inside_out(centred, faces))
    return Mesh(
        positions=positions,
        faces=faces.astype(np.int32),
        normals=normals,
        uv=None if corner_uv is None else corner_uv.reshape(-1, 2)[first_corner],
        corner_uv=corner_uv,
        source_vertex=None if len(used) == len(soup.positions) else source_vertex,
        dropped_faces=int((~kept_faces).sum()),
        cancelled_normals=int((cancelled & computed).sum()),
        split_normals=0 if at_corners is None else int((_are_split(at_corners, faces, first_corner) & ~computed).sum()),
        flat_shaded=at_corners is not None and not computed.all() and is_flat_shaded(at_corners, normals[faces]),
    )


def _given_normals(
    at_corners: NDArray[np.float64], positions: NDArray[np.float64], faces: NDArray[np.int64]
) -> NDArray[np.float64]:
    """The file's normals at the corners [F,3,3], averaged at the vertices [V,3].

    NaN where one is zero or not finite, or where they cancel out.
    """
    missing = ~(np.abs(at_corners).max(axis=2) > 0.0)
    normals, cancelled = geometry.vertex_normals(positions, faces, np.where(missing[..., None], 0.0, at_corners))
    normals[faces[missing]] = np.nan
    normals[cancelled] = np.nan
    return normals


def _are_split(
    at_corners: NDArray[np.float64], faces: NDArray[np.int64], first_corner: NDArray[np.int64]
) -> NDArray[np.bool_]:
    """Where the file's normals at a vertex differ from those at its first corner [V] by more than `SPLIT_ANGLE`."""
    split = np.zeros(len(first_corner), np.bool_)
    cosines = np.einsum("fci,fci->fc", at_corners, at_corners.reshape(-1, 3)[first_corner[faces]])
    split[faces[cosines < np.cos(np.radians(SPLIT_ANGLE))]] = True
    return split
