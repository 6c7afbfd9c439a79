"""Compiled occupancy along light rays: the CPU version of `light_ray`."""

from typing import Any

import numpy as np

from prt_bake.jit.compilation import compiled
from prt_bake.network.features.view_kernel import distance_at

_ONE, _ZERO = np.float32(1.0), np.float32(0.0)


@compiled(nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def occupancy_along(
    grid: Any,
    per_length: Any,
    corner: Any,
    origins: Any,
    incident: Any,
    distances: Any,
    samples: Any,
    occupancy: Any,
) -> None:
    """Sets occupancy [N,D,S,samples] to the grid's values at distances [P] from origins [N,S,3] along incident [N,D,3].

    The values are trilinear, and 0 outside the grid, as on its border.
    """
    nx, ny, nz = np.float32(grid.shape[0] - 1), np.float32(grid.shape[1] - 1), np.float32(grid.shape[2] - 1)
    for n in range(incident.shape[0]):
        for s in range(origins.shape[1]):
            x = (origins[n, s, 0] - corner[0]) * per_length
            y = (origins[n, s, 1] - corner[1]) * per_length
            z = (origins[n, s, 2] - corner[2]) * per_length
            for d in range(incident.shape[1]):
                for sample in samples:
                    reach = distances[sample] * per_length
                    u = x + reach * incident[n, d, 0]
                    v = y + reach * incident[n, d, 1]
                    w = z + reach * incident[n, d, 2]
                    within = u >= _ZERO and v >= _ZERO and w >= _ZERO and u < nx and v < ny and w < nz
                    occupancy[n, d, s, sample] = distance_at(grid, _ONE, u, v, w) if within else _ZERO
