"""Frames from an eye that stays, compiled: what is stored is interpolated between the view bins once, and read in order
under one light after the other. Arguments are those of `frame_kernels`.
"""

from typing import Any

import numpy as np
from numba import prange

from prt_bake.jit.compilation import compiled
from prt_bake.jit.vectors import (
    lit_row_by_1,
    lit_row_by_4,
    lit_row_by_16,
    sum_rows_by_1,
    sum_rows_by_4,
    sum_rows_by_16,
)
from prt_bake.shading.frames.batches import FAST, SPAN, part
from prt_bake.shading.frames.kernels import interpolate, look, show

_AT_ONCE = 1024
"""Vertices that a thread takes before the next one's turn."""


@part
def _sum(rows: Any, size: Any, a: Any, b: Any, c: Any, d: Any, weights: Any, held: Any, place: Any) -> None:
    of_a, of_b, of_c, of_d = weights
    if size >= 16:
        sum_rows_by_16(rows, size, a * size, b * size, c * size, d * size, of_a, of_b, of_c, of_d, held, place)
    elif size >= 4:
        sum_rows_by_4(rows, size, a * size, b * size, c * size, d * size, of_a, of_b, of_c, of_d, held, place)
    else:
        sum_rows_by_1(rows, size, a * size, b * size, c * size, d * size, of_a, of_b, of_c, of_d, held, place)


@part
def _lit(held: Any, size: Any, v: Any, light: Any) -> Any:
    if size >= 16:
        return lit_row_by_16(held, size, v * size, light)
    if size >= 4:
        return lit_row_by_4(held, size, v * size, light)
    return lit_row_by_1(held, size, v * size, light)


@compiled(parallel=True, **FAST)
def hold_rows(
    stored: Any,
    size: Any,
    scene: Any,
    eye: Any,
    cull: Any,
    grid: Any,
    desks: Any,
    radiance: Any,
    held: Any,
    threads: Any,
) -> None:
    """Set held, flat, `size` numbers a vertex: what is stored where the eye looks, of the vertices shown."""
    rows, poles = stored
    per_vertex, lanes = grid[0] * grid[1], scene[1].shape[0]
    for t in prange(threads):
        lane = SPAN * t
        while lane < lanes:
            count, lane = look(t, lane, threads, scene, eye, cull, grid, desks, radiance)
            batch, bins, weights = desks[0][t], desks[2][t], desks[3][t]
            for n in range(count):
                v = batch[n]
                first, place = v * per_vertex, v * size
                shares = (weights[0, n], weights[1, n], weights[2, n], weights[3, n])
                a, b, c, d = first + bins[0, n], first + bins[1, n], first + bins[2, n], first + bins[3, n]
                _sum(rows, size, a, b, c, d, shares, held, place)
                for k in range(size if weights[4, n] > 0.0 else 0):
                    held[place + k] += weights[4, n] * poles[place + k]


@compiled(parallel=True, **FAST)
def hold_compact(
    codes: Any,
    scene: Any,
    eye: Any,
    cull: Any,
    grid: Any,
    desks: Any,
    views: Any,
    radiance: Any,
    held: Any,
    threads: Any,
) -> None:
    """The same of compact coefficients: functions of harmonics and channels where the eye looks."""
    table, poles, dense, size, runs, which, channel, values = codes
    lanes = scene[1].shape[0]
    for t in prange(threads):
        lane = SPAN * t
        while lane < lanes:
            count, lane = look(t, lane, threads, scene, eye, cull, grid, desks, radiance)
            batch, bins, weights, view = desks[0][t], desks[2][t], desks[3][t], views[t]
            for n in range(count):
                v = batch[n]
                interpolate(table, bins, weights, poles, n, view)
                row, each = held[v * size : (v + 1) * size], dense[v]
                row[:] = 0.0
                for r in range(each.shape[0] // size):
                    share, function = view[r], each[r * size : (r + 1) * size]
                    for j in range(size):
                        row[j] += share * function[j]
                for i in range(runs[v], runs[v + 1]):
                    row[channel[i]] += values[i] * view[which[i]]


@compiled(parallel=True, **FAST)
def draw_held(held: Any, size: Any, light: Any, shown: Any, radiance: Any, sums: Any) -> None:
    """Radiance of the shown vertices, 0 elsewhere."""
    threads, vertices, none = sums.shape[0], radiance.shape[0], np.float32(0.0)
    for t in prange(threads):
        kept, cut = 0.0, 0.0
        for begin in range(_AT_ONCE * t, vertices, _AT_ONCE * threads):
            for v in range(begin, min(begin + _AT_ONCE, vertices)):
                if shown[v]:
                    red, green, blue = _lit(held, size, v, light)
                    more, whole = show(radiance, v, red, green, blue)
                    kept += more
                    cut += more - whole
                else:
                    radiance[v, 0], radiance[v, 1], radiance[v, 2] = none, none, none
        sums[t, 0] += cut
        sums[t, 1] += kept
