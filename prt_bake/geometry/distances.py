"""Distances from the places of a grid to the nearest face of a mesh, as far as a reach, compiled."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from prt_bake.geometry.surface_grid import closest
from prt_bake.jit.compilation import compiled
from prt_bake.jit.threads import in_threads

Array = NDArray[np.float64]


def grid_distances(triangles: Array, shape: NDArray[np.int64], corner: Array, spacing: float, reach: float) -> Array:
    """Distances [X,Y,Z] from corner + spacing·(i, j, k) to the nearest of triangles [F,3,3], `reach` where none is so
    near. Triangles of no area are left out.
    """
    relative = (triangles - corner) / spacing
    area = np.linalg.norm(np.cross(relative[:, 1] - relative[:, 0], relative[:, 2] - relative[:, 0]), axis=1)
    relative = np.ascontiguousarray(relative[area > 0.0])
    middles = relative.mean(axis=1)
    radii = np.linalg.norm(relative - middles[:, None], axis=2).max(axis=1, initial=0.0)
    distances = np.full(tuple(int(n) for n in shape), reach / spacing)
    in_threads(_lower, len(distances), relative, middles, radii, reach / spacing, distances)
    return np.asarray(spacing * distances)


@compiled(nogil=True)
def _lower(begun: Any, ended: Any, triangles: Any, middles: Any, radii: Any, reach: Any, distances: Any) -> None:
    for i in range(begun, ended):
        p = np.empty(3)
        p[0] = i
        first, last = np.zeros(3, np.int64), np.zeros(3, np.int64)
        for f in range(len(triangles)):
            if abs(middles[f, 0] - i) > radii[f] + reach:
                continue
            for k in range(1, 3):
                low = min(triangles[f, 0, k], min(triangles[f, 1, k], triangles[f, 2, k])) - reach
                high = max(triangles[f, 0, k], max(triangles[f, 1, k], triangles[f, 2, k])) + reach
                first[k], last[k] = max(0, int(np.ceil(low))), min(distances.shape[k] - 1, int(np.floor(high)))
            for j in range(first[1], last[1] + 1):
                p[1] = j
                for k in range(first[2], last[2] + 1):
                    p[2] = k
                    # No point of a face is nearer than its middle by more than its radius.
                    bound = distances[i, j, k] + radii[f]
                    x, y, z = p[0] - middles[f, 0], p[1] - middles[f, 1], p[2] - middles[f, 2]
                    if x * x + y * y + z * z >= bound * bound:
                        continue
                    squared, _u, _v = closest(triangles[f, 0], triangles[f, 1], triangles[f, 2], p)
                    distances[i, j, k] = min(distances[i, j, k], np.sqrt(squared))
