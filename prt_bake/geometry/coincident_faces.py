"""Faces that lie on one another, or nearly, with a common area: a ray meets them in arbitrary order.

No library: trimesh finds faces with equal vertices only, and its trees of boxes need a further package, rtree.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from formats.mesh import Mesh

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

COINCIDENT = 9e-8
"""Distance, in longest sides of the object, below which Embree takes two planes in arbitrary order: one and a half
roundings to float32. At this distance it mistakes one ray in a hundred, at twice the distance one in 5,000."""
THINNEST = 9e-7
"""Thickness of a solid, in longest sides, below which its faces coincide. A ray that starts on one face misses another
within 1e-6 of it; behind the second face of a gap that is no error."""
NEAR = 1e-5
"""Distance, in longest sides, below which planes count as near; narrower common areas are ignored."""
_BLOCK = 200_000  # pairs of boxes in memory at once
_CHILDREN = np.array([(0, 0), (0, 1), (1, 0), (1, 1)])


def near_faces(mesh: Mesh, size: float) -> tuple[Indices, NDArray[np.bool_]]:
    """Pairs of faces [N,2], the larger first, that are near one another over a common area; which coincide [N].

    `size` is the object's longest side. Faces that share a vertex count only if they coincide: near it, all are near.
    """
    corners = mesh.positions[mesh.faces] - mesh.center
    margin = 0.5 * NEAR * size
    pairs, coincide = [np.zeros((0, 2), np.int64)], [np.zeros(0, bool)]
    for found in _touching_boxes(corners.min(axis=1) - margin, corners.max(axis=1) + margin):
        areas = mesh.face_areas[found]
        larger, smaller = np.where(areas[:, 0] >= areas[:, 1], found.T, found.T[::-1])
        normals = mesh.face_normals[larger]
        heights = np.einsum("nki,ni->kn", corners[smaller] - corners[larger, :1], normals)
        distance = np.abs(heights).max(axis=0)
        rows = np.flatnonzero(distance <= NEAR * size)
        larger, smaller, normals, distance = larger[rows], smaller[rows], normals[rows], distance[rows]
        opposed = np.einsum("ni,ni->n", normals, mesh.face_normals[smaller]) < 0.0
        solid_between = opposed & (heights[:, rows].min(axis=0) < 0.0)
        one = distance <= size * np.where(solid_between, THINNEST, COINCIDENT)
        shared = (mesh.faces[larger][:, :, None] == mesh.faces[smaller][:, None]).any(axis=(1, 2))
        rows = np.flatnonzero(one | ~shared)
        rows = rows[_overlap(corners[larger[rows]], corners[smaller[rows]], normals[rows], NEAR * size)]
        pairs.append(np.stack([larger[rows], smaller[rows]], axis=1))
        coincide.append(one[rows])
    return np.concatenate(pairs), np.concatenate(coincide)


def common_points(mesh: Mesh, pairs: Indices) -> Array:
    """A point of each pair's common area [N,3], on the second face."""
    corners = mesh.positions[mesh.faces]
    points = [_common_point(corners[a], corners[b], mesh.face_normals[a]) for a, b in pairs]
    return np.reshape(points, (-1, 3))


def _overlap(first: Array, second: Array, normals: Array, width: float) -> Indices:
    """Which triangles [N,3,3] overlap by more than `width` in the planes of `normals` [N,3].

    Separating axes: convex polygons are apart if they are apart across one of their edges.
    """
    left = np.arange(len(first))
    for triangles in (first, second):
        for k in range(3):
            axis = np.cross(normals[left], triangles[left, k] - triangles[left, k - 1])
            length = np.linalg.norm(axis, axis=1)
            a, b = (np.einsum("nki,ni->kn", corners[left] - first[left, :1], axis) for corners in (first, second))
            depth = np.minimum(a.max(axis=0), b.max(axis=0)) - np.maximum(a.min(axis=0), b.min(axis=0))
            left = left[depth > width * length]
    return left


def _common_point(larger: Array, smaller: Array, normal: Array) -> Array:
    """The mean corner of what is left of the smaller triangle inside the edges of the larger (Sutherland–Hodgman)."""
    polygon = list(smaller)
    for start, end in zip(larger, np.roll(larger, -1, axis=0), strict=True):
        inwards = np.cross(normal, end - start)
        inside = [float((point - start) @ inwards) for point in polygon]
        kept = []
        for k in range(len(polygon)):
            if inside[k - 1] * inside[k] < 0.0:
                share = inside[k] / (inside[k] - inside[k - 1])
                kept.append((1.0 - share) * polygon[k] + share * polygon[k - 1])
            if inside[k] >= 0.0:
                kept.append(polygon[k])
        polygon = kept
    return np.asarray(np.mean(polygon, axis=0))


def _touching_boxes(low: Array, high: Array) -> Iterator[Indices]:
    """Every pair of boxes [F,3] that touch, once, in blocks [N,2]: a binary tree of boxes against itself."""
    order, levels = _tree(low, high)
    pending = [(len(levels) - 1, np.zeros((1, 2), np.int64))]
    while pending:
        level, pairs = pending.pop()
        if level == 0:
            yield order[pairs[pairs[:, 0] < pairs[:, 1]]]
            continue
        low, high = levels[level - 1]
        pairs = (2 * pairs[:, None] + _CHILDREN).reshape(-1, 2)
        pairs = pairs[pairs[:, 0] <= pairs[:, 1]]
        first, second = pairs.T
        pairs = pairs[((low[first] <= high[second]) & (low[second] <= high[first])).all(axis=1)]
        blocks = np.array_split(pairs, -(-len(pairs) // _BLOCK)) if len(pairs) else []
        pending += [(level - 1, block) for block in blocks]


def _tree(low: Array, high: Array) -> tuple[Indices, list[tuple[Array, Array]]]:
    """The order of the boxes in the lowest level, and the boxes of all levels: two become one in the next.

    Boxes of similar size that lie near one another are neighbours; large ones would widen the boxes of small ones.
    """
    from scipy.spatial import cKDTree

    order = cKDTree(0.5 * (low + high), leafsize=1).indices.astype(np.int64)
    exponent = np.frexp((high - low).max(axis=1))[1]
    order = order[np.argsort(exponent[order], kind="stable")]
    missing = (1 << (len(order) - 1).bit_length()) - len(order)
    low = np.concatenate([low[order], np.full((missing, 3), np.inf)])
    high = np.concatenate([high[order], np.full((missing, 3), -np.inf)])
    levels = [(low, high)]
    while len(low) > 1:
        low, high = low.reshape(-1, 2, 3).min(axis=1), high.reshape(-1, 2, 3).max(axis=1)
        levels.append((low, high))
    return order, levels
