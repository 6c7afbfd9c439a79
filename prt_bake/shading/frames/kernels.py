"""The kernels of frames: interpolation between view bins and the dot product with the light, in batches per thread.

Sums over coefficients are float32. While one vertex is summed, the kernels prefetch the coefficients of the vertex
`_AHEAD` places later: coefficients of different vertices never share a cache line, and memory latency dominates.

All drawing kernels take the geometry and flags of the vertices (`scene`), the eye [3], `cull`, and working memory of
each thread (`scratch`). They set radiance [V,3] and sums [threads,…] of the clamped and the remaining radiance. beyond
[V,3]: radiance of lobes, which they add; [0,3] without lobes.
"""

from typing import Any

import numpy as np
from numba import prange

from prt_bake.jit.compilation import compiled
from prt_bake.jit.vectors import blend, fetch_ahead, lit_rows_by_1, lit_rows_by_4, lit_rows_by_16, lit_run
from prt_bake.shading.frames.batches import FAST, SPAN, bin_coordinates, inlined, next_batch

_AHEAD = 16
_FOLDED = 6
"""Numbers per bin of a folded light: its colour, and that of the bin in the next ring."""
_LINE = 64
"""Bytes of a cache line."""


@inlined
def next_views(
    t: Any, lane: Any, threads: Any, scene: Any, eye: Any, cull: Any, grid: Any, scratch: Any, radiance: Any
) -> Any:
    """The next batch of thread t with its bin coordinates; returns the number of vertices and the next lane."""
    batches, locals_, bins, weights = scratch
    count, lane = next_batch(lane, threads, scene, eye, cull, radiance, batches[t], locals_[t])
    rings, sectors = grid
    if rings * sectors > 1:
        bin_coordinates(locals_[t], count, float(rings), float(sectors), bins[t], weights[t])
    return count, lane


@inlined
def store_clamped(radiance: Any, beyond: Any, v: Any, red: Any, green: Any, blue: Any) -> Any:
    """Store a colour with what lies beyond the harmonics, clamped to at least 0; returns the sums over channels after
    and before clamping.
    """
    zero = np.float32(0.0)
    if beyond.shape[0] > 0:
        red, green, blue = red + beyond[v, 0], green + beyond[v, 1], blue + beyond[v, 2]
    r, g, b = max(red, zero), max(green, zero), max(blue, zero)
    radiance[v, 0], radiance[v, 1], radiance[v, 2] = r, g, b
    return r + g + b, red + green + blue


@inlined
def _dot(rows: Any, size: Any, a: Any, b: Any, c: Any, d: Any, weights: Any, light: Any) -> Any:
    w_a, w_b, w_c, w_d = weights
    if size >= 16:
        return lit_rows_by_16(rows, size, a * size, b * size, c * size, d * size, w_a, w_b, w_c, w_d, light)
    if size >= 4:
        return lit_rows_by_4(rows, size, a * size, b * size, c * size, d * size, w_a, w_b, w_c, w_d, light)
    return lit_rows_by_1(rows, size, a * size, b * size, c * size, d * size, w_a, w_b, w_c, w_d, light)


@inlined
def _fetch_rows(rows: Any, size: Any, first: Any, bins: Any, n: Any) -> None:
    """Prefetch the four rows; neighbouring sectors are adjacent, except the last and the first."""
    low, high = (first + bins[0, n]) * size, (first + bins[2, n]) * size
    for place in range(0, 2 * size, _LINE // rows.itemsize):
        fetch_ahead(rows, low + place)
        fetch_ahead(rows, high + place)
    fetch_ahead(rows, (first + bins[1, n]) * size + size - 1)
    fetch_ahead(rows, (first + bins[3, n]) * size + size - 1)


@inlined
def _draw_rows(
    stored: Any, size: Any, per_vertex: Any, light: Any, batch: Any, count: Any, bins: Any, weights: Any, radiance: Any,
    beyond: Any, sums: Any,
) -> None:  # fmt: skip
    rows, poles = stored
    zero, kept, cut = np.float32(0.0), 0.0, 0.0
    for n in range(min(_AHEAD, count)):
        _fetch_rows(rows, size, batch[n] * per_vertex, bins, n)
    for n in range(count):
        if n + _AHEAD < count:
            _fetch_rows(rows, size, batch[n + _AHEAD] * per_vertex, bins, n + _AHEAD)
        v = batch[n]
        first = v * per_vertex
        shares = (weights[0, n], weights[1, n], weights[2, n], weights[3, n])
        red, green, blue = _dot(
            rows, size, first + bins[0, n], first + bins[1, n], first + bins[2, n], first + bins[3, n], shares, light
        )
        if weights[4, n] > zero:
            r, g, b = _dot(poles, size, v, v, v, v, (weights[4, n], zero, zero, zero), light)
            red, green, blue = red + r, green + g, blue + b
        stored_sum, raw_sum = store_clamped(radiance, beyond, v, red, green, blue)
        kept += stored_sum
        cut += stored_sum - raw_sum
    sums[0] += cut
    sums[1] += kept


@compiled(parallel=True, **FAST)
def draw_rows(
    stored: Any,
    size: Any,
    light: Any,
    scene: Any,
    eye: Any,
    cull: Any,
    grid: Any,
    scratch: Any,
    radiance: Any,
    beyond: Any,
    sums: Any,
) -> None:
    """Draw coefficients in their storage.

    stored: rows of `size` numbers, flat, float32 or bits of float16, a row for each bin of each vertex; and the means
    of ring 0, float32, a row for each vertex. light: from `vectors.laid_out`.
    """
    threads, per_vertex, lanes = sums.shape[0], grid[0] * grid[1], scene[1].shape[0]
    for t in prange(threads):
        lane = SPAN * t
        while lane < lanes:
            count, lane = next_views(t, lane, threads, scene, eye, cull, grid, scratch, radiance)
            batch, bins, weights = scratch[0][t], scratch[2][t], scratch[3][t]
            _draw_rows(stored, size, per_vertex, light, batch, count, bins, weights, radiance, beyond, sums[t])


@inlined
def _fetch_folded(pairs: Any, first: Any, bins: Any, n: Any) -> None:
    fetch_ahead(pairs, (first + bins[0, n]) * _FOLDED)
    fetch_ahead(pairs, (first + bins[1, n]) * _FOLDED + _FOLDED - 1)


@inlined
def _draw_folded(
    stored: Any, per_vertex: Any, batch: Any, count: Any, bins: Any, weights: Any, radiance: Any, beyond: Any, sums: Any
) -> None:
    pairs, poles = stored
    kept, cut = 0.0, 0.0
    for n in range(min(_AHEAD, count)):
        _fetch_folded(pairs, batch[n] * per_vertex, bins, n)
    for n in range(count):
        if n + _AHEAD < count:
            _fetch_folded(pairs, batch[n + _AHEAD] * per_vertex, bins, n + _AHEAD)
        v = batch[n]
        a, b = (v * per_vertex + bins[0, n]) * _FOLDED, (v * per_vertex + bins[1, n]) * _FOLDED
        w_a, w_b, w_c, w_d = weights[0, n], weights[1, n], weights[2, n], weights[3, n]
        red, green, blue = blend(pairs, a, b, a + 3, b + 3, w_a, w_b, w_c, w_d)
        w_pole = weights[4, n]
        if w_pole > 0.0:
            red += w_pole * poles[v, 0]
            green += w_pole * poles[v, 1]
            blue += w_pole * poles[v, 2]
        stored_sum, raw_sum = store_clamped(radiance, beyond, v, red, green, blue)
        kept += stored_sum
        cut += stored_sum - raw_sum
    sums[0] += cut
    sums[1] += kept


@compiled(parallel=True, **FAST)
def draw_folded(
    stored: Any, scene: Any, eye: Any, cull: Any, grid: Any, scratch: Any, radiance: Any, beyond: Any, sums: Any
) -> None:
    """Draw a folded light.

    stored: pairs of the colours of a bin and of the bin in the next ring, flat, so that the four bins around a view are
    adjacent in memory; and the means of ring 0 [V,3].
    """
    threads, per_vertex, lanes = sums.shape[0], grid[0] * grid[1], scene[1].shape[0]
    for t in prange(threads):
        lane = SPAN * t
        while lane < lanes:
            count, lane = next_views(t, lane, threads, scene, eye, cull, grid, scratch, radiance)
            batch, bins, weights = scratch[0][t], scratch[2][t], scratch[3][t]
            _draw_folded(stored, per_vertex, batch, count, bins, weights, radiance, beyond, sums[t])


@compiled(parallel=True, **FAST)
def fold_rows(rows: Any, size: Any, light: Any, grid: Any, valid: Any, pairs: Any) -> None:
    """Set the pairs of `draw_folded` from the rows of `draw_rows`."""
    rings, sectors = grid
    first_only = (np.float32(1.0), np.float32(0.0), np.float32(0.0), np.float32(0.0))
    for v in prange(valid.shape[0]):
        if valid[v]:
            for j in range(rings * sectors):
                row = v * rings * sectors + j
                red, green, blue = _dot(rows, size, row, row, row, row, first_only, light)
                _store_pair(pairs, row, j, sectors, red, green, blue)


@compiled(parallel=True, **FAST)
def pair_up(radiance: Any, grid: Any, vertices: Any, pairs: Any) -> None:
    """Set the pairs of `draw_folded` from the radiance [n,B,3] of some vertices [n]."""
    rings, sectors = grid
    for n in prange(vertices.shape[0]):
        for j in range(rings * sectors):
            row = vertices[n] * rings * sectors + j
            _store_pair(pairs, row, j, sectors, radiance[n, j, 0], radiance[n, j, 1], radiance[n, j, 2])


@inlined
def _store_pair(pairs: Any, row: Any, j: Any, sectors: Any, red: Any, green: Any, blue: Any) -> None:
    place = row * _FOLDED
    pairs[place], pairs[place + 1], pairs[place + 2] = red, green, blue
    if j >= sectors:
        place = (row - sectors) * _FOLDED + 3
        pairs[place], pairs[place + 1], pairs[place + 2] = red, green, blue


@inlined
def interpolate(table: Any, bins: Any, weights: Any, poles: Any, n: Any, view: Any) -> None:
    """Set view [R] to the view functions in the n-th direction."""
    a, b, c, d = table[bins[0, n]], table[bins[1, n]], table[bins[2, n]], table[bins[3, n]]
    w_a, w_b, w_c, w_d, w_pole = weights[0, n], weights[1, n], weights[2, n], weights[3, n], weights[4, n]
    for r in range(table.shape[1]):
        view[r] = w_a * a[r] + w_b * b[r] + w_c * c[r] + w_d * d[r] + w_pole * poles[r]


@compiled(parallel=True, **FAST)
def draw_compact(
    codes: Any,
    lights: Any,
    scene: Any,
    eye: Any,
    cull: Any,
    grid: Any,
    scratch: Any,
    views: Any,
    radiance: Any,
    beyond: Any,
    sums: Any,
) -> None:
    """Draw compact coefficients in the layout of `codes.Codes`.

    lights: Σ_k channels · light [J,3], as `vectors.laid_out` gives it and as it is. views: float32 [threads,R], working
    memory for the view functions.
    """
    table, poles, dense, size, runs, which, channel, values = codes
    laid, plain = lights
    threads, lanes, most = sums.shape[0], scene[1].shape[0], dense.shape[1] // size
    for t in prange(threads):
        lane = SPAN * t
        while lane < lanes:
            count, lane = next_views(t, lane, threads, scene, eye, cull, grid, scratch, radiance)
            batch, bins, weights, view = scratch[0][t], scratch[2][t], scratch[3][t], views[t]
            for n in range(count):
                v = batch[n]
                for line in range(0, dense.shape[1], _LINE):
                    fetch_ahead(dense[batch[min(n + 1, count - 1)]], line)
                interpolate(table, bins, weights, poles, n, view)
                red, green, blue = lit_run(dense[v], size, 0, most, view, laid)
                for i in range(runs[v], runs[v + 1]):
                    share, j = values[i] * view[which[i]], channel[i]
                    red += share * plain[j, 0]
                    green += share * plain[j, 1]
                    blue += share * plain[j, 2]
                stored_sum, raw_sum = store_clamped(radiance, beyond, v, red, green, blue)
                sums[t, 0] += stored_sum - raw_sum
                sums[t, 1] += stored_sum
