"""What lies on the way to the light, compiled: what `light_ray` computes with tensors."""

from typing import Any

import numpy as np

from prt_bake.jit.compilation import compiled
from prt_bake.network.features.view_kernel import distance_at

_ONE, _ZERO = np.float32(1.0), np.float32(0.0)


@compiled(nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def shares_along(
    grid: Any, per_length: Any, corner: Any, starts: Any, incident: Any, distances: Any, places: Any, shares: Any
) -> None:
    """Set shares [N,D,S,places] to a grid's values at `distances` [P] from starts [N,S,3] along incident [N,D,3].

    Linear between the grid's places; outside of it 0, as on its border.
    """
    nx, ny, nz = np.float32(grid.shape[0] - 1), np.float32(grid.shape[1] - 1), np.float32(grid.shape[2] - 1)
    for n in range(incident.shape[0]):
        for s in range(starts.shape[1]):
            x = (starts[n, s, 0] - corner[0]) * per_length
            y = (starts[n, s, 1] - corner[1]) * per_length
            z = (starts[n, s, 2] - corner[2]) * per_length
            for d in range(incident.shape[1]):
                for place in places:
                    reach = distances[place] * per_length
                    u = x + reach * incident[n, d, 0]
                    v = y + reach * incident[n, d, 1]
                    w = z + reach * incident[n, d, 2]
                    within = u >= _ZERO and v >= _ZERO and w >= _ZERO and u < nx and v < ny and w < nz
                    shares[n, d, s, place] = distance_at(grid, _ONE, u, v, w) if within else _ZERO
