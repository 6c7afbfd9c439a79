"""Triangles as arrays: areas, angles, normals, merged vertices, edges. Lengths are in the mesh's own unit.

No library: trimesh merges vertices nearer than 1e-8, and its corner angles are arc cosines, which lose half of the
digits near 0.
"""

import numpy as np
from numpy.typing import NDArray

_SLIVER = 1e-12  # twice the area over the longest edge squared, below which float64 cannot tell the face from a line


def doubled_area_vectors(positions: NDArray[np.float64], faces: NDArray[np.integer]) -> NDArray[np.float64]:
    """Return the cross product of two edges of each face [F,3]: along the face normal, as long as twice the area."""
    a, b, c = (positions[faces[:, corner]] for corner in range(3))
    vectors: NDArray[np.float64] = np.cross(b - a, c - a)
    return vectors


def face_areas(positions: NDArray[np.float64], faces: NDArray[np.integer]) -> NDArray[np.float64]:
    """Return the area of each face [F], in squared units of length."""
    areas: NDArray[np.float64] = 0.5 * np.linalg.norm(doubled_area_vectors(positions, faces), axis=1)
    return areas


def face_normals(positions: NDArray[np.float64], faces: NDArray[np.integer]) -> NDArray[np.float64]:
    """Return the unit normal of each face [F,3], counter-clockwise seen from outside; zero where a face has no area."""
    return unit(doubled_area_vectors(positions, faces))


def unit(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Scale vectors [...,3] to length 1, of any magnitude that float64 holds; zero vectors stay zero."""
    largest = np.abs(vectors).max(axis=-1, keepdims=True)
    scaled = vectors / np.where(largest > 0, largest, 1.0)
    length = np.linalg.norm(scaled, axis=-1, keepdims=True)
    scaled /= np.where(length > 0, length, 1.0)
    return scaled


def faces_without_area(positions: NDArray[np.float64], faces: NDArray[np.integer]) -> NDArray[np.bool_]:
    """Mark the faces [F] whose corners lie on one line, or coincide, as far as float64 can tell."""
    corners = positions[faces]
    longest = np.square(corners - np.roll(corners, 1, axis=1)).sum(axis=2).max(axis=1)
    doubled = np.linalg.norm(doubled_area_vectors(positions, faces), axis=1)
    flat: NDArray[np.bool_] = doubled <= _SLIVER * longest
    return flat


def corner_angles(positions: NDArray[np.float64], faces: NDArray[np.integer]) -> NDArray[np.float64]:
    """Return the angle at each corner of each face [F,3], in radians; a face's three angles sum to pi."""
    corners = positions[faces]
    ahead = unit(np.roll(corners, -1, axis=1) - corners)
    behind = unit(np.roll(corners, 1, axis=1) - corners)
    # The half-angle form keeps its accuracy at 0 and pi, where the arc cosine of a dot product loses half the digits.
    angles: NDArray[np.float64] = 2 * np.arctan2(
        np.linalg.norm(ahead - behind, axis=2), np.linalg.norm(ahead + behind, axis=2)
    )
    return angles


def vertex_normals(
    positions: NDArray[np.float64], faces: NDArray[np.integer], corner_normals: NDArray[np.float64] | None = None
) -> NDArray[np.float64]:
    """Return unit normals [V,3]: the mean over the corners that meet at each vertex, weighted by the corners' angles.

    `corner_normals` [F,3,3] are averaged where given, else the face normals. The angle weights make the result
    independent of how a surface is cut into triangles (Thürmer and Wüthrich 1998). Where the mean vanishes (a vertex
    whose faces cancel one another) the normal of its first face is taken.
    """
    of_faces = face_normals(positions, faces)
    at_corners = np.repeat(of_faces[:, None], 3, axis=1) if corner_normals is None else corner_normals
    weighted = corner_angles(positions, faces)[..., None] * at_corners
    sums: NDArray[np.float64] = np.stack(
        [np.bincount(faces.ravel(), weighted[..., axis].ravel(), minlength=len(positions)) for axis in range(3)], axis=1
    )
    cancelled = np.linalg.norm(sums, axis=1) < 1e-9
    if cancelled.any():
        used, first_corner = np.unique(faces.ravel(), return_index=True)
        first_face = np.zeros(len(positions), np.int64)
        first_face[used] = first_corner // 3
        sums[cancelled] = of_faces[first_face[cancelled]]
    return unit(sums)


def merged(positions: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Find positions [n,3] that are equal to the last bit.

    Returns:
        The first index of each distinct position [V], ascending, and for each source its place among those [n].
    """
    _, first, inverse = np.unique(positions + 0.0, axis=0, return_index=True, return_inverse=True)  # -0.0 becomes 0.0
    order = np.argsort(first)
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order))
    return first[order].astype(np.int64), place[inverse.ravel()]


def edge_uses(faces: NDArray[np.integer]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Count how often each undirected edge is walked by the faces' borders.

    Returns:
        For each edge the number of faces that use it [E], and the sum of their senses [E]: +1 from the lower index to
        the higher, -1 back; 0 on a closed surface that is wound consistently.
    """
    start = faces.ravel().astype(np.int64)
    end = np.roll(faces, -1, axis=1).ravel().astype(np.int64)
    keys = np.minimum(start, end) * (int(faces.max()) + 1) + np.maximum(start, end)
    _, edge = np.unique(keys, return_inverse=True)
    senses = np.bincount(edge, np.where(start < end, 1.0, -1.0)).astype(np.int64)
    return np.bincount(edge).astype(np.int64), senses
