"""Clearances and hits from grids, without tracing a ray.

Deep inside, a grid stores a lower bound of the distance to the nearest face. Near the surface, a table lists the few
faces close to each cell, and these are intersected one by one. In thick media most flights and connections end before
any other face, and a handful of planes costs a third of a ray.
"""

from typing import Any

import numpy as np

from prt_bake.jit.kernel_functions import inlined_function
from prt_bake.tracer.surface.boundary import CORNERS, RAY_EPSILON
from prt_bake.tracer.surface.clearance import NEAR_CELLS, REACH

_MOST_FACES = 24
_MARGIN = 1e-6
"""Hits with barycentric coordinates closer to an edge than this are left to Embree."""


@inlined_function()
def clearance_at(boundary: Any, p: Any) -> Any:
    """Lower bound of the distance from p, inside the object, to any face; 0 if unknown."""
    clearance = _grid_clearance(boundary, p)
    if clearance > 0.0 or boundary.near.shape[0] == 0:
        return clearance
    return _plane_clearance(boundary, p)


@inlined_function()
def _grid_clearance(boundary: Any, p: Any) -> Any:
    """`clearance_at` from the grid alone, which is 0 near the surface."""
    n = boundary.clearance.shape[0]
    if n == 0:
        return 0.0
    x, y, z = int((p[0] + 0.5) * n), int((p[1] + 0.5) * n), int((p[2] + 0.5) * n)
    if x < 0 or y < 0 or z < 0 or x >= n or y >= n or z >= n:
        return 0.0
    return np.float64(boundary.clearance[z, y, x])


@inlined_function()
def _plane_clearance(boundary: Any, p: Any) -> Any:
    """`clearance_at` near the surface: the least distance to the planes of the listed faces."""
    first, last = _faces_near(boundary, p)
    if last == first:
        return 0.0
    clearance = REACH / NEAR_CELLS
    for i in range(first, last):
        # A point in front of a plane has no clearance: it is unknown whether the face or its neighbour is nearer.
        clearance = min(clearance, max(0.0, -_height(boundary.planes[boundary.near[i]], p)))
    return clearance


@inlined_function()
def _cell_axis(x: Any) -> Any:
    """Cell index of a coordinate, clamped to the box."""
    return min(max(int((x + 0.5) * NEAR_CELLS), 0), NEAR_CELLS - 1)


@inlined_function()
def _faces_near(boundary: Any, p: Any) -> Any:
    """Range in `near` of the faces close to p; empty if there are none or too many."""
    x, y, z = _cell_axis(p[0]), _cell_axis(p[1]), _cell_axis(p[2])
    cell = (z * NEAR_CELLS + y) * NEAR_CELLS + x
    first, last = boundary.near[cell], boundary.near[cell + 1]
    if last - first > _MOST_FACES:
        return 0, 0
    return first, last


@inlined_function()
def _height(plane: Any, p: Any) -> Any:
    """Signed distance of p in front of a plane."""
    return p[0] * plane[0] + p[1] * plane[1] + p[2] * plane[2] - plane[3]


@inlined_function()
def _known_distance(p: Any, d: Any) -> Any:
    """Distance along d from p within which the list of p's cell is complete."""
    far = np.inf
    for k in range(3):
        low = (_cell_axis(p[k]) - REACH) / NEAR_CELLS - 0.5
        side = (1.0 + 2.0 * REACH) / NEAR_CELLS
        if d[k] > 0.0:
            far = min(far, (low + side - p[k]) / d[k])
        elif d[k] < 0.0:
            far = min(far, (low - p[k]) / d[k])
    return far


@inlined_function()
def nearby_hit(boundary: Any, p: Any, d: Any, face: Any) -> Any:
    """First hit of p + t d from the listed faces: (face, t, u, v, whether p is certainly inside).

    Face −1: no hit before t; t is 0 if unknown. The ray starts on `face` (−1: none). Nested scenes are left to Embree.
    """
    if boundary.near.shape[0] == 0 or boundary.nested:
        return -1, 0.0, 0.0, 0.0, False
    first, last = _faces_near(boundary, p)
    if last == first:
        return -1, 0.0, 0.0, 0.0, False
    begin = RAY_EPSILON if face >= 0 else 0.0
    far = _known_distance(p, d)
    behind = True
    # Planes are tried in order of distance, ties in order of the list.
    tried = last
    while True:
        found, chosen, t = -1, last, far
        for i in range(first, last):
            plane = boundary.planes[boundary.near[i]]
            height = _height(plane, p)
            behind = behind and (height <= 0.0 or boundary.near[i] == face)
            slope = d[0] * plane[0] + d[1] * plane[1] + d[2] * plane[2]
            # Parallel planes are never hit.
            there = -height / slope if slope != 0.0 else np.inf
            later = there > begin or (there == begin and i > tried)
            if later and there < t and boundary.near[i] != face:
                found, chosen, t = boundary.near[i], i, there
        if found < 0:
            return -1, far, 0.0, 0.0, behind
        row = boundary.faces[found]
        u, v = _barycentric(row, p, d, t)
        least = min(u, min(v, 1.0 - u - v))
        if least > _MARGIN:
            return found, t, u, v, d[0] * row[0] + d[1] * row[1] + d[2] * row[2] > 0.0
        if not least < -_MARGIN:
            return -1, 0.0, 0.0, 0.0, False
        begin, tried = t, chosen


@inlined_function()
def _barycentric(row: Any, p: Any, d: Any, t: Any) -> Any:
    """Barycentric coordinates (u, v) of p + t d in the plane of a face."""
    ax, ay, az = row[CORNERS], row[CORNERS + 1], row[CORNERS + 2]
    ex, ey, ez = row[CORNERS + 3] - ax, row[CORNERS + 4] - ay, row[CORNERS + 5] - az
    fx, fy, fz = row[CORNERS + 6] - ax, row[CORNERS + 7] - ay, row[CORNERS + 8] - az
    qx, qy, qz = p[0] + t * d[0] - ax, p[1] + t * d[1] - ay, p[2] + t * d[2] - az
    ee, ef, ff = ex * ex + ey * ey + ez * ez, ex * fx + ey * fy + ez * fz, fx * fx + fy * fy + fz * fz
    eq, fq = ex * qx + ey * qy + ez * qz, fx * qx + fy * qy + fz * qz
    determinant = ee * ff - ef * ef
    if determinant <= 0.0:
        # A degenerate sliver is left to Embree.
        return 0.0, 0.0
    return (ff * eq - ef * fq) / determinant, (ee * fq - ef * eq) / determinant
