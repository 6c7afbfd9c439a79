"""Compiled uniform grid over a mesh that finds the faces near a point."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from prt_bake.jit.compilation import compiled
from prt_bake.jit.threads import in_threads

_FACES_PER_CELL = 2.0
_MOST_CELLS = 128
_QUERIES_PER_SLICE = 256


class FaceGrid(NamedTuple):
    """Faces by cell: `members[starts[c] : starts[c + 1]]` are the faces within `reach` of cell c."""

    corners: NDArray[np.float64]
    low: NDArray[np.float64]
    side: float
    shape: NDArray[np.int64]
    starts: NDArray[np.int64]
    members: NDArray[np.int64]
    reach: float


def build_grid(positions: NDArray[np.float64], faces: NDArray[np.int64], reach: float) -> FaceGrid:
    """Assign each face of a mesh to all cells that its bounding box, extended by `reach`, overlaps."""
    corners = np.ascontiguousarray(positions[faces])
    low = corners.min(axis=(0, 1)) - 2 * reach
    extent = corners.max(axis=(0, 1)) + 2 * reach - low
    across = min(_MOST_CELLS, max(1, int(np.sqrt(len(faces) / _FACES_PER_CELL))))
    side = float(extent.max()) / across
    shape = np.maximum(1, np.ceil(extent / side)).astype(np.int64)
    counts = np.zeros(int(shape.prod()), np.int64)
    _visit_cells(corners, low, side, shape, reach, counts, np.zeros(0, np.int64), False)
    starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    members = np.empty(int(starts[-1]), np.int64)
    _visit_cells(corners, low, side, shape, reach, starts[:-1].copy(), members, True)
    return FaceGrid(corners, low, side, shape, starts, members, reach)


@compiled()
def _visit_cells(
    corners: Any, low: Any, side: Any, shape: Any, reach: Any, cursor: Any, members: Any, fill: Any
) -> None:
    first, last = np.zeros(3, np.int64), np.zeros(3, np.int64)
    for f in range(corners.shape[0]):
        for k in range(3):
            smallest = min(corners[f, 0, k], min(corners[f, 1, k], corners[f, 2, k])) - reach
            largest = max(corners[f, 0, k], max(corners[f, 1, k], corners[f, 2, k])) + reach
            first[k] = min(max(int((smallest - low[k]) / side), 0), shape[k] - 1)
            last[k] = min(max(int((largest - low[k]) / side), 0), shape[k] - 1)
        for z in range(first[2], last[2] + 1):
            for y in range(first[1], last[1] + 1):
                for x in range(first[0], last[0] + 1):
                    cell = (z * shape[1] + y) * shape[0] + x
                    if fill:
                        members[cursor[cell]] = f
                    cursor[cell] += 1


@compiled()
def closest(a: Any, b: Any, c: Any, p: Any) -> Any:
    """Squared distance from p to a triangle, and (u, v) of the closest point (Ericson 2005, section 5.1.5)."""
    ab, ac, ap = b - a, c - a, p - a
    d1, d2 = np.dot(ab, ap), np.dot(ac, ap)
    if d1 <= 0.0 and d2 <= 0.0:
        u, v = 0.0, 0.0
    else:
        bp, cp = p - b, p - c
        d3, d4 = np.dot(ab, bp), np.dot(ac, bp)
        d5, d6 = np.dot(ab, cp), np.dot(ac, cp)
        va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
        if d3 >= 0.0 and d4 <= d3:
            u, v = 1.0, 0.0
        elif d6 >= 0.0 and d5 <= d6:
            u, v = 0.0, 1.0
        elif vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
            u, v = d1 / (d1 - d3), 0.0
        elif vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
            u, v = 0.0, d2 / (d2 - d6)
        elif va <= 0.0 and d4 >= d3 and d5 >= d6:
            v = (d4 - d3) / ((d4 - d3) + (d5 - d6))
            u = 1.0 - v
        else:
            u, v = vb / (va + vb + vc), vc / (va + vb + vc)
    away = ap - u * ab - v * ac
    return np.dot(away, away), u, v


@compiled(nogil=True)
def _chosen(grid: Any, face_normals: Any, p: Any, eye: Any) -> Any:
    """The face in reach of p that faces `eye` most, on a tie the lowest (−1: none), (u, v) on it, and the cosine."""
    face, best_u, best_v, most = -1, 0.0, 0.0, -2.0
    cell = 0
    for k in range(2, -1, -1):
        i = int(np.floor((p[k] - grid.low[k]) / grid.side))
        if not 0 <= i < grid.shape[k]:
            return face, best_u, best_v, most
        cell = cell * grid.shape[k] + i
    for m in range(grid.starts[cell], grid.starts[cell + 1]):
        f = grid.members[m]
        cosine = np.dot(eye, face_normals[f])
        if cosine > most:
            squared, u, v = closest(grid.corners[f, 0], grid.corners[f, 1], grid.corners[f, 2], p)
            if np.sqrt(squared) <= grid.reach:
                face, best_u, best_v, most = f, u, v, cosine
    return face, best_u, best_v, most


def choose_faces(grid: Any, face_normals: Any, positions: Any, outgoing: Any) -> Any:
    """`_chosen` for N queries: faces [N] (−1: none in reach), (u, v) [N,2], ωo·n [N]."""
    count = len(positions)
    chosen = np.full(count, -1, np.int64), np.zeros((count, 2)), np.full(count, -2.0)
    in_threads(_choose, count, grid, face_normals, positions, outgoing, *chosen, least=_QUERIES_PER_SLICE)
    return chosen


@compiled(nogil=True)
def _choose(
    start: Any,
    stop: Any,
    grid: Any,
    face_normals: Any,
    positions: Any,
    outgoing: Any,
    faces: Any,
    barycentric: Any,
    cosines: Any,
) -> None:
    for n in range(start, stop):
        face, u, v, cosine = _chosen(grid, face_normals, positions[n], outgoing[n])
        faces[n], cosines[n] = face, cosine
        barycentric[n, 0], barycentric[n, 1] = u, v


@compiled(nogil=True)
def normals_of_chosen(
    grid: Any, face_normals: Any, corner_normals: Any, positions: Any, outgoing: Any, normals: Any
) -> None:
    """Write normals [N,3] of the faces that `choose_faces` chooses, interpolated between corner_normals [F,3,3]; 0 if
    there is none. Single-threaded, so that several calls may run in parallel.
    """
    for n in range(positions.shape[0]):
        face, u, v, _cosine = _chosen(grid, face_normals, positions[n], outgoing[n])
        normals[n] = 0.0
        if face >= 0:
            corners = corner_normals[face]
            normal = (1.0 - u - v) * corners[0] + u * corners[1] + v * corners[2]
            normals[n] = normal / max(np.sqrt(np.dot(normal, normal)), 1e-12)


@compiled()
def distance_to_mesh(grid: Any, p: Any) -> Any:
    """Distance from one point to the mesh, by testing every face."""
    best = np.inf
    for f in range(grid.corners.shape[0]):
        squared, _u, _v = closest(grid.corners[f, 0], grid.corners[f, 1], grid.corners[f, 2], p)
        best = min(best, squared)
    return np.sqrt(best)
