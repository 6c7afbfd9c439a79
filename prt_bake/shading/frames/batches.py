"""Which vertices a frame asks for, and where the direction of each to the eye lies between the view bins: a batch at a
time, in float64, eight vertices to an instruction where the processor can.
"""

import math
from typing import Any, cast

import numpy as np
from numba import njit

from prt_bake.jit.compilation import Kernel
from prt_bake.jit.vectors import eight_towards

BATCH = 256
LANE = 8
"""Vertices whose marks are looked at together, as one whole number of 64 bits."""
GEOMETRY = 10
"""Numbers kept of a vertex: position, normal, tangent, and the cosine below which every face turns away."""
ALL = np.uint64(0x0101010101010101)
"""The marks of eight vertices that are all asked for."""
SPAN = 64
"""Lanes that a thread takes before the next one's turn: what is seen of an object is shared out evenly."""
_EIGHTH = math.tan(math.pi / 8.0)
# No number here is infinite or NaN: what comes in has been looked at.
FAST: dict[str, Any] = {"error_model": "numpy", "fastmath": {"contract", "nsz", "reassoc", "arcp", "nnan", "ninf"}}


def part(function: Kernel) -> Kernel:
    """For what kernels call at each vertex, where a call takes as long as the work: built into each of them. What is
    kept on disk by itself could only be called.
    """
    return cast(Kernel, njit(forceinline=True, **FAST)(function))


def _arctangent(terms: int) -> tuple[float, ...]:
    """Polynomial in q² that is atan(q)/q up to tan(π/8), at Chebyshev's points of it; 11 terms: to 1e-15."""
    most = _EIGHTH**2
    points = most * (np.cos(math.pi * (np.arange(terms) + 0.5) / terms) + 1.0) / 2.0
    values = np.arctan(np.sqrt(points)) / np.sqrt(points)
    powers = np.linalg.solve(np.vander(points / most, increasing=True), values)
    return tuple((powers / most ** np.arange(terms)).tolist())


_A0, _A1, _A2, _A3, _A4, _A5, _A6, _A7, _A8, _A9, _A10 = _arctangent(11)


@part
def _angle(y: Any, x: Any) -> Any:
    """atan2(y, x) without a branch."""
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


@part
def next_batch(lane: Any, threads: Any, scene: Any, eye: Any, cull: Any, radiance: Any, batch: Any, local: Any) -> Any:
    """Fill `batch` with vertices that are asked for, from `lane` on, with `cull` those that turn a face to the eye; how
    many, and the lane after. local [3,n]: x and y of any length, and cosθ, of the direction to the eye. What was shown
    last and is no longer becomes 0.
    """
    geometry, asked_lanes, shown_lanes, asked, shown = scene
    count = 0
    while lane < asked_lanes.shape[0] and count <= BATCH - LANE:
        if asked_lanes[lane] != 0:
            # All eight, where they will stand if all are drawn; then those that are move up.
            eight_towards(geometry, lane, eye[0], eye[1], eye[2], local, count)
            if asked_lanes[lane] == ALL and not cull:
                shown_lanes[lane] = ALL
                for i in range(LANE):
                    batch[count + i] = LANE * lane + i
                count += LANE
            else:
                count = _keep(lane, geometry[lane], asked, cull, batch, local, shown, radiance, count)
        elif shown_lanes[lane] != 0:
            for v in range(LANE * lane, LANE * lane + LANE):
                _hide(v, shown, radiance)
        lane += 1
        if lane % SPAN == 0:
            lane += SPAN * (threads - 1)
    return count, lane


@part
def _keep(
    lane: Any, geometry: Any, asked: Any, cull: Any, batch: Any, local: Any, shown: Any, radiance: Any, count: Any
) -> Any:
    """Move what is drawn of a lane up to `count`; how many the batch holds then."""
    first = count
    for i in range(LANE):
        v, cosine = LANE * lane + i, local[2, first + i]
        if asked[v] and not (cull and cosine < geometry[9, i]):
            batch[count], shown[v] = v, True
            local[0, count], local[1, count], local[2, count] = local[0, first + i], local[1, first + i], cosine
            count += 1
        else:
            _hide(v, shown, radiance)
    return count


@part
def _hide(v: Any, shown: Any, radiance: Any) -> None:
    if shown[v]:
        shown[v] = False
        radiance[v, 0], radiance[v, 1], radiance[v, 2] = np.float32(0.0), np.float32(0.0), np.float32(0.0)


@part
def between(local: Any, count: Any, rings: Any, sectors: Any, bins: Any, weights: Any) -> None:
    """`sphere.bin_coordinates`: bins [4,n] and weights [5,n], the last that of the mean of ring 0."""
    turns, last = sectors / (2.0 * math.pi), sectors - 1.0
    x, y, cosine = local[0], local[1], local[2]
    low_low, low_high, high_low, high_high = bins[0], bins[1], bins[2], bins[3]
    # Not unpacked at once: the check of the length would keep the loop from being vectorised.
    of_low_low, of_low_high, of_high_low, of_high_high = weights[0], weights[1], weights[2], weights[3]
    of_pole = weights[4]
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
        of_low_low[n] = off_pole * (1.0 - high) * (1.0 - share)
        of_low_high[n] = off_pole * (1.0 - high) * share
        of_high_low[n] = off_pole * high * (1.0 - share)
        of_high_high[n] = off_pole * high * share
        of_pole[n] = pole
