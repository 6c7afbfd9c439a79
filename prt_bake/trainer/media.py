"""What fills the object: extinction, albedo and phase function, and the two ways light is followed through them.

Distances to a scattering event are drawn by delta tracking (Woodcock 1965), transmittances by ratio tracking (Novák et
al. 2014): both are unbiased for any grid. Lengths here are the walk's own (the object's longest side is about one).
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from prt_bake.trainer.compiled import walk_function
from prt_bake.trainer.counter import uniform


class Medium(NamedTuple):
    """A medium as the kernels take it: numbers where it is homogeneous, grids [Z,Y,X] and [Z,Y,X,3] where it is not."""

    sigma_t: float
    """Extinction, or the grid's largest value: the majorant."""
    phase_g: float
    albedo: NDArray[np.float64]
    extinction_grid: NDArray[np.float32]
    albedo_grid: NDArray[np.float32]
    has_extinction_grid: bool
    has_albedo_grid: bool
    low: NDArray[np.float64]
    per_length: NDArray[np.float64]
    """1 / side of the grids' box, along x, y and z."""


@walk_function(inline="always")
def _cell(position: Any, low: Any, per_length: Any, count: Any) -> Any:
    """The lower cell and the fraction beyond it on one axis of a grid with values at cell centres, clamped."""
    g = (position - low) * per_length * count - 0.5
    g = min(max(g, 0.0), count - 1.0)
    first = min(int(g), max(count - 2, 0))
    return first, g - first


@walk_function()
def extinction(medium: Any, p: Any) -> Any:
    """sigma_t at p, trilinear."""
    if not medium.has_extinction_grid:
        return medium.sigma_t
    grid = medium.extinction_grid
    nz, ny, nx = grid.shape
    x, fx = _cell(p[0], medium.low[0], medium.per_length[0], nx)
    y, fy = _cell(p[1], medium.low[1], medium.per_length[1], ny)
    z, fz = _cell(p[2], medium.low[2], medium.per_length[2], nz)
    x1, y1, z1 = min(x + 1, nx - 1), min(y + 1, ny - 1), min(z + 1, nz - 1)
    a = (grid[z, y, x] * (1.0 - fx) + grid[z, y, x1] * fx) * (1.0 - fy) + (
        grid[z, y1, x] * (1.0 - fx) + grid[z, y1, x1] * fx
    ) * fy
    b = (grid[z1, y, x] * (1.0 - fx) + grid[z1, y, x1] * fx) * (1.0 - fy) + (
        grid[z1, y1, x] * (1.0 - fx) + grid[z1, y1, x1] * fx
    ) * fy
    return a * (1.0 - fz) + b * fz


@walk_function()
def multiply_albedo(medium: Any, p: Any, throughput: Any) -> None:
    """Multiply the throughput [3] by the albedo at p, trilinear."""
    if not medium.has_albedo_grid:
        for c in range(3):
            throughput[c] *= medium.albedo[c]
        return
    grid = medium.albedo_grid
    nz, ny, nx = grid.shape[0], grid.shape[1], grid.shape[2]
    x, fx = _cell(p[0], medium.low[0], medium.per_length[0], nx)
    y, fy = _cell(p[1], medium.low[1], medium.per_length[1], ny)
    z, fz = _cell(p[2], medium.low[2], medium.per_length[2], nz)
    x1, y1, z1 = min(x + 1, nx - 1), min(y + 1, ny - 1), min(z + 1, nz - 1)
    for c in range(3):
        a = (grid[z, y, x, c] * (1.0 - fx) + grid[z, y, x1, c] * fx) * (1.0 - fy) + (
            grid[z, y1, x, c] * (1.0 - fx) + grid[z, y1, x1, c] * fx
        ) * fy
        b = (grid[z1, y, x, c] * (1.0 - fx) + grid[z1, y, x1, c] * fx) * (1.0 - fy) + (
            grid[z1, y1, x, c] * (1.0 - fx) + grid[z1, y1, x1, c] * fx
        ) * fy
        throughput[c] *= a * (1.0 - fz) + b * fz


@walk_function()
def free_flight(medium: Any, p: Any, d: Any, far: Any, at: Any, stream: Any) -> Any:
    """Distance to the next scattering event along p + t d, infinite where none comes before `far` (delta tracking).

    `at` is room for a position.
    """
    majorant = medium.sigma_t
    if majorant <= 0.0:
        return np.inf
    t = 0.0
    while True:
        t -= math.log(1.0 - uniform(stream)) / majorant
        if t >= far:
            return np.inf
        if not medium.has_extinction_grid:
            return t
        for k in range(3):
            at[k] = p[k] + t * d[k]
        if uniform(stream) * majorant < extinction(medium, at):
            return t


@walk_function()
def transmittance(medium: Any, p: Any, d: Any, near: Any, far: Any, at: Any, stream: Any) -> Any:
    """An unbiased estimate of exp(−∫ sigma_t) along p + t d from `near` to `far`; exact where sigma_t is one number."""
    majorant = medium.sigma_t
    if not medium.has_extinction_grid:
        return math.exp(-majorant * (far - near))
    if majorant <= 0.0:
        return 1.0
    kept = 1.0
    t = near
    while True:
        t -= math.log(1.0 - uniform(stream)) / majorant
        if t >= far:
            return kept
        for k in range(3):
            at[k] = p[k] + t * d[k]
        kept *= 1.0 - extinction(medium, at) / majorant
        if kept < 0.05:
            if uniform(stream) < 0.5:
                return 0.0
            kept *= 2.0


@walk_function(inline="always")
def phase(cosine: Any, g: Any) -> Any:
    """Henyey–Greenstein per solid angle; `cosine` is between the directions of flight before and after."""
    g2 = g * g
    root = max(1.0 + g2 - 2.0 * g * cosine, 1e-300)
    return (1.0 - g2) / (4.0 * math.pi * root * math.sqrt(root))


@walk_function()
def phase_cosine(g: Any, u: Any) -> Any:
    """The cosine of a Henyey–Greenstein deflection for u in [0, 1), accurate from g = 0 to |g| → 1.

    With v = 2u − 1 the inverse of the distribution is v + g(1 − v²)(3 + 2gv − g²) / 2(1 + gv)² exactly; it neither
    divides by g nor subtracts numbers that are nearly equal.
    """
    v = 2.0 * u - 1.0
    root = 1.0 + g * v
    cosine = v + 0.5 * g * (1.0 - v * v) * (3.0 + 2.0 * g * v - g * g) / (root * root)
    return min(1.0, max(-1.0, cosine))
