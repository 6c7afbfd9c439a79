"""Batches of the vertices of a frame, and the coordinates of their directions to the eye between the view bins.

Computed in float64, eight vertices at a time by SIMD instructions.
"""

import math
from typing import Any, cast

import numpy as np
from numba import njit
from numpy.typing import NDArray

from prt_bake.jit.compilation import Kernel
from prt_bake.jit.vectors import eight_towards

BATCH = 256
LANE = 8
"""Vertices whose flags are read together, as one 64-bit integer."""
GEOMETRY = 10
"""Numbers per vertex: position, normal, tangent, and the cosine below which all its faces turn away from the eye."""
ALL = np.uint64(0x0101010101010101)
"""The flags of a lane whose vertices are all requested."""
SPAN = 64
"""Consecutive lanes of a thread, before those of the next thread; this balances the visible vertices."""
_EIGHTH = math.tan(math.pi / 8.0)
# No number here is infinite or NaN: inputs are checked before.
FAST: dict[str, Any] = {"error_model": "numpy", "fastmath": {"contract", "nsz", "reassoc", "arcp", "nnan", "ninf"}}


def inlined(function: Kernel) -> Kernel:
    """Compile a function that kernels call at each vertex, and inline it into them.

    Functions in the disk cache cannot be inlined.
    """
    return cast(Kernel, njit(forceinline=True, **FAST)(function))


def _arctangent(terms: int) -> tuple[float, ...]:
    """Polynomial in q² that interpolates atan(q)/q at Chebyshev points up to tan(π/8); 11 terms are exact to 1e-15."""
    most = _EIGHTH**2
    points = most * (np.cos(math.pi * (np.arange(terms) + 0.5) / terms) + 1.0) / 2.0
    values = np.arctan(np.sqrt(points)) / np.sqrt(points)
    powers = np.linalg.solve(np.vander(points / most, increasing=True), values)
    return tuple((powers / most ** np.arange(terms)).tolist())


def make_scratch(threads: int) -> tuple[NDArray[Any], ...]:
    """Working memory of the kernels for each thread: a batch, its local directions, bins and their weights."""
    weights = np.zeros((threads, 5, BATCH), np.float32)
    weights[:, 0] = 1.0
    batches, local = np.zeros((threads, BATCH), np.int64), np.zeros((threads, 3, BATCH))
    return batches, local, np.zeros((threads, 4, BATCH), np.int32), weights


_A0, _A1, _A2, _A3, _A4, _A5, _A6, _A7, _A8, _A9, _A10 = _arctangent(11)


@inlined
def _angle(y: Any, x: Any) -> Any:
    """atan2(y, x) without branches."""
    width, height = abs(x), abs(y)
    low, high = min(width, height), max(width, height)
    past = low > _EIGHTH * high
    over, under = (low - high if past else low), (low + high if past else high)
    q = over / max(under, 1e-300)
    s = q * q
    upper = _A5 + s * (_A6 + s * (_A7 + s * (_A8 + s * (_A9 + s * _A10))))
    angle = q * (_A0 + s * (_A1 + s * (_A2 + s * (_A3 + s * (_A4 + s * upper)))))
    angle = angle + 0.25 * math.pi if past else angle
    angle = 0.5 * math.pi - angle if height > width else angle
    angle = math.pi - angle if x < 0.0 else angle
    return -angle if y < 0.0 else angle


@inlined
def next_batch(lane: Any, threads: Any, scene: Any, eye: Any, cull: Any, radiance: Any, batch: Any, local: Any) -> Any:
    """Fill `batch` with requested vertices from `lane` on; returns their number and the next lane.

    With `cull` vertices whose faces all turn away are left out. Sets local [3,n]: x and y, not normalised, and cosθ of
    the direction to the eye. Vertices that are no longer shown become 0.
    """
    geometry, requested_lanes, shown_lanes, requested, shown = scene
    count = 0
    while lane < requested_lanes.shape[0] and count <= BATCH - LANE:
        if requested_lanes[lane] != 0:
            # Compute all eight in place; if some are left out, the others move up.
            eight_towards(geometry, lane, eye[0], eye[1], eye[2], local, count)
            if requested_lanes[lane] == ALL and not cull:
                shown_lanes[lane] = ALL
                for i in range(LANE):
                    batch[count + i] = LANE * lane + i
                count += LANE
            else:
                count = _compact_lane(lane, geometry[lane], requested, cull, batch, local, shown, radiance, count)
        elif shown_lanes[lane] != 0:
            for v in range(LANE * lane, LANE * lane + LANE):
                _hide(v, shown, radiance)
        lane += 1
        if lane % SPAN == 0:
            lane += SPAN * (threads - 1)
    return count, lane


@inlined
def _compact_lane(
    lane: Any, geometry: Any, requested: Any, cull: Any, batch: Any, local: Any, shown: Any, radiance: Any, count: Any
) -> Any:
    """Move the drawn vertices of a lane up to `count`; returns the new size of the batch."""
    first = count
    for i in range(LANE):
        v, cosine = LANE * lane + i, local[2, first + i]
        if requested[v] and not (cull and cosine < geometry[9, i]):
            batch[count], shown[v] = v, True
            local[0, count], local[1, count], local[2, count] = local[0, first + i], local[1, first + i], cosine
            count += 1
        else:
            _hide(v, shown, radiance)
    return count


@inlined
def _hide(v: Any, shown: Any, radiance: Any) -> None:
    if shown[v]:
        shown[v] = False
        radiance[v, 0], radiance[v, 1], radiance[v, 2] = np.float32(0.0), np.float32(0.0), np.float32(0.0)


@inlined
def bin_coordinates(local: Any, count: Any, rings: Any, sectors: Any, bins: Any, weights: Any) -> None:
    """As `sphere.bin_coordinates`: sets bins [4,n] and weights [5,n]; the last weight is that of ring 0's mean."""
    turns, last = sectors / (2.0 * math.pi), sectors - 1.0
    x, y, cosine = local[0], local[1], local[2]
    low_low, low_high, high_low, high_high = bins[0], bins[1], bins[2], bins[3]
    # Not unpacked in one statement: the check of the length would prevent vectorisation.
    w_low_low, w_low_high, w_high_low, w_high_high = weights[0], weights[1], weights[2], weights[3]
    w_pole = weights[4]
    for n in range(count):
        depth = (1.0 - min(max(cosine[n], -1.0), 1.0)) * rings - 0.5
        ring = min(max(depth, 0.0), rings - 1.0)
        ring_low = np.floor(ring)
        high = ring - ring_low
        ring_high = min(ring_low + 1.0, rings - 1.0)
        turn = _angle(y[n], x[n]) * turns - 0.5
        below = np.floor(turn)
        share = turn - below
        sector_low = below + sectors if below < 0.0 else below
        sector_high = 0.0 if sector_low >= last else sector_low + 1.0
        pole = min(max(-2.0 * depth, 0.0), 1.0)
        off_pole = 1.0 - pole
        low_low[n] = np.int32(ring_low * sectors + sector_low)
        low_high[n] = np.int32(ring_low * sectors + sector_high)
        high_low[n] = np.int32(ring_high * sectors + sector_low)
        high_high[n] = np.int32(ring_high * sectors + sector_high)
        w_low_low[n] = off_pole * (1.0 - high) * (1.0 - share)
        w_low_high[n] = off_pole * (1.0 - high) * share
        w_high_low[n] = off_pole * high * (1.0 - share)
        w_high_high[n] = off_pole * high * share
        w_pole[n] = pole
