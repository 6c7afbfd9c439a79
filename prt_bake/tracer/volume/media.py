"""Media of all regions in the kernels' layout: extinction, albedo and Henyey–Greenstein phase function.

The grids of all regions are concatenated in flat arrays. Lengths are in units of the object's longest side.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from prt_bake.jit.compilation import compiled
from prt_bake.jit.kernel_functions import called_function, inlined_function


class Media(NamedTuple):
    """Media of R regions; region 0, outside, is a vacuum. Few wide tables, as in `Boundary`."""

    regions: NDArray[np.float64]
    """[R,37]; columns are named below."""
    extinction_cells: NDArray[np.float32]
    albedo_cells: NDArray[np.float32]
    blocks: NDArray[np.float64]
    """[.,2]: least and largest extinction in each block of a grid (`prt_bake.tracer.volume.majorants`)."""


MAJORANT, MINORANT, CHROMATIC, PHASE_G = 0, 1, 2, 3
"""Largest (0: vacuum) and least extinction in any channel, whether it differs between channels, mean cosine."""
SIGMA_T, ALBEDO = 4, 7
"""Three channels each; used without a grid."""
LOW, PER_LENGTH = 10, 13
"""Lower corner and 1 / side of the grids' box, along x, y and z."""
EXTINCTION_GRID, ALBEDO_GRID = 16, 21
"""First cell, channels (0: no grid), cells along z, y, x."""
CHANNELS = 1
BLOCKS = 26
"""First block, blocks along x, y, z."""
BLOCKS_LOW, BLOCKS_PER_LENGTH = 30, 33
"""Lower corner of the blocks, and blocks per unit length, along x, y and z; the outermost blocks are unbounded."""
STEEP = 36
"""Blocks with a larger extinction are tracked cell by cell."""
REGION_SIZE = 37


@inlined_function()
def _cell(position: Any, low: Any, per_length: Any, count: Any) -> Any:
    """Lower cell and interpolation weight of the upper one, on one axis of a grid of cell-centred values, clamped."""
    g = (position - low) * per_length * count - 0.5
    g = min(max(g, 0.0), count - 1.0)
    first = min(int(g), max(count - 2, 0))
    return first, g - first


@inlined_function()
def _trilinear(cells: Any, row: Any, grid: Any, p: Any, channel: Any) -> Any:
    """Trilinear value of a channel; columns from `grid` on in a region's `row` describe the grid."""
    first, channels = int(row[grid]), int(row[grid + 1])
    nz, ny, nx = int(row[grid + 2]), int(row[grid + 3]), int(row[grid + 4])
    x, fx = _cell(p[0], row[LOW], row[PER_LENGTH], nx)
    y, fy = _cell(p[1], row[LOW + 1], row[PER_LENGTH + 1], ny)
    z, fz = _cell(p[2], row[LOW + 2], row[PER_LENGTH + 2], nz)
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


@inlined_function()
def extinction(media: Any, region: Any, p: Any, channel: Any) -> Any:
    """sigma_t of a channel at p, trilinear."""
    row = media.regions[region]
    channels = row[EXTINCTION_GRID + CHANNELS]
    if channels == 0.0:
        return row[SIGMA_T + channel]
    return _trilinear(media.extinction_cells, row, EXTINCTION_GRID, p, channel if channels == 3.0 else 0)


@inlined_function()
def multiply_albedo(media: Any, region: Any, p: Any, throughput: Any) -> None:
    """Multiply the throughput [3] by the albedo at p, trilinear."""
    row = media.regions[region]
    channels = row[ALBEDO_GRID + CHANNELS]
    if channels == 0.0:
        for c in range(3):
            throughput[c] *= row[ALBEDO + c]
    else:
        _multiply_gridded_albedo(media, row, p, throughput)


@called_function()
def _multiply_gridded_albedo(media: Any, row: Any, p: Any, throughput: Any) -> None:
    if row[ALBEDO_GRID + CHANNELS] == 1.0:
        albedo = _trilinear(media.albedo_cells, row, ALBEDO_GRID, p, 0)
        for c in range(3):
            throughput[c] *= albedo
    else:
        for c in range(3):
            throughput[c] *= _trilinear(media.albedo_cells, row, ALBEDO_GRID, p, c)


@compiled()
def is_heterogeneous(media: Any) -> bool:
    """Whether the extinction of any region is a grid, which makes transmittances random."""
    return bool((media.regions[:, EXTINCTION_GRID + CHANNELS] != 0.0).any())


@inlined_function()
def phase(cosine: Any, g: Any) -> Any:
    """Henyey–Greenstein phase function per solid angle; `cosine` is between the directions of flight."""
    size = abs(g)
    apart = 1.0 - cosine if g > 0.0 else 1.0 + cosine
    root = max((1.0 - size) * (1.0 - size) + 2.0 * size * apart, 1e-200)  # 1 + g² − 2 g cosθ without cancellation
    return (1.0 - size) * (1.0 + size) / (4.0 * math.pi * root * math.sqrt(root))


@inlined_function()
def phase_cosine(g: Any, u: Any) -> Any:
    """Sample the cosine of a Henyey–Greenstein deflection by inversion, for u in [0, 1), accurate from g = 0 to |g| →
    1.

    With v = 2u − 1 the inverse of the distribution is exactly v + g(1 − v²)(3 + 2gv − g²) / 2(1 + gv)². This form has
    neither a division by g nor cancellation.
    """
    v = 2.0 * u - 1.0
    root = 1.0 + g * v
    cosine = v + 0.5 * g * (1.0 - v * v) * (3.0 + 2.0 * g * v - g * g) / (root * root)
    return min(1.0, max(-1.0, cosine))
