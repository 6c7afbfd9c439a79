"""Triangles of one primitive: placed by the matrices of nodes, instances or joints, and joined to a soup."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from formats.errors import warn
from formats.triangle_soup import SoupPart, TriangleSoup

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Part:
    """Triangles with one value per vertex.

    Attributes:
        positions: float64 [n,3].
        faces: int64 [F,3], indices into positions.
        normals: float64 [n,3], of any length, or None.
        uv: float64 [n,2], v upwards, or None.
        uv_name: the attribute that they are from.
        rows: the vertices of the primitive that a copy of it has [n / copies], ascending; None if it has all of them.
        place: where the primitive is in the file, for errors.
        copies: number of copies of the primitive.
    """

    positions: Array
    faces: NDArray[np.int64]
    normals: Array | None
    uv: Array | None
    uv_name: str = ""
    rows: NDArray[np.int64] | None = None
    place: str = ""
    copies: int = 1


def place(part: Part, matrices: Array, node: str) -> Part:
    """Transform a part; the winding is reversed where a matrix mirrors, so that fronts stay fronts.

    Args:
        part: the part, of n vertices.
        matrices: [I,1,4,4] for I copies of the part, or [1,n,4,4], one for each vertex.
        node: the place of the node that shows it.
    """
    copies, count = len(matrices), len(part.positions)
    positions = _product(matrices[..., :3, :3], part.positions) + matrices[..., :3, 3]
    mirrored = np.broadcast_to(np.linalg.det(matrices[..., :3, :3]) < 0, (copies, count))
    turned = mirrored[:, part.faces].sum(axis=2) >= 2
    faces = np.where(turned[..., None], part.faces[:, ::-1], part.faces) + count * np.arange(copies)[:, None, None]
    normals = None if part.normals is None else _product(_normal_matrices(matrices), part.normals).reshape(-1, 3)
    uv = None if part.uv is None else np.tile(part.uv, (copies, 1))
    words = f"{node}, {part.place}"
    return Part(positions.reshape(-1, 3), faces.reshape(-1, 3), normals, uv, part.uv_name, part.rows, words, copies)


def join(parts: list[Part], path: str) -> TriangleSoup:
    """Return all parts as one soup. Warn if only some have normals or texture coordinates; then all lose them."""
    sets = sorted({part.uv_name for part in parts if part.uv is not None})
    if len(sets) > 1:
        warn(f"{path}: parts have texture coordinates of different sets, as their materials use: {', '.join(sets)}")
    starts = np.cumsum([0, *(len(part.positions) for part in parts)])
    first_faces = np.cumsum([0, *(len(part.faces) for part in parts)])
    return TriangleSoup(
        np.concatenate([part.positions for part in parts]),
        np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=False)]),
        _at_corners([(part.normals, part.faces) for part in parts], path, "normals"),
        _at_corners([(part.uv, part.faces) for part in parts], path, "texture coordinates"),
        tuple(_named(part, vertex, face) for part, vertex, face in zip(parts, starts, first_faces, strict=False)),
    )


def _named(part: Part, first_vertex: int, first_face: int) -> SoupPart:
    """Return where a placed part is in the file and, from its first vertex and face, in the soup."""
    numbers = range(len(part.positions) // part.copies) if part.rows is None else part.rows
    return SoupPart(part.place, first_vertex, first_face, part.copies, len(part.faces) // part.copies, numbers)


def _at_corners(parts: list[tuple[Array | None, NDArray[np.int64]]], path: str, name: str) -> Array | None:
    """Return the values at the corners of all faces [F,3,k], or None if a part has none."""
    present = [values[faces] for values, faces in parts if values is not None]
    if present and len(present) < len(parts):
        warn(
            f"{path}: {len(parts) - len(present)} of {len(parts)} parts have no {name}; those of the others are ignored"
        )
    return np.concatenate(present) if present and len(present) == len(parts) else None


def _product(matrices: Array, vectors: Array) -> Array:
    """Multiply matrices [...,3,3] by vectors [n,3].

    Each product is rounded alone, so that equal vertices stay equal; a matrix product of BLAS does not promise that.
    """
    x, y, z = (vectors[:, None, axis] for axis in range(3))
    product: Array = matrices[..., 0] * x + matrices[..., 1] * y + matrices[..., 2] * z
    return product


def _normal_matrices(matrices: Array) -> Array:
    """Return the inverse transposes of matrices [...,4,4] times the size of the determinant [...,3,3].

    The columns are cross products, which exist where a matrix is singular.
    """
    a, b, c = (matrices[..., :3, axis] for axis in range(3))
    cofactors = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=-1)
    sign = np.where(np.linalg.det(matrices[..., :3, :3]) < 0, -1.0, 1.0)
    signed: Array = cofactors * sign[..., None, None]
    return signed
