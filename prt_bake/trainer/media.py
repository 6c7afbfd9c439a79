"""What fills each region: extinction, albedo and phase function, as the kernels take them.

Grids of all regions lie one after the other in flat arrays; `layout` says where. Lengths are the walk's own (the
object's longest side is about one).
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from prt_bake.trainer.compiled import walk_function


class Media(NamedTuple):
    """The media of R regions; region 0 is outside, where nothing is."""

    majorant: NDArray[np.float64]
    """Largest extinction of each region in any channel; 0 where it is clear."""
    minorant: NDArray[np.float64]
    """Least extinction of each region in any channel."""
    chromatic: NDArray[np.bool_]
    """Whether extinction differs between the channels."""
    sigma_t: NDArray[np.float64]
    """[R,3]; what counts where there is no grid."""
    albedo: NDArray[np.float64]
    phase_g: NDArray[np.float64]
    extinction_cells: NDArray[np.float32]
    extinction_layout: NDArray[np.int64]
    """[R,5]: first cell, channels (0: no grid), cells along z, y, x."""
    albedo_cells: NDArray[np.float32]
    albedo_layout: NDArray[np.int64]
    low: NDArray[np.float64]
    per_length: NDArray[np.float64]
    """[R,3]: 1 / side of the grids' box, along x, y and z."""
    bounds_of_blocks: NDArray[np.float64]
    """[.,2]: least and largest extinction in each block of a grid (`prt_bake.trainer.blocks`)."""
    blocks: NDArray[np.int64]
    """[R,4]: first block, blocks along x, y, z."""


@walk_function(inline="always")
def _cell(position: Any, low: Any, per_length: Any, count: Any) -> Any:
    """The lower cell and the fraction beyond it on one axis of a grid with values at cell centres, clamped."""
    g = (position - low) * per_length * count - 0.5
    g = min(max(g, 0.0), count - 1.0)
    first = min(int(g), max(count - 2, 0))
    return first, g - first


@walk_function(inline="always")
def _trilinear(cells: Any, layout: Any, low: Any, per_length: Any, p: Any, channel: Any) -> Any:
    first, channels, nz, ny, nx = layout[0], layout[1], layout[2], layout[3], layout[4]
    x, fx = _cell(p[0], low[0], per_length[0], nx)
    y, fy = _cell(p[1], low[1], per_length[1], ny)
    z, fz = _cell(p[2], low[2], per_length[2], nz)
    across = channels if x + 1 < nx else 0
    down = channels * nx if y + 1 < ny else 0
    deep = channels * nx * ny if z + 1 < nz else 0
    i = first + channels * ((z * ny + y) * nx + x) + channel
    a = (cells[i] * (1.0 - fx) + cells[i + across] * fx) * (1.0 - fy) + (
        cells[i + down] * (1.0 - fx) + cells[i + down + across] * fx
    ) * fy
    i += deep
    b = (cells[i] * (1.0 - fx) + cells[i + across] * fx) * (1.0 - fy) + (
        cells[i + down] * (1.0 - fx) + cells[i + down + across] * fx
    ) * fy
    return a * (1.0 - fz) + b * fz


@walk_function()
def extinction(media: Any, region: Any, p: Any, channel: Any) -> Any:
    """sigma_t of a channel at p, trilinear."""
    layout = media.extinction_layout[region]
    if layout[1] == 0:
        return media.sigma_t[region, channel]
    return _trilinear(
        media.extinction_cells,
        layout,
        media.low[region],
        media.per_length[region],
        p,
        channel if layout[1] == 3 else 0,
    )


@walk_function()
def multiply_albedo(media: Any, region: Any, p: Any, throughput: Any) -> None:
    """Multiply the throughput [3] by the albedo at p, trilinear."""
    layout = media.albedo_layout[region]
    if layout[1] == 0:
        for c in range(3):
            throughput[c] *= media.albedo[region, c]
        return
    low, per_length = media.low[region], media.per_length[region]
    if layout[1] == 1:
        albedo = _trilinear(media.albedo_cells, layout, low, per_length, p, 0)
        for c in range(3):
            throughput[c] *= albedo
        return
    for c in range(3):
        throughput[c] *= _trilinear(media.albedo_cells, layout, low, per_length, p, c)


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
