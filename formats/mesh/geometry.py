"""Geometry of triangle arrays: areas, angles, normals, merged vertices. Lengths are in the mesh's unit.

No library: trimesh merges vertices closer than 1e-8, and computes corner angles with arc cosines, which lose half of
the digits near 0.
"""

import numpy as np
from numpy.typing import NDArray

SLIVER = 1e-12
"""Twice the area of a triangle over its longest edge squared; a smaller ratio is a line to float64."""
_CANCELLED = 1e-4
"""Length of the sum of normals about a vertex over the sum of their weights, below which its direction is rounding."""
MOST_COORDINATE = 1e30
"""Largest coordinate of a vertex, as in scene files."""


def doubled_area_vectors(positions: NDArray[np.float64], faces: NDArray[np.integer]) -> NDArray[np.float64]:
    """Return the cross product of two edges of each face [F,3]: along the normal, of length twice the area."""
    a, b, c = (positions[faces[:, corner]] for corner in range(3))
    vectors: NDArray[np.float64] = np.cross(b - a, c - a)
    return vectors


def face_areas(positions: NDArray[np.float64], faces: NDArray[np.integer]) -> NDArray[np.float64]:
    """Return the area of each face [F], in squared units of length."""
    areas: NDArray[np.float64] = 0.5 * np.linalg.norm(doubled_area_vectors(positions, faces), axis=1)
    return areas


def face_normals(positions: NDArray[np.float64], faces: NDArray[np.integer]) -> NDArray[np.float64]:
    """Return the unit normal of each face [F,3], towards the side that sees it counter-clockwise; 0 without area."""
    return normalise(doubled_area_vectors(positions, faces))


def normalise(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Scale vectors [...,3] to length 1 without overflow or underflow; zero vectors stay zero."""
    largest = np.abs(vectors).max(axis=-1, keepdims=True)
    scaled = vectors / np.where(largest > 0, largest, 1.0)
    length = np.linalg.norm(scaled, axis=-1, keepdims=True)
    scaled /= np.where(length > 0, length, 1.0)
    return scaled


def faces_without_area(positions: NDArray[np.float64], faces: NDArray[np.integer]) -> NDArray[np.bool_]:
    """Mark the faces [F] whose corners are collinear or coincide, to the precision of float64."""
    corners = positions[faces]
    longest = np.square(corners - np.roll(corners, 1, axis=1)).sum(axis=2).max(axis=1)
    doubled = np.linalg.norm(doubled_area_vectors(positions, faces), axis=1)
    flat: NDArray[np.bool_] = doubled <= SLIVER * longest
    return flat


def corner_angles(positions: NDArray[np.float64], faces: NDArray[np.integer]) -> NDArray[np.float64]:
    """Return the angle at each corner of each face [F,3], in radians."""
    corners = positions[faces]
    ahead = normalise(np.roll(corners, -1, axis=1) - corners)
    behind = normalise(np.roll(corners, 1, axis=1) - corners)
    # The half-angle form keeps its accuracy at 0 and pi, where the arc cosine of a dot product loses half the digits.
    angles: NDArray[np.float64] = 2 * np.arctan2(
        np.linalg.norm(ahead - behind, axis=2), np.linalg.norm(ahead + behind, axis=2)
    )
    return angles


def vertex_normals(
    positions: NDArray[np.float64], faces: NDArray[np.integer], corner_normals: NDArray[np.float64] | None = None
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return unit normals [V,3]: the mean over the corners that meet at each vertex, weighted by the corners' angles.

    Averages `corner_normals` [F,3,3] if given, else the face normals. The angle weights make the result independent of
    the triangulation (Thürmer and Wüthrich 1998). If the mean vanishes, the vertex gets the normal of its first face.

    Returns:
        The normals, and at which vertices [V] of faces the mean vanishes.
    """
    normals_of_faces = face_normals(positions, faces)
    at_corners = np.repeat(normals_of_faces[:, None], 3, axis=1) if corner_normals is None else corner_normals
    angles = corner_angles(positions, faces)
    weighted = angles[..., None] * at_corners
    sums: NDArray[np.float64] = np.stack(
        [np.bincount(faces.ravel(), weighted[..., axis].ravel(), minlength=len(positions)) for axis in range(3)], axis=1
    )
    weights = np.bincount(faces.ravel(), angles.ravel(), minlength=len(positions))
    cancelled: NDArray[np.bool_] = np.linalg.norm(sums, axis=1) <= _CANCELLED * weights
    used, first_corner = np.unique(faces.ravel(), return_index=True)
    first_face = np.zeros(len(positions), np.int64)
    first_face[used] = first_corner // 3
    sums[cancelled] = normals_of_faces[first_face[cancelled]]
    return normalise(sums), cancelled & (np.bincount(faces.ravel(), minlength=len(positions)) > 0)


def signed_volume(positions: NDArray[np.float64], faces: NDArray[np.integer]) -> float:
    """Return the volume that a closed surface encloses, in cubed units; negative if its faces are wound inside out.

    Positions far from the origin lose digits: centre them first.
    """
    a, b, c = (positions[faces[:, corner]] for corner in range(3))
    return float(np.einsum("fi,fi->", a, np.cross(b, c)) / 6)


def merge_positions(positions: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Merge positions [n,3] that are equal to the last bit.

    Returns:
        The first index of each distinct position [V], ascending, and for each position its index among those [n].
    """
    _, first, inverse = np.unique(positions + 0.0, axis=0, return_index=True, return_inverse=True)  # -0.0 becomes 0.0
    order = np.argsort(first)
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    return first[order].astype(np.int64), rank[inverse.ravel()]
