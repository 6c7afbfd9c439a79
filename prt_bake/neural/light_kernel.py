"""What lies on the way to the light, compiled: what `light_ray` computes with tensors."""

from typing import Any

import numpy as np

from prt_bake.compilation import compiled

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
                    shares[n, d, s, place] = between(grid, u, v, w) if within else _ZERO


@compiled(nogil=True, error_model="numpy", fastmath={"contract", "nsz"}, inline="always")
def between(grid: Any, u: Any, v: Any, w: Any) -> Any:
    """A grid's value at (u, v, w) in spacings from its corner, short of its last places."""
    i, j, k = int(u), int(v), int(w)
    u, v, w = u - np.float32(i), v - np.float32(j), w - np.float32(k)
    low = grid[i, j, k] * (_ONE - w) + grid[i, j, k + 1] * w
    high = grid[i, j + 1, k] * (_ONE - w) + grid[i, j + 1, k + 1] * w
    near = low * (_ONE - v) + high * v
    low = grid[i + 1, j, k] * (_ONE - w) + grid[i + 1, j, k + 1] * w
    high = grid[i + 1, j + 1, k] * (_ONE - w) + grid[i + 1, j + 1, k + 1] * w
    return near * (_ONE - u) + (low * (_ONE - v) + high * v) * u
