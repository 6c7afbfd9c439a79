"""Unbiased free-flight sampling and transmittance estimation in homogeneous and gridded media.

Free flights use delta tracking (Woodcock 1965), transmittances residual ratio tracking (Novák et al. 2014). Both use
the majorant of each block that the ray crosses; the block's least extinction is the control, whose transmittance is
exact. Blocks that would need too many tentative collisions are tracked cell by cell (`prt_bake.tracer.volume.cells`),
except by flights in extinction that differs between channels.

If extinction differs between channels, collisions are sampled from the mean of the channels weighted by their
throughputs, which is the balance heuristic over channels (Kutz et al. 2017, "Spectral and decomposition tracking").
Every event except absorption conserves the sum of the three throughputs, so that none of them explodes.
"""

import math
from typing import Any

import numpy as np

from prt_bake.jit.kernel_functions import called_function, inlined_function
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

_ROULETTE_BELOW = 0.05
"""Transmittances that have fallen below this share of the initial value play Russian roulette."""


@inlined_function()
def _block_axis(p: Any, d: Any, probe: Any, low: Any, per_length: Any, count: Any) -> Any:
    """Block index on one axis at p + probe d, and distance at which the ray leaves it; outermost blocks are
    unbounded.
    """
    if count == 1:
        return 0, np.inf
    i = int(min(max((p + probe * d - low) * per_length, 0.0), count - 1.0))
    if d > 0.0 and i < count - 1:
        return i, (low + (i + 1) / per_length - p) / d
    if d < 0.0 and i > 0:
        return i, (low + i / per_length - p) / d
    return i, np.inf


@inlined_function()
def _block(media: Any, region: Any, p: Any, d: Any, t: Any) -> Any:
    """Block of the region's grid at p + t d, and distance at which the ray leaves it; always greater than t."""
    row = media.regions[region]
    first, nx, ny, nz = int(row[BLOCKS]), int(row[BLOCKS + 1]), int(row[BLOCKS + 2]), int(row[BLOCKS + 3])
    probe = t + 1e-7
    low, per_length = row[BLOCKS_LOW : BLOCKS_LOW + 3], row[BLOCKS_PER_LENGTH : BLOCKS_PER_LENGTH + 3]
    x, tx = _block_axis(p[0], d[0], probe, low[0], per_length[0], nx)
    y, ty = _block_axis(p[1], d[1], probe, low[1], per_length[1], ny)
    z, tz = _block_axis(p[2], d[2], probe, low[2], per_length[2], nz)
    return first + (z * ny + y) * nx + x, max(min(tx, min(ty, tz)), probe)


@inlined_function()
def free_flight(media: Any, region: Any, p: Any, d: Any, far: Any, point: Any, stream: Any) -> Any:
    """Distance to the next scattering event along p + t d, inf if there is none before `far`.

    For grey extinction. `point` is scratch space [3].
    """
    majorant = media.regions[region, MAJORANT]
    depth = -math.log(1.0 - uniform(stream))
    flight = np.inf
    if media.regions[region, EXTINCTION_GRID + CHANNELS] != 0.0:
        flight = _flight_in_grid(media, region, p, d, far, depth, point, stream)
    elif depth < far * majorant:
        flight = depth / majorant
    return flight


@called_function()
def _flight_in_grid(media: Any, region: Any, p: Any, d: Any, far: Any, depth: Any, point: Any, stream: Any) -> Any:
    t = 0.0
    while t < far:
        block, end = _block(media, region, p, d, t)
        majorant = media.blocks[block, 1]
        if majorant > media.regions[region, STEEP]:
            # By memorylessness the remaining `depth` stays exponential, whatever happens here.
            found = flight_in_cells(media, region, p, d, t, min(end, far), point, stream)
            if found < np.inf:
                return found
            t = end
            continue
        step = depth / majorant if majorant > 0.0 else np.inf
        if t + step >= end:
            depth -= (end - t) * majorant
            t = end
            continue
        t += step
        if t >= far:
            break
        for k in range(3):
            point[k] = p[k] + t * d[k]
        if uniform(stream) * majorant < extinction(media, region, point, 0):
            return t
        depth = -math.log(1.0 - uniform(stream))
    return np.inf


@called_function()
def flight_by_channel(
    media: Any, region: Any, p: Any, d: Any, far: Any, throughput: Any, point: Any, stream: Any
) -> Any:
    """Distance to the next scattering event before `far`, else inf; weights the throughput [3] in both cases.

    For extinction that differs between channels.
    """
    if media.regions[region, EXTINCTION_GRID + CHANNELS] == 0.0:
        return _homogeneous_by_channel(media.regions[region, SIGMA_T : SIGMA_T + 3], far, throughput, stream)
    depth = -math.log(1.0 - uniform(stream))
    t = 0.0
    while t < far:
        block, end = _block(media, region, p, d, t)
        majorant = media.blocks[block, 1]
        step = depth / majorant if majorant > 0.0 else np.inf
        if t + step >= end:
            depth -= (end - t) * majorant
            t = end
            continue
        t += step
        if t >= far:
            break
        for k in range(3):
            point[k] = p[k] + t * d[k]
        depth = -math.log(1.0 - uniform(stream))
        if _collides(media, region, point, majorant, throughput, uniform(stream)):
            return t
    return np.inf


@inlined_function()
def _collides(media: Any, region: Any, point: Any, majorant: Any, throughput: Any, u: Any) -> bool:
    """Whether a tentative collision is real; weights the throughput accordingly."""
    real, total = 0.0, 0.0
    for c in range(3):
        real += throughput[c] * extinction(media, region, point, c)
        total += throughput[c] * majorant
    if total <= 0.0:
        return True
    if u * total < real:
        for c in range(3):
            throughput[c] *= extinction(media, region, point, c) * total / (majorant * real)
        return True
    for c in range(3):
        throughput[c] *= max(0.0, majorant - extinction(media, region, point, c)) * total / (majorant * (total - real))
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
    # The least extinction cancels between the channels; leaving it out avoids underflow in thick media.
    least = min(sigma_t[0], min(sigma_t[1], sigma_t[2]))
    reached = min(t, far)
    mean = 0.0
    for k in range(3):
        transmittance = math.exp(-(sigma_t[k] - least) * reached)
        throughput[k] *= transmittance * (sigma_t[k] if t < far else 1.0)
        mean += throughput[k] / total
    for k in range(3):
        throughput[k] /= mean
    return t if t < far else np.inf


@inlined_function()
def attenuate(
    media: Any, region: Any, p: Any, d: Any, near: Any, far: Any, point: Any, stream: Any, transmittance: Any
) -> None:
    """Multiply transmittance [3] by an unbiased estimate of exp(−∫ sigma_t) along p + t d from `near` to `far`.

    The estimate is exact for homogeneous media and in blocks of constant extinction.
    """
    row = media.regions[region]
    if row[MAJORANT] > 0.0 and far > near:
        if row[EXTINCTION_GRID + CHANNELS] != 0.0:
            _attenuate_in_grid(media, region, p, d, near, far, point, stream, transmittance)
        elif row[CHROMATIC] == 0.0:
            factor = math.exp(-row[MAJORANT] * (far - near))
            for c in range(3):
                transmittance[c] *= factor
        else:
            for c in range(3):
                transmittance[c] *= math.exp(-row[SIGMA_T + c] * (far - near))


@called_function()
def _attenuate_in_grid(
    media: Any, region: Any, p: Any, d: Any, near: Any, far: Any, point: Any, stream: Any, transmittance: Any
) -> None:
    channels = media.regions[region, EXTINCTION_GRID + CHANNELS]
    threshold = _ROULETTE_BELOW * max(transmittance[0], max(transmittance[1], transmittance[2]))
    depth = -math.log(1.0 - uniform(stream))
    t, control_depth = near, 0.0
    while t < far:
        block, end = _block(media, region, p, d, t)
        minorant, majorant = media.blocks[block, 0], media.blocks[block, 1]
        end = min(end, far)
        residual = majorant - minorant
        if residual > media.regions[region, STEEP]:
            attenuate_in_cells(media, region, channels, p, d, t, end, point, transmittance)
            t = end
            if not _roulette(transmittance, control_depth, threshold, stream):
                return
            continue
        step = depth / residual if residual > 0.0 else np.inf
        collides = t + step < end
        reached = t + step if collides else end
        control_depth += (reached - t) * minorant
        if not collides:
            depth -= (end - t) * residual
            t = end
            continue
        t = reached
        for k in range(3):
            point[k] = p[k] + t * d[k]
        if channels == 1.0:
            factor = 1.0 - (extinction(media, region, point, 0) - minorant) / residual
            for c in range(3):
                transmittance[c] *= factor
        else:
            for c in range(3):
                transmittance[c] *= 1.0 - (extinction(media, region, point, c) - minorant) / residual
        if not _roulette(transmittance, control_depth, threshold, stream):
            return
        depth = -math.log(1.0 - uniform(stream))
    for c in range(3):
        transmittance[c] *= math.exp(-control_depth)


@inlined_function()
def _roulette(transmittance: Any, control_depth: Any, threshold: Any, stream: Any) -> bool:
    """Russian roulette on a small transmittance: doubled, or set to 0 and False."""
    if max(transmittance[0], max(transmittance[1], transmittance[2])) * math.exp(-control_depth) >= threshold:
        return True
    alive = bool(uniform(stream) < 0.5)
    for c in range(3):
        transmittance[c] *= 2.0 if alive else 0.0
    return alive
