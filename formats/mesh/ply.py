"""PLY, ascii and binary (Greg Turk, "The PLY Polygon File Format", 1994: http://paulbourke.net/dataformats/ply/).

Numbers keep their full precision. The reader uses the vertex properties x y z, nx ny nz and u v (or s t, texture_u
texture_v), the face list vertex_indices (or vertex_index) and the face list texcoord (two numbers per corner, as
MeshLab writes it). It ignores everything else.

No library: trimesh reads a truncated ASCII file without its last face, accepts lists of negative length and writes
float32; plyfile is under the GPL.
"""

import os
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from formats.errors import MeshError
from formats.mesh.ply_body import Columns, Element, Lists, PlyBody, Property
from formats.mesh.soup import TriangleSoup, fan

_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4"},
    **{"double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float32": "f4", "float64": "f8"},
}
_BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}
_FACE_LISTS = ("vertex_indices", "vertex_index")
_TEXTURE_NAMES = (("u", "v"), ("s", "t"), ("texture_u", "texture_v"))


def read_ply(path: str | os.PathLike[str]) -> TriangleSoup:
    """Read a PLY file.

    Raises:
        MeshError: the file is not PLY, is truncated, or lacks vertices or faces.
    """
    with open(path, "rb") as file:
        content = file.read()
    byte_order, elements, start = _header(content, path)
    body = PlyBody(content[start:], byte_order, path)
    columns = {element.name: body.columns(element) for element in elements}
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


def _header(content: bytes, path: str | os.PathLike[str]) -> tuple[str, list[Element], int]:
    """Return the byte order (empty for ascii), the elements in file order and the offset of the body."""
    if content[:4] not in (b"ply\n", b"ply\r"):
        raise MeshError(f"{path}: is not a PLY file: expected 'ply' in the first line, found {content[:4]!r}")
    mark = content.find(b"end_header")
    end = content.find(b"\n", mark)
    if mark < 0 or end < 0:
        raise MeshError(f"{path}: the PLY header has no line end_header; the file is truncated, export it again")
    encoding: str | None = None
    elements: list[Element] = []
    for number, line in enumerate(content[:mark].decode("ascii", "replace").splitlines(), start=1):
        try:
            match line.split():
                case ["format", name, *_]:
                    encoding = _BYTE_ORDERS[name]
                case ["element", name, rows]:
                    elements.append(Element(name, int(rows)))
                case ["property", "list", count_kind, kind, name]:
                    elements[-1].properties.append(Property(name, _TYPES[kind], _TYPES[count_kind]))
                case ["property", kind, name]:
                    elements[-1].properties.append(Property(name, _TYPES[kind]))
                case [] | ["ply" | "comment" | "obj_info", *_]:
                    pass
                case _:
                    raise ValueError
        except (ValueError, KeyError, IndexError) as cause:
            raise MeshError(
                f"{path}: line {number} of the PLY header: expected format, element or property, found {line.strip()!r}"
            ) from cause
    if encoding is None:
        raise MeshError(f"{path}: the PLY header has no format line; expected ascii or binary")
    if any(element.rows < 0 for element in elements):
        raise MeshError(f"{path}: the PLY header has an element with a negative number of rows")
    return encoding, elements, end + 1


def _soup(elements: Mapping[str, Columns], path: str | os.PathLike[str]) -> TriangleSoup:
    vertices, faces = elements.get("vertex", {}), elements.get("face", {})
    positions = _stack_columns(vertices, ("x", "y", "z"))
    if positions is None:
        raise MeshError(f"{path}: the element vertex has no properties x, y and z; export the mesh again")
    lists = next((column for name in _FACE_LISTS if isinstance(column := faces.get(name), Lists)), None)
    if lists is None:
        raise MeshError(f"{path}: has no faces (no list vertex_indices); expected a surface, not a point cloud")
    if not np.array_equal(lists.values, np.floor(lists.values)) or not np.isfinite(lists.values).all():
        raise MeshError(f"{path}: the face list vertex_indices has values that are not integers")
    triangles = fan(lists.sizes)
    corners = lists.values.astype(np.int64)[triangles]
    # With an index out of range no attribute is read: `read_mesh` reports the index.
    in_range = len(corners) > 0 and corners.min() >= 0 and corners.max() < len(positions)
    normals = _stack_columns(vertices, ("nx", "ny", "nz")) if in_range else None
    corner_uv = _corner_uv(faces, lists, triangles)
    if corner_uv is None and in_range:
        uv = next((u for names in _TEXTURE_NAMES if (u := _stack_columns(vertices, names)) is not None), None)
        corner_uv = None if uv is None else uv[corners]
    return TriangleSoup(positions, corners, None if normals is None else normals[corners], corner_uv)


def _corner_uv(faces: Columns, lists: Lists, triangles: NDArray[np.int64]) -> NDArray[np.float64] | None:
    """Return the texture coordinates of the face list texcoord [F,3,2], or None."""
    pairs = faces.get("texcoord")
    if not isinstance(pairs, Lists) or not np.array_equal(pairs.sizes, 2 * lists.sizes):
        return None
    return np.asarray(pairs.values, np.float64).reshape(-1, 2)[triangles]


def _stack_columns(columns: Columns, names: tuple[str, ...]) -> NDArray[np.float64] | None:
    chosen = [column for name in names if isinstance(column := columns.get(name), np.ndarray)]
    return np.stack(chosen, axis=1) if len(chosen) == len(names) else None
