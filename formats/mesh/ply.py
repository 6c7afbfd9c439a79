"""PLY, ascii and binary (Greg Turk, "The PLY Polygon File Format", 1994: http://paulbourke.net/dataformats/ply/).

Numbers keep their full precision. The reader uses the vertex properties x y z, nx ny nz and u v (or s t, texture_u
texture_v), the face list vertex_indices (or vertex_index), the face list texcoord (two numbers per corner, as MeshLab
writes it), and the list vertex_indices of tristrips: triangle strips that end at −1, as in Stanford's models. It
ignores everything else.

No library: trimesh reads a truncated ASCII file without its last face, accepts lists of negative length and writes
float32; plyfile is under the GPL.
"""

import os
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from formats.errors import MeshError, warn
from formats.mesh.ply_body import Columns, Lists, PlyBody
from formats.mesh.ply_header import read_header
from formats.mesh.triangulation import refuse_absent, triangulate
from formats.text import without_byte_order_mark
from formats.triangle_soup import TriangleSoup

_INDEX_LISTS = ("vertex_indices", "vertex_index")
_TEXTURE_NAMES = (("u", "v"), ("s", "t"), ("texture_u", "texture_v"))
_RESTARTS = (-1, 2**32 - 1)  # end a triangle strip; the second is -1 as an unsigned integer


def read_ply(path: str | os.PathLike[str]) -> TriangleSoup:
    """Read a PLY file.

    Raises:
        MeshError: the file is not PLY, is truncated, or lacks vertices or faces; a polygon crosses itself.
    """
    with open(path, "rb") as file:
        content = without_byte_order_mark(file.read(), path, MeshError)
    byte_order, elements, start = read_header(content, path)
    body = PlyBody(content[start:], byte_order, path)
    columns = {element.name: body.columns(element) for element in elements}
    if body.surplus:
        warn(
            f"{path}: {body.surplus} {'bytes' if byte_order else 'numbers'} follow the last row that the header "
            f"counts, and are ignored; if faces are missing, export the mesh again"
        )
    return _soup(columns, path)


def write_ply(
    path: str | os.PathLike[str],
    positions: NDArray[np.float64],
    faces: NDArray[np.integer],
    normals: NDArray[np.float64],
    uv: NDArray[np.float64] | None,
) -> None:
    """Write binary little-endian PLY with float64 vertices: positions, normals [V,3], faces [F,3].

    `uv` is [V,2], or [F,3,2] if seams need one pair per corner (written as the face list texcoord), or None.
    """
    per_vertex, per_corner = uv is not None and uv.ndim == 2, uv is not None and uv.ndim == 3
    columns = [positions, normals, uv] if uv is not None and per_vertex else [positions, normals]
    names = ["x", "y", "z", "nx", "ny", "nz"] + (["s", "t"] if per_vertex else [])
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(positions)}"]
    header += [f"property double {name}" for name in names]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    header += ["property list uchar double texcoord"] if per_corner else []
    header += ["end_header", ""]
    textured = [("pairs", "u1"), ("texcoord", "<f8", (3, 2))] if per_corner else []
    rows = np.empty(len(faces), np.dtype([("count", "u1"), ("corners", "<i4", (3,)), *textured]))
    rows["count"] = 3
    rows["corners"] = faces
    if per_corner:
        rows["pairs"] = 6
        rows["texcoord"] = uv
    with open(path, "wb") as file:
        file.write("\n".join(header).encode("ascii"))
        file.write(np.hstack(columns).astype("<f8").tobytes())
        file.write(rows.tobytes())


def _soup(elements: Mapping[str, Columns], path: str | os.PathLike[str]) -> TriangleSoup:
    vertices, faces = elements.get("vertex", {}), elements.get("face", {})
    positions = _stack_columns(vertices, ("x", "y", "z"))
    if positions is None:
        raise MeshError(f"{path}: the element vertex has no properties x, y and z; export the mesh again")
    polygons, strips = _index_lists(faces, path), _index_lists(elements.get("tristrips", {}), path)
    if polygons is None and strips is None:
        raise MeshError(f"{path}: has no faces (no list vertex_indices); expected a surface, not a point cloud")
    triangles, corners, corner_uv = np.zeros((0, 3), np.int64), np.zeros((0, 3), np.int64), None
    if polygons is not None:
        indices = _as_indices(polygons.values)
        refuse_absent(indices, polygons.sizes, len(positions), path, lambda row: f"face {row}", base=0)
        triangles = triangulate(positions, indices, polygons.sizes, lambda row: f"{path}: face {row}")
        corners = indices[triangles]
    if strips is not None:
        corners = np.concatenate([corners, _strip_triangles(_as_indices(strips.values), strips.sizes)])
    elif polygons is not None:
        corner_uv = _corner_uv(faces, polygons, triangles, path)
        if corner_uv is not None:
            _warn_of_several_textures(faces.get("texnumber"), path)
    # With an index out of range no attribute is read: `read_mesh` reports the index.
    in_range = len(corners) > 0 and corners.min() >= 0 and corners.max() < len(positions)
    normals = _stack_columns(vertices, ("nx", "ny", "nz")) if in_range else None
    if corner_uv is None and in_range:
        uv = next((u for names in _TEXTURE_NAMES if (u := _stack_columns(vertices, names)) is not None), None)
        corner_uv = None if uv is None else uv[corners]
    return TriangleSoup(positions, corners, None if normals is None else normals[corners], corner_uv)


def _index_lists(columns: Columns, path: str | os.PathLike[str]) -> Lists | None:
    lists = next((column for name in _INDEX_LISTS if isinstance(column := columns.get(name), Lists)), None)
    if lists is not None and not (np.isfinite(lists.values).all() and np.equal(lists.values % 1, 0).all()):
        raise MeshError(f"{path}: the list vertex_indices has values that are not integers; export the mesh again")
    return lists


def _as_indices(values: NDArray[np.float64]) -> NDArray[np.int64]:
    """Convert to integers; those that are too large for any mesh stay too large."""
    return np.clip(values, -(2.0**53), 2.0**53).astype(np.int64)


def _strip_triangles(indices: NDArray[np.int64], sizes: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the triangles [F,3] of strips: three vertices in a row each, every second one reversed.

    Triangles with a repeated vertex only connect strips; they are left out.
    """
    number = np.arange(len(indices))
    ends, begins = np.isin(indices, _RESTARTS), np.zeros(len(indices), bool)
    begins[(np.cumsum(sizes) - sizes)[sizes > 0]] = True
    begins[1:] |= ends[:-1]
    place = number - np.maximum.accumulate(np.where(begins, number, 0))  # of each index in its strip
    rows = np.stack([indices[:-2], indices[1:-1], indices[2:]], axis=1)
    turned = place[2:] % 2 == 1
    rows[turned] = rows[turned][:, [1, 0, 2]]
    distinct = (rows != np.roll(rows, 1, axis=1)).all(axis=1)
    triangles: NDArray[np.int64] = rows[(place[2:] >= 2) & ~ends[2:] & distinct]
    return triangles


def _corner_uv(
    faces: Columns, lists: Lists, triangles: NDArray[np.int64], path: str | os.PathLike[str]
) -> NDArray[np.float64] | None:
    """Return the texture coordinates of the face list texcoord [F,3,2], or None."""
    pairs = faces.get("texcoord")
    if not isinstance(pairs, Lists) or len(pairs.values) == 0:
        return None
    wrong = pairs.sizes != 2 * lists.sizes
    if wrong.any():
        warn(
            f"{path}: {wrong.sum()} of {len(wrong)} faces do not have two texture coordinates at every corner, the "
            f"first is face {wrong.argmax()}; the list texcoord is not used, unwrap the whole mesh if a texture needs "
            f"it"
        )
        return None
    return np.asarray(pairs.values, np.float64).reshape(-1, 2)[triangles]


def _warn_of_several_textures(numbers: NDArray[np.float64] | Lists | None, path: str | os.PathLike[str]) -> None:
    """Warn if faces are mapped to several images, as MeshLab's property texnumber says."""
    if isinstance(numbers, np.ndarray) and len(distinct := np.unique(numbers)) > 1:
        warn(
            f"{path}: its texture coordinates are those of {len(distinct)} images (texnumber), but a mesh has one; "
            f"bake them into one image if a texture needs them"
        )


def _stack_columns(columns: Columns, names: tuple[str, ...]) -> NDArray[np.float64] | None:
    chosen = [column for name in names if isinstance(column := columns.get(name), np.ndarray)]
    return np.stack(chosen, axis=1) if len(chosen) == len(names) else None
