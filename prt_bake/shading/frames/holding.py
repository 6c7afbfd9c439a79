"""Kernels of frames from a fixed eye: coefficients are interpolated between the view bins once, for any light.

Arguments are those of `kernels`.
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
from prt_bake.shading.frames.batches import FAST, SPAN, inlined
from prt_bake.shading.frames.kernels import interpolate, next_views, store_clamped

_AT_ONCE = 1024
"""Consecutive vertices of a thread, before those of the next thread."""


@inlined
def _blend_rows(rows: Any, size: Any, a: Any, b: Any, c: Any, d: Any, weights: Any, held: Any, place: Any) -> None:
    w_a, w_b, w_c, w_d = weights
    if size >= 16:
        sum_rows_by_16(rows, size, a * size, b * size, c * size, d * size, w_a, w_b, w_c, w_d, held, place)
    elif size >= 4:
        sum_rows_by_4(rows, size, a * size, b * size, c * size, d * size, w_a, w_b, w_c, w_d, held, place)
    else:
        sum_rows_by_1(rows, size, a * size, b * size, c * size, d * size, w_a, w_b, w_c, w_d, held, place)


@inlined
def _dot(held: Any, size: Any, v: Any, light: Any) -> Any:
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
    scratch: Any,
    radiance: Any,
    held: Any,
    threads: Any,
) -> None:
    """Set held, flat, `size` numbers per vertex: interpolated coefficients of the shown vertices."""
    rows, poles = stored
    per_vertex, lanes = grid[0] * grid[1], scene[1].shape[0]
    for t in prange(threads):
        lane = SPAN * t
        while lane < lanes:
            count, lane = next_views(t, lane, threads, scene, eye, cull, grid, scratch, radiance)
            batch, bins, weights = scratch[0][t], scratch[2][t], scratch[3][t]
            for n in range(count):
                v = batch[n]
                first, place = v * per_vertex, v * size
                shares = (weights[0, n], weights[1, n], weights[2, n], weights[3, n])
                a, b, c, d = first + bins[0, n], first + bins[1, n], first + bins[2, n], first + bins[3, n]
                _blend_rows(rows, size, a, b, c, d, shares, held, place)
                for k in range(size if weights[4, n] > 0.0 else 0):
                    held[place + k] += weights[4, n] * poles[place + k]


@compiled(parallel=True, **FAST)
def hold_compact(
    codes: Any,
    scene: Any,
    eye: Any,
    cull: Any,
    grid: Any,
    scratch: Any,
    views: Any,
    radiance: Any,
    held: Any,
    threads: Any,
) -> None:
    """Set held, flat, `size` numbers per vertex: interpolated channel functions of compact coefficients."""
    table, poles, dense, size, runs, which, channel, values = codes
    lanes = scene[1].shape[0]
    for t in prange(threads):
        lane = SPAN * t
        while lane < lanes:
            count, lane = next_views(t, lane, threads, scene, eye, cull, grid, scratch, radiance)
            batch, bins, weights, view = scratch[0][t], scratch[2][t], scratch[3][t], views[t]
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
def draw_held(held: Any, size: Any, light: Any, shown: Any, radiance: Any, beyond: Any, sums: Any) -> None:
    """Set the radiance of the shown vertices, and 0 for the others."""
    threads, vertices, zero = sums.shape[0], radiance.shape[0], np.float32(0.0)
    for t in prange(threads):
        kept, cut = 0.0, 0.0
        for begin in range(_AT_ONCE * t, vertices, _AT_ONCE * threads):
            for v in range(begin, min(begin + _AT_ONCE, vertices)):
                if shown[v]:
                    red, green, blue = _dot(held, size, v, light)
                    stored_sum, raw_sum = store_clamped(radiance, beyond, v, red, green, blue)
                    kept += stored_sum
                    cut += stored_sum - raw_sum
                else:
                    radiance[v, 0], radiance[v, 1], radiance[v, 2] = zero, zero, zero
        sums[t, 0] += cut
        sums[t, 1] += kept
