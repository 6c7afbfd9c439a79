"""How light is followed through a medium: free flights and transmittances, unbiased for any grid.

Distances to a scattering event are drawn by delta tracking (Woodcock 1965), transmittances by ratio tracking (Novák et
al. 2014), both against the largest extinction of each block of the grid that the ray goes through; of a block's least
extinction the transmittance is exact. Where that would take too many tentative events, cells are followed one by one
(`prt_bake.tracer.volume.cells`). Where extinction differs between channels, events are drawn from the mean of the
channels weighted by what each still carries, which is the balance heuristic over channels (Kutz et al. 2017, "Spectral
and decomposition tracking"): the sum of the three is kept by every event but absorption, so that none of them explodes.
"""

import math
from typing import Any

import numpy as np

from prt_bake.jit.without_counts import called_function, walk_function
from prt_bake.mathematics.counter import uniform
from prt_bake.tracer.volume.cells import attenuate_in_cells, flight_in_cells
from prt_bake.tracer.volume.media import (
    BLOCKS,
    BLOCKS_LOW,
    BLOCKS_PER_LENGTH,
    CHANNELS,
    CHROMATIC,
    EXTINCTION_GRID,
    MAJORANT,
    SIGMA_T,
    STEEP,
    extinction,
)

_DARK = 0.05
"""Transmittances below this share of what they began with go on by roulette."""


@walk_function()
def _block_axis(p: Any, d: Any, probe: Any, low: Any, per_length: Any, count: Any) -> Any:
    """The block on one axis at p + probe d, and where the ray leaves it; the outermost blocks have no end."""
    if count == 1:
        return 0, np.inf
    i = int(min(max((p + probe * d - low) * per_length, 0.0), count - 1.0))
    if d > 0.0 and i < count - 1:
        return i, (low + (i + 1) / per_length - p) / d
    if d < 0.0 and i > 0:
        return i, (low + i / per_length - p) / d
    return i, np.inf


@walk_function()
def _block(media: Any, region: Any, p: Any, d: Any, t: Any) -> Any:
    """The block of the region's grid at p + t d, and where the ray leaves it (beyond t, whatever the rounding)."""
    row = media.regions[region]
    first, nx, ny, nz = int(row[BLOCKS]), int(row[BLOCKS + 1]), int(row[BLOCKS + 2]), int(row[BLOCKS + 3])
    probe = t + 1e-7
    low, per_length = row[BLOCKS_LOW : BLOCKS_LOW + 3], row[BLOCKS_PER_LENGTH : BLOCKS_PER_LENGTH + 3]
    x, tx = _block_axis(p[0], d[0], probe, low[0], per_length[0], nx)
    y, ty = _block_axis(p[1], d[1], probe, low[1], per_length[1], ny)
    z, tz = _block_axis(p[2], d[2], probe, low[2], per_length[2], nz)
    return first + (z * ny + y) * nx + x, max(min(tx, min(ty, tz)), probe)


@walk_function()
def free_flight(media: Any, region: Any, p: Any, d: Any, far: Any, at: Any, stream: Any) -> Any:
    """Distance to the next scattering event along p + t d, infinite where none comes before `far`.

    For regions whose extinction is the same in all channels. `at` is room for a position.
    """
    majorant = media.regions[region, MAJORANT]
    depth = -math.log(1.0 - uniform(stream))
    flight = np.inf
    if media.regions[region, EXTINCTION_GRID + CHANNELS] != 0.0:
        flight = _flight_in_grid(media, region, p, d, far, depth, at, stream)
    elif depth < far * majorant:
        flight = depth / majorant
    return flight


@called_function()
def _flight_in_grid(media: Any, region: Any, p: Any, d: Any, far: Any, depth: Any, at: Any, stream: Any) -> Any:
    t = 0.0
    while t < far:
        block, end = _block(media, region, p, d, t)
        highest = media.blocks[block, 1]
        if highest > media.regions[region, STEEP]:
            # What is left of `depth` is exponential again, whatever happens here.
            found = flight_in_cells(media, region, p, d, t, min(end, far), at, stream)
            if found < np.inf:
                return found
            t = end
            continue
        step = depth / highest if highest > 0.0 else np.inf
        if t + step >= end:
            depth -= (end - t) * highest
            t = end
            continue
        t += step
        if t >= far:
            break
        for k in range(3):
            at[k] = p[k] + t * d[k]
        if uniform(stream) * highest < extinction(media, region, at, 0):
            return t
        depth = -math.log(1.0 - uniform(stream))
    return np.inf


@called_function()
def flight_by_channel(media: Any, region: Any, p: Any, d: Any, far: Any, throughput: Any, at: Any, stream: Any) -> Any:
    """Distance to the next scattering event before `far`, else infinite, with the throughput [3] weighted for either.

    For regions whose extinction differs between channels.
    """
    if media.regions[region, EXTINCTION_GRID + CHANNELS] == 0.0:
        return _homogeneous_by_channel(media.regions[region, SIGMA_T : SIGMA_T + 3], far, throughput, stream)
    depth = -math.log(1.0 - uniform(stream))
    t = 0.0
    while t < far:
        block, end = _block(media, region, p, d, t)
        highest = media.blocks[block, 1]
        step = depth / highest if highest > 0.0 else np.inf
        if t + step >= end:
            depth -= (end - t) * highest
            t = end
            continue
        t += step
        if t >= far:
            break
        for k in range(3):
            at[k] = p[k] + t * d[k]
        depth = -math.log(1.0 - uniform(stream))
        if _collides(media, region, at, highest, throughput, uniform(stream)):
            return t
    return np.inf


@walk_function()
def _collides(media: Any, region: Any, at: Any, highest: Any, throughput: Any, u: Any) -> bool:
    """Whether a tentative event is a real one, with the throughput weighted accordingly."""
    real, total = 0.0, 0.0
    for c in range(3):
        real += throughput[c] * extinction(media, region, at, c)
        total += throughput[c] * highest
    if total <= 0.0:
        return True
    if u * total < real:
        for c in range(3):
            throughput[c] *= extinction(media, region, at, c) * total / (highest * real)
        return True
    for c in range(3):
        throughput[c] *= max(0.0, highest - extinction(media, region, at, c)) * total / (highest * (total - real))
    return False


@called_function()
def _homogeneous_by_channel(sigma_t: Any, far: Any, throughput: Any, stream: Any) -> Any:
    total = throughput[0] + throughput[1] + throughput[2]
    if total <= 0.0:
        return np.inf
    chosen = uniform(stream) * total
    c = 0 if chosen < throughput[0] else (1 if chosen < throughput[0] + throughput[1] else 2)
    t = np.inf
    if sigma_t[c] > 0.0:
        t = -math.log(1.0 - uniform(stream)) / sigma_t[c]
    # Depths beyond the least one cancel between the channels, so that nothing underflows in thick media.
    least = min(sigma_t[0], min(sigma_t[1], sigma_t[2]))
    reached = min(t, far)
    mean = 0.0
    for k in range(3):
        kept = math.exp(-(sigma_t[k] - least) * reached)
        throughput[k] *= kept * (sigma_t[k] if t < far else 1.0)
        mean += throughput[k] / total
    for k in range(3):
        throughput[k] /= mean
    return t if t < far else np.inf


@walk_function()
def attenuate(media: Any, region: Any, p: Any, d: Any, near: Any, far: Any, at: Any, stream: Any, kept: Any) -> None:
    """Multiply kept [3] by an unbiased estimate of exp(−∫ sigma_t) along p + t d from `near` to `far`.

    It is exact where sigma_t is one number, and in blocks of a grid where it is.
    """
    row = media.regions[region]
    if row[MAJORANT] > 0.0 and far > near:
        if row[EXTINCTION_GRID + CHANNELS] != 0.0:
            _attenuate_in_grid(media, region, p, d, near, far, at, stream, kept)
        elif row[CHROMATIC] == 0.0:
            factor = math.exp(-row[MAJORANT] * (far - near))
            for c in range(3):
                kept[c] *= factor
        else:
            for c in range(3):
                kept[c] *= math.exp(-row[SIGMA_T + c] * (far - near))


@called_function()
def _attenuate_in_grid(
    media: Any, region: Any, p: Any, d: Any, near: Any, far: Any, at: Any, stream: Any, kept: Any
) -> None:
    channels = media.regions[region, EXTINCTION_GRID + CHANNELS]
    watched = _DARK * max(kept[0], max(kept[1], kept[2]))
    depth = -math.log(1.0 - uniform(stream))
    t, certain = near, 0.0
    while t < far:
        block, end = _block(media, region, p, d, t)
        lowest, highest = media.blocks[block, 0], media.blocks[block, 1]
        end = min(end, far)
        rest = highest - lowest
        if rest > media.regions[region, STEEP]:
            attenuate_in_cells(media, region, channels, p, d, t, end, at, kept)
            t = end
            if not _worth_following(kept, certain, watched, stream):
                return
            continue
        step = depth / rest if rest > 0.0 else np.inf
        met = t + step < end
        reached = t + step if met else end
        certain += (reached - t) * lowest
        if not met:
            depth -= (end - t) * rest
            t = end
            continue
        t = reached
        for k in range(3):
            at[k] = p[k] + t * d[k]
        if channels == 1.0:
            factor = 1.0 - (extinction(media, region, at, 0) - lowest) / rest
            for c in range(3):
                kept[c] *= factor
        else:
            for c in range(3):
                kept[c] *= 1.0 - (extinction(media, region, at, c) - lowest) / rest
        if not _worth_following(kept, certain, watched, stream):
            return
        depth = -math.log(1.0 - uniform(stream))
    for c in range(3):
        kept[c] *= math.exp(-certain)


@walk_function()
def _worth_following(kept: Any, certain: Any, watched: Any, stream: Any) -> bool:
    """Roulette on what is nearly dark: False, with kept set to 0, or kept doubled."""
    if max(kept[0], max(kept[1], kept[2])) * math.exp(-certain) >= watched:
        return True
    alive = bool(uniform(stream) < 0.5)
    for c in range(3):
        kept[c] *= 2.0 if alive else 0.0
    return alive
