"""What is known about the faces close to a place without tracing a ray.

Deep inside, a grid of clearances says how far the nearest face is. Near the surface a table names the few faces close
to each cell, and those are met one by one: in thick matter most flights and connections end before any other face could
come in their way, and a handful of planes costs a third of a ray.
"""

from typing import Any

import numpy as np

from prt_bake.jit.without_counts import walk_function
from prt_bake.tracer.surface.boundary import CLEARANCE, CORNERS
from prt_bake.tracer.surface.clearance import NEAR_CELLS, REACH

_MOST_FACES = 24
_MARGIN = 1e-6
"""Barycentric coordinates closer to an edge than this leave it to Embree to say which of the faces there is met."""


@walk_function()
def room_about(boundary: Any, p: Any) -> Any:
    """A distance from p, inside the object, within which there is no face; 0 where nothing is known."""
    room = clear_about(boundary, p)
    if room > 0.0 or boundary.near.shape[0] == 0:
        return room
    return _room_before_planes(boundary, p)


@walk_function()
def clear_about(boundary: Any, p: Any) -> Any:
    """The same deep inside alone, from the grid of clearances."""
    n = boundary.clearance.shape[0]
    if n == 0:
        return 0.0
    x, y, z = int((p[0] + 0.5) * n), int((p[1] + 0.5) * n), int((p[2] + 0.5) * n)
    if x < 0 or y < 0 or z < 0 or x >= n or y >= n or z >= n:
        return 0.0
    return np.float64(boundary.clearance[z, y, x])


@walk_function()
def _room_before_planes(boundary: Any, p: Any) -> Any:
    """The same near the surface: the distance to the planes of the faces that come near."""
    first, last = _faces_near(boundary, p)
    if last == first:
        return 0.0
    room = REACH / NEAR_CELLS
    for i in range(first, last):
        # In front of a plane nothing is known of the side that the place is on.
        room = min(room, max(0.0, -_height(boundary.planes[boundary.near[i]], p)))
    return room


@walk_function()
def _cell_axis(x: Any) -> Any:
    """The cell of a place on one axis; the box's own sides belong to the outermost cells."""
    return min(max(int((x + 0.5) * NEAR_CELLS), 0), NEAR_CELLS - 1)


@walk_function()
def _faces_near(boundary: Any, p: Any) -> Any:
    """First and last place in `near` of the faces close to p, equal where none are or too many."""
    x, y, z = _cell_axis(p[0]), _cell_axis(p[1]), _cell_axis(p[2])
    cell = (z * NEAR_CELLS + y) * NEAR_CELLS + x
    first, last = boundary.near[cell], boundary.near[cell + 1]
    if last - first > _MOST_FACES:
        return 0, 0
    return first, last


@walk_function()
def _height(plane: Any, p: Any) -> Any:
    """How far p lies in front of a plane."""
    return p[0] * plane[0] + p[1] * plane[1] + p[2] * plane[2] - plane[3]


@walk_function()
def _known_ahead(p: Any, d: Any) -> Any:
    """How far p + t d stays where only the faces named for the cell of p can be."""
    far = np.inf
    for k in range(3):
        low = (_cell_axis(p[k]) - REACH) / NEAR_CELLS - 0.5
        side = (1.0 + 2.0 * REACH) / NEAR_CELLS
        if d[k] > 0.0:
            far = min(far, (low + side - p[k]) / d[k])
        elif d[k] < 0.0:
            far = min(far, (low - p[k]) / d[k])
    return far


@walk_function()
def meet_nearby(boundary: Any, p: Any, d: Any, face: Any) -> Any:
    """What p + t d meets first, if that is known without a ray: (face, t, u, v, whether p is inside for certain).

    Face −1: nothing is met before t, which is 0 where nothing is known. The ray starts on `face` (−1: on none). Nested
    objects are left to Embree.
    """
    if boundary.near.shape[0] == 0 or boundary.nested:
        return -1, 0.0, 0.0, 0.0, False
    first, last = _faces_near(boundary, p)
    if last == first:
        return -1, 0.0, 0.0, 0.0, False
    begin = CLEARANCE if face >= 0 else 0.0
    far = _known_ahead(p, d)
    behind = True
    # Planes are tried by distance, those at the same one in their order.
    tried = last
    while True:
        found, chosen, t = -1, last, far
        for i in range(first, last):
            plane = boundary.planes[boundary.near[i]]
            height = _height(plane, p)
            behind = behind and (height <= 0.0 or boundary.near[i] == face)
            slope = d[0] * plane[0] + d[1] * plane[1] + d[2] * plane[2]
            # A division by zero gives a distance that is no candidate.
            there = -height / slope if slope != 0.0 else np.inf
            later = there > begin or (there == begin and i > tried)
            if later and there < t and boundary.near[i] != face:
                found, chosen, t = boundary.near[i], i, there
        if found < 0:
            return -1, far, 0.0, 0.0, behind
        row = boundary.faces[found]
        u, v = _place_in(row, p, d, t)
        least = min(u, min(v, 1.0 - u - v))
        if least > _MARGIN:
            return found, t, u, v, d[0] * row[0] + d[1] * row[1] + d[2] * row[2] > 0.0
        if not least < -_MARGIN:
            return -1, 0.0, 0.0, 0.0, False
        begin, tried = t, chosen


@walk_function()
def _place_in(row: Any, p: Any, d: Any, t: Any) -> Any:
    """Barycentric coordinates (u, v) of p + t d in the plane of a face."""
    ax, ay, az = row[CORNERS], row[CORNERS + 1], row[CORNERS + 2]
    ex, ey, ez = row[CORNERS + 3] - ax, row[CORNERS + 4] - ay, row[CORNERS + 5] - az
    fx, fy, fz = row[CORNERS + 6] - ax, row[CORNERS + 7] - ay, row[CORNERS + 8] - az
    qx, qy, qz = p[0] + t * d[0] - ax, p[1] + t * d[1] - ay, p[2] + t * d[2] - az
    ee, ef, ff = ex * ex + ey * ey + ez * ez, ex * fx + ey * fy + ez * fz, fx * fx + fy * fy + fz * fz
    eq, fq = ex * qx + ey * qy + ez * qz, fx * qx + fy * qy + fz * qz
    whole = ee * ff - ef * ef
    if whole <= 0.0:
        # A sliver without area: Embree shall say.
        return 0.0, 0.0
    return (ff * eq - ef * fq) / whole, (ee * fq - ef * eq) / whole
