"""Grids that save rays: lower bounds of the distance to the nearest face, and the faces near each cell.

The box −½ … ½ is divided into cells. Cells that a face may touch and cells outside the object have clearance 0. For the
others a distance transform between cell centres becomes a bound that holds in the whole cell.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_FEWEST_FREE_PATHS = 2.0
"""In thinner objects, measured in mean free paths, flights rarely end where there is any clearance."""
_THICK = 120.0
_COARSE, _FINE = 48, 128
"""Cells along a side, below and above `_THICK` mean free paths."""
_THICK_NEAR = 20.0
_MOST_ENTRIES = 30_000_000
_ON_PLANE = 1e-6
_MOST_PAIRS = 100_000_000
NEAR_CELLS = 64
REACH = 1.0
"""Margin around a cell, in cell sides, within which its list of faces is complete."""


def clearance_grid(positions: Array, faces: NDArray[np.int64], depth: float) -> NDArray[np.float32]:
    """Clearances [n,n,n], z first, of faces within −½ … ½; n is 0 for thin objects. `depth`: size in mean free
    paths.
    """
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
    # Points of the cell and of a face are at most half a cell diagonal from their cells' centres. Faces are sampled,
    # each point less than a quarter of a cell from a sample.
    bound = (distance - np.sqrt(3.0) - 0.5) / n
    return np.ascontiguousarray(np.maximum(bound, 0.0), np.float32)


def near_faces(positions: Array, faces: NDArray[np.int64], depth: float) -> NDArray[np.int32]:
    """Faces near each cell, in one table: n³ + 1 offsets, then the concatenated lists of all cells; n is NEAR_CELLS.

    Every face that touches a cell grown by REACH sides is in its list. The table is empty for thin objects.
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
    """Which faces [F,28+] have nothing in front of their plane, so that a ray that leaves there hits nothing: bool [F].

    All faces of a convex object qualify. Testing the vertices of the convex hull suffices. If these are too many, a
    concave object counts as having no such face.
    """
    from scipy.spatial import ConvexHull, QhullError

    try:
        hull = positions[ConvexHull(positions).vertices]
    except QhullError:
        return np.zeros(len(rows), bool)
    if len(rows) * len(hull) > _MOST_PAIRS:
        import trimesh

        index = np.arange(3 * len(rows)).reshape(-1, 3)
        surface = trimesh.Trimesh(rows[:, 3:12].reshape(-1, 3), index, process=True)
        return np.full(len(rows), bool(surface.is_convex))
    normals = rows[:, :3]
    behind = np.einsum("fi,fi->f", normals, rows[:, 3:6]) + _ON_PLANE
    step = max(1, 4_000_000 // len(hull))
    blocks = [
        (normals[i : i + step] @ hull.T <= behind[i : i + step, None]).all(axis=1) for i in range(0, len(rows), step)
    ]
    return np.concatenate(blocks)


def _samples(corners: Array, spacing: float) -> list[Array]:
    """Samples of triangles [F,3,3] that leave no point farther than `spacing` away, in blocks of equal subdivision."""
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
