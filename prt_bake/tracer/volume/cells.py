"""Cells of a grid followed one by one, where majorants would fail: next to a dense voxel extinction is steep.

Between the centres of neighbouring voxels extinction is trilinear, along a ray a cubic, which two points integrate
exactly (Gauss and Legendre). A cell then costs the same however dense it is, while a majorant of a cell costs as many
tentative events as that majorant is deep: rays that pass a dense voxel by would pay for it.
"""

import math
from typing import Any

import numpy as np

from prt_bake.jit.without_counts import called_function, walk_function
from prt_bake.mathematics.counter import uniform
from prt_bake.tracer.volume.media import EXTINCTION_GRID, LOW, PER_LENGTH, extinction

_GAUSS = 0.5 / math.sqrt(3.0)
_MOST_STEPS = 60
_EXACT = 1e-11


@walk_function()
def _axis_end(p: Any, d: Any, probe: Any, low: Any, per_length: Any, count: Any) -> Any:
    """Where p + t d comes to the next voxel centre on one axis, beyond `probe`; none lie outside the outermost ones."""
    if d == 0.0:
        return np.inf
    below = math.floor((p + probe * d - low) * per_length * count - 0.5)
    centre = max(below + 1.0, 0.0) if d > 0.0 else min(below, count - 1.0)
    if centre < 0.0 or centre > count - 1.0:
        return np.inf
    return (low + (centre + 0.5) / (per_length * count) - p) / d


@walk_function()
def _cell_end(row: Any, p: Any, d: Any, t: Any) -> Any:
    """Where p + t d leaves its cell (beyond t, whatever the rounding)."""
    probe = t + 1e-7
    nz, ny, nx = row[EXTINCTION_GRID + 2], row[EXTINCTION_GRID + 3], row[EXTINCTION_GRID + 4]
    x = _axis_end(p[0], d[0], probe, row[LOW], row[PER_LENGTH], nx)
    y = _axis_end(p[1], d[1], probe, row[LOW + 1], row[PER_LENGTH + 1], ny)
    z = _axis_end(p[2], d[2], probe, row[LOW + 2], row[PER_LENGTH + 2], nz)
    return max(min(x, min(y, z)), probe)


@walk_function()
def _sigma_t(media: Any, region: Any, p: Any, d: Any, t: Any, channel: Any, at: Any) -> Any:
    for k in range(3):
        at[k] = p[k] + t * d[k]
    return extinction(media, region, at, channel)


@called_function()
def _depth(media: Any, region: Any, p: Any, d: Any, near: Any, far: Any, channel: Any, at: Any) -> Any:
    """∫ sigma_t along p + t d from `near` to `far` within a cell."""
    middle, half = 0.5 * (near + far), _GAUSS * (far - near)
    first = _sigma_t(media, region, p, d, middle - half, channel, at)
    return 0.5 * (far - near) * (first + _sigma_t(media, region, p, d, middle + half, channel, at))


@called_function()
def flight_in_cells(media: Any, region: Any, p: Any, d: Any, near: Any, far: Any, at: Any, stream: Any) -> Any:
    """Distance to the next scattering event along p + t d between `near` and `far`, infinite where none comes; all
    channels alike.
    """
    depth = -math.log(1.0 - uniform(stream))
    t = near
    while t < far:
        end = min(_cell_end(media.regions[region], p, d, t), far)
        passed = _depth(media, region, p, d, t, end, 0, at)
        if depth < passed:
            return _place_of(media, region, p, d, t, end, depth, passed, at)
        depth -= passed
        t = end
    return np.inf


@called_function()
def _place_of(media: Any, region: Any, p: Any, d: Any, near: Any, far: Any, depth: Any, passed: Any, at: Any) -> Any:
    """Where along a cell of depth `passed` the depth is `depth`: Newton's steps, else halves."""
    low, high = near, far
    t = near + (far - near) * depth / passed
    for _ in range(_MOST_STEPS):
        beyond = _depth(media, region, p, d, near, t, 0, at) - depth
        if abs(beyond) <= _EXACT * passed:
            break
        if beyond > 0.0:
            high = t
        else:
            low = t
        slope = _sigma_t(media, region, p, d, t, 0, at)
        t = t - beyond / slope if slope > 0.0 else low
        if not low < t < high:
            t = 0.5 * (low + high)
    return t


@called_function()
def attenuate_in_cells(
    media: Any, region: Any, channels: Any, p: Any, d: Any, near: Any, far: Any, at: Any, kept: Any
) -> None:
    """Multiply kept [3] by exp(−∫ sigma_t) along p + t d from `near` to `far`."""
    t = near
    while t < far and kept[0] + kept[1] + kept[2] > 0.0:
        end = min(_cell_end(media.regions[region], p, d, t), far)
        if channels == 1.0:
            factor = math.exp(-_depth(media, region, p, d, t, end, 0, at))
            for c in range(3):
                kept[c] *= factor
        else:
            for c in range(3):
                kept[c] *= math.exp(-_depth(media, region, p, d, t, end, c, at))
        t = end
