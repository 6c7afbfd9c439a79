"""Exact tracking cell by cell, for blocks of a grid whose majorant would be costly.

Between voxel centres extinction is trilinear, so along a ray it is a cubic, which two Gauss–Legendre points integrate
exactly. A cell costs the same at any density. Delta tracking costs as many tentative collisions as the majorant's
optical depth, also for rays that only pass near a dense voxel.
"""

import math
from typing import Any

import numpy as np

from prt_bake.jit.kernel_functions import called_function, inlined_function
from prt_bake.mathematics.counter import uniform
from prt_bake.tracer.volume.media import EXTINCTION_GRID, LOW, PER_LENGTH, extinction

_GAUSS = 0.5 / math.sqrt(3.0)
_MOST_STEPS = 60
_EXACT = 1e-11


@inlined_function()
def _axis_end(p: Any, d: Any, probe: Any, low: Any, per_length: Any, count: Any) -> Any:
    """Distance beyond `probe` at which p + t d reaches the next voxel centre on one axis; inf beyond the outermost
    ones.
    """
    if d == 0.0:
        return np.inf
    below = math.floor((p + probe * d - low) * per_length * count - 0.5)
    centre = max(below + 1.0, 0.0) if d > 0.0 else min(below, count - 1.0)
    if centre < 0.0 or centre > count - 1.0:
        return np.inf
    return (low + (centre + 0.5) / (per_length * count) - p) / d


@inlined_function()
def _cell_end(row: Any, p: Any, d: Any, t: Any) -> Any:
    """Distance at which p + t d leaves its cell; always greater than t."""
    probe = t + 1e-7
    nz, ny, nx = row[EXTINCTION_GRID + 2], row[EXTINCTION_GRID + 3], row[EXTINCTION_GRID + 4]
    x = _axis_end(p[0], d[0], probe, row[LOW], row[PER_LENGTH], nx)
    y = _axis_end(p[1], d[1], probe, row[LOW + 1], row[PER_LENGTH + 1], ny)
    z = _axis_end(p[2], d[2], probe, row[LOW + 2], row[PER_LENGTH + 2], nz)
    return max(min(x, min(y, z)), probe)


@inlined_function()
def _sigma_t(media: Any, region: Any, p: Any, d: Any, t: Any, channel: Any, point: Any) -> Any:
    for k in range(3):
        point[k] = p[k] + t * d[k]
    return extinction(media, region, point, channel)


@called_function()
def _depth(media: Any, region: Any, p: Any, d: Any, near: Any, far: Any, channel: Any, point: Any) -> Any:
    """Optical depth ∫ sigma_t along p + t d from `near` to `far` within a cell."""
    middle, half = 0.5 * (near + far), _GAUSS * (far - near)
    first = _sigma_t(media, region, p, d, middle - half, channel, point)
    return 0.5 * (far - near) * (first + _sigma_t(media, region, p, d, middle + half, channel, point))


@called_function()
def flight_in_cells(media: Any, region: Any, p: Any, d: Any, near: Any, far: Any, point: Any, stream: Any) -> Any:
    """Distance to the next scattering event along p + t d between `near` and `far`, else inf; for grey extinction."""
    depth = -math.log(1.0 - uniform(stream))
    t = near
    while t < far:
        end = min(_cell_end(media.regions[region], p, d, t), far)
        cell_depth = _depth(media, region, p, d, t, end, 0, point)
        if depth < cell_depth:
            return _invert_depth(media, region, p, d, t, end, depth, cell_depth, point)
        depth -= cell_depth
        t = end
    return np.inf


@called_function()
def _invert_depth(
    media: Any, region: Any, p: Any, d: Any, near: Any, far: Any, depth: Any, cell_depth: Any, point: Any
) -> Any:
    """Distance at which the optical depth in a cell reaches `depth`: Newton's method with bisection."""
    low, high = near, far
    t = near + (far - near) * depth / cell_depth
    for _ in range(_MOST_STEPS):
        excess = _depth(media, region, p, d, near, t, 0, point) - depth
        if abs(excess) <= _EXACT * cell_depth:
            break
        if excess > 0.0:
            high = t
        else:
            low = t
        slope = _sigma_t(media, region, p, d, t, 0, point)
        t = t - excess / slope if slope > 0.0 else low
        if not low < t < high:
            t = 0.5 * (low + high)
    return t


@called_function()
def attenuate_in_cells(
    media: Any, region: Any, channels: Any, p: Any, d: Any, near: Any, far: Any, point: Any, transmittance: Any
) -> None:
    """Multiply transmittance [3] by exp(−∫ sigma_t) along p + t d from `near` to `far`."""
    t = near
    while t < far and transmittance[0] + transmittance[1] + transmittance[2] > 0.0:
        end = min(_cell_end(media.regions[region], p, d, t), far)
        if channels == 1.0:
            factor = math.exp(-_depth(media, region, p, d, t, end, 0, point))
            for c in range(3):
                transmittance[c] *= factor
        else:
            for c in range(3):
                transmittance[c] *= math.exp(-_depth(media, region, p, d, t, end, c, point))
        t = end
