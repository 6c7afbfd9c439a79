"""Compiled distance field of a mesh on a regular grid, up to a maximum distance."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from prt_bake.geometry.surface_grid import closest
from prt_bake.jit.compilation import compiled
from prt_bake.jit.threads import in_threads

Array = NDArray[np.float64]


def grid_distances(triangles: Array, shape: NDArray[np.int64], corner: Array, spacing: float, reach: float) -> Array:
    """Distances [X,Y,Z] from corner + spacing·(i, j, k) to the nearest of triangles [F,3,3], at most `reach`.

    Triangles without area are ignored.
    """
    relative = (triangles - corner) / spacing
    area = np.linalg.norm(np.cross(relative[:, 1] - relative[:, 0], relative[:, 2] - relative[:, 0]), axis=1)
    relative = np.ascontiguousarray(relative[area > 0.0])
    centers = relative.mean(axis=1)
    radii = np.linalg.norm(relative - centers[:, None], axis=2).max(axis=1, initial=0.0)
    distances = np.full(tuple(int(n) for n in shape), reach / spacing)
    in_threads(_lower, len(distances), relative, centers, radii, reach / spacing, distances)
    return np.asarray(spacing * distances)


@compiled(nogil=True)
def _lower(start: Any, stop: Any, triangles: Any, centers: Any, radii: Any, reach: Any, distances: Any) -> None:
    for i in range(start, stop):
        p = np.empty(3)
        p[0] = i
        first, last = np.zeros(3, np.int64), np.zeros(3, np.int64)
        for f in range(len(triangles)):
            if abs(centers[f, 0] - i) > radii[f] + reach:
                continue
            for k in range(1, 3):
                low = min(triangles[f, 0, k], min(triangles[f, 1, k], triangles[f, 2, k])) - reach
                high = max(triangles[f, 0, k], max(triangles[f, 1, k], triangles[f, 2, k])) + reach
                first[k], last[k] = max(0, int(np.ceil(low))), min(distances.shape[k] - 1, int(np.floor(high)))
            for j in range(first[1], last[1] + 1):
                p[1] = j
                for k in range(first[2], last[2] + 1):
                    p[2] = k
                    # Skip faces whose bounding sphere is no nearer than the present distance.
                    bound = distances[i, j, k] + radii[f]
                    x, y, z = p[0] - centers[f, 0], p[1] - centers[f, 1], p[2] - centers[f, 2]
                    if x * x + y * y + z * z >= bound * bound:
                        continue
                    squared, _u, _v = closest(triangles[f, 0], triangles[f, 1], triangles[f, 2], p)
                    distances[i, j, k] = min(distances[i, j, k], np.sqrt(squared))
