"""How far it is to the nearest face, at least, from anywhere inside: deep in a thick object no ray need be traced.

The box −½ … ½ is cut into cells; those that a face may touch have no clearance, and neither have those outside the
object. For the others the distance between cell centres is turned into a bound that holds for every point of the cell.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_FEWEST_FREE_PATHS = 2.0
"""In objects thinner than this, in mean free paths, flights seldom end where there is any clearance."""
_THICK = 120.0
_COARSE, _FINE = 48, 128
_THICK_NEAR = 20.0
_MOST_ENTRIES = 30_000_000
_ON_PLANE = 1e-6
_MOST_PAIRS = 100_000_000
NEAR_CELLS = 64
REACH = 1.0
"""In sides of a cell of NEAR_CELLS."""


def clearance_grid(positions: Array, faces: NDArray[np.int64], depth: float) -> NDArray[np.float32]:
    """Clearances [n,n,n], z first, for faces within −½ … ½ and an object `depth` mean free paths across; n may be 0."""
    if depth < _FEWEST_FREE_PATHS:
        return np.zeros((0, 0, 0), np.float32)
    from scipy import ndimage

    n = _COARSE if depth < _THICK else _FINE
    touched = np.zeros((n + 2,) * 3, bool)
    for points in _samples(positions[faces], 0.5 / n):
        x, y, z = np.clip(((points + 0.5) * n).astype(int), 0, n - 1).T + 1
        touched[z, y, x] = True
    labels, _count = ndimage.label(~touched)
    outside = labels == labels[0, 0, 0]
    distance = ndimage.distance_transform_edt(~(touched | outside))[1:-1, 1:-1, 1:-1]
    # A point of the cell and a point of a face lie at most half a cell's diagonal from their centres; the faces are
    # known at samples, which miss the nearest point by less than a quarter of a cell.
    bound = (distance - np.sqrt(3.0) - 0.5) / n
    return np.ascontiguousarray(np.maximum(bound, 0.0), np.float32)


def near_faces(positions: Array, faces: NDArray[np.int64], depth: float) -> NDArray[np.int32]:
    """Which faces come near each cell: n³ + 1 places, then the faces of one cell after those of another.

    A face that a cell does not name stays out of the cell grown by REACH of its side on every side. n is NEAR_CELLS, or
    the table empty where the object is thin.
    """
    n = NEAR_CELLS
    if depth < _THICK_NEAR:
        return np.zeros(0, np.int32)
    corners = positions[faces]
    low = np.clip(np.floor((corners.min(axis=1) + 0.5) * n - REACH), 0, n - 1).astype(np.int64)
    high = np.clip(np.floor((corners.max(axis=1) + 0.5) * n + REACH), 0, n - 1).astype(np.int64)
    spans = high - low + 1
    count = spans.prod(axis=1)
    if count.sum() > _MOST_ENTRIES:
        return np.zeros(0, np.int32)
    face = np.repeat(np.arange(len(faces)), count)
    nth = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    x = low[face, 0] + nth % spans[face, 0]
    y = low[face, 1] + nth // spans[face, 0] % spans[face, 1]
    z = low[face, 2] + nth // (spans[face, 0] * spans[face, 1])
    cell = (z * n + y) * n + x
    centre = (np.stack([x, y, z], axis=1) + 0.5) / n - 0.5
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    away = np.abs(np.einsum("ni,ni->n", centre - corners[face, 0], normals[face]))
    near = away <= (0.5 + REACH) * np.sqrt(3.0) / n
    face, cell = face[near], cell[near]
    order = np.argsort(cell, kind="stable")
    starts = np.searchsorted(cell[order], np.arange(n**3 + 1)) + n**3 + 1
    return np.concatenate([starts, face[order]]).astype(np.int32)


def open_faces(rows: Array, positions: Array) -> NDArray[np.bool_]:
    """Which faces [F,28] have nothing in front of their plane: a ray that leaves by them meets nothing any more.

    On a convex object that is every face. Only the corners of the convex hull need be looked at; where even those are
    too many, an object that is not convex all over counts as having no such face.
    """
    from scipy.spatial import ConvexHull, QhullError

    try:
        hull = positions[ConvexHull(positions).vertices]
    except QhullError:
        return np.zeros(len(rows), bool)
    if len(rows) * len(hull) > _MOST_PAIRS:
        import trimesh

        index = np.arange(3 * len(rows)).reshape(-1, 3)
        whole = trimesh.Trimesh(rows[:, 3:12].reshape(-1, 3), index, process=True)
        return np.full(len(rows), bool(whole.is_convex))
    normals = rows[:, :3]
    behind = np.einsum("fi,fi->f", normals, rows[:, 3:6]) + _ON_PLANE
    step = max(1, 4_000_000 // len(hull))
    lots = [
        (normals[i : i + step] @ hull.T <= behind[i : i + step, None]).all(axis=1) for i in range(0, len(rows), step)
    ]
    return np.concatenate(lots)


def _samples(corners: Array, spacing: float) -> list[Array]:
    """Points on triangles [F,3,3], no place of one farther than `spacing` from them, in lots of equal fineness."""
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    steps = np.maximum(1, np.ceil(edges / spacing).astype(int))
    lots = []
    for count in np.unique(2 ** np.ceil(np.log2(steps)).astype(int)):
        chosen = corners[2 ** np.ceil(np.log2(steps)).astype(int) == count]
        i, j = np.meshgrid(np.arange(count + 1), np.arange(count + 1))
        u, v = (i[i + j <= count] / count), (j[i + j <= count] / count)
        rows = max(1, 2_000_000 // len(u))
        for first in range(0, len(chosen), rows):
            some = chosen[first : first + rows]
            points = (
                some[:, None, 0] * (1 - u - v)[None, :, None]
                + some[:, None, 1] * u[None, :, None]
                + some[:, None, 2] * v[None, :, None]
            )
            lots.append(points.reshape(-1, 3))
    return lots
