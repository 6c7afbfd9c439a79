"""Frames, compiled: what is stored where the eye looks, under the light; each thread with batches of its own.

Sums over coefficients are float32. While one vertex is summed up the memory already fetches those of the `_AHEAD`th
after it: coefficients of different vertices never share a line, and waiting for them is what a frame costs.

All kernels that draw take where the vertices lie and which are asked for (`scene`), the eye [3], whether to leave out
those that turn away, what each thread works with (`desks`), and set radiance [V,3] and sums [threads,…]: what was cut
off and what is left.
"""

from typing import Any

import numpy as np
from numba import prange

from prt_bake.jit.compilation import compiled
from prt_bake.jit.vectors import blend, fetch_ahead, lit_rows_by_1, lit_rows_by_4, lit_rows_by_16, lit_run
from prt_bake.shading.frames.batches import FAST, SPAN, between, next_batch, part

_AHEAD = 16
_FOLDED = 6
"""Numbers of a bin of a folded light: its colour, and that of the bin below it."""
_LINE = 64
"""Bytes."""


@part
def look(t: Any, lane: Any, threads: Any, scene: Any, eye: Any, cull: Any, grid: Any, desks: Any, radiance: Any) -> Any:
    """The next batch of thread t, and where its directions lie: how many of it are shown, and the lane after."""
    batches, locals_, bins, weights = desks
    count, lane = next_batch(lane, threads, scene, eye, cull, radiance, batches[t], locals_[t])
    rings, sectors = grid
    if rings * sectors > 1:
        between(locals_[t], count, float(rings), float(sectors), bins[t], weights[t])
    return count, lane


@part
def show(radiance: Any, v: Any, red: Any, green: Any, blue: Any) -> Any:
    """Keep what is not negative; the sum of it, and of all."""
    none = np.float32(0.0)
    r, g, b = max(red, none), max(green, none), max(blue, none)
    radiance[v, 0], radiance[v, 1], radiance[v, 2] = r, g, b
    return r + g + b, red + green + blue


@part
def _lit(rows: Any, size: Any, a: Any, b: Any, c: Any, d: Any, weights: Any, light: Any) -> Any:
    of_a, of_b, of_c, of_d = weights
    if size >= 16:
        return lit_rows_by_16(rows, size, a * size, b * size, c * size, d * size, of_a, of_b, of_c, of_d, light)
    if size >= 4:
        return lit_rows_by_4(rows, size, a * size, b * size, c * size, d * size, of_a, of_b, of_c, of_d, light)
    return lit_rows_by_1(rows, size, a * size, b * size, c * size, d * size, of_a, of_b, of_c, of_d, light)


@part
def _fetch_rows(rows: Any, size: Any, first: Any, bins: Any, n: Any) -> None:
    """All lines of the four rows; neighbouring sectors lie side by side, but for the last and the first."""
    low, high = (first + bins[0, n]) * size, (first + bins[2, n]) * size
    for place in range(0, 2 * size, _LINE // rows.itemsize):
        fetch_ahead(rows, low + place)
        fetch_ahead(rows, high + place)
    fetch_ahead(rows, (first + bins[1, n]) * size + size - 1)
    fetch_ahead(rows, (first + bins[3, n]) * size + size - 1)


@part
def _show_rows(
    stored: Any, size: Any, per_vertex: Any, light: Any, batch: Any, count: Any, bins: Any, weights: Any, radiance: Any,
    sums: Any,
) -> None:  # fmt: skip
    rows, poles = stored
    none, kept, cut = np.float32(0.0), 0.0, 0.0
    for n in range(min(_AHEAD, count)):
        _fetch_rows(rows, size, batch[n] * per_vertex, bins, n)
    for n in range(count):
        if n + _AHEAD < count:
            _fetch_rows(rows, size, batch[n + _AHEAD] * per_vertex, bins, n + _AHEAD)
        v = batch[n]
        first = v * per_vertex
        shares = (weights[0, n], weights[1, n], weights[2, n], weights[3, n])
        red, green, blue = _lit(
            rows, size, first + bins[0, n], first + bins[1, n], first + bins[2, n], first + bins[3, n], shares, light
        )
        if weights[4, n] > none:
            r, g, b = _lit(poles, size, v, v, v, v, (weights[4, n], none, none, none), light)
            red, green, blue = red + r, green + g, blue + b
        more, whole = show(radiance, v, red, green, blue)
        kept += more
        cut += more - whole
    sums[0] += cut
    sums[1] += kept


@compiled(parallel=True, **FAST)
def draw_rows(
    stored: Any, size: Any, light: Any, scene: Any, eye: Any, cull: Any, grid: Any, desks: Any, radiance: Any, sums: Any
) -> None:
    """Coefficients as they lie: stored, rows of `size` numbers, flat, float32 or bits of float16, a row for each bin of
    each vertex, and the means of ring 0, float32, a row for each vertex; light as `vectors.laid_out` has it.
    """
    threads, per_vertex, lanes = sums.shape[0], grid[0] * grid[1], scene[1].shape[0]
    for t in prange(threads):
        lane = SPAN * t
        while lane < lanes:
            count, lane = look(t, lane, threads, scene, eye, cull, grid, desks, radiance)
            batch, bins, weights = desks[0][t], desks[2][t], desks[3][t]
            _show_rows(stored, size, per_vertex, light, batch, count, bins, weights, radiance, sums[t])


@part
def _fetch_folded(pairs: Any, first: Any, bins: Any, n: Any) -> None:
    fetch_ahead(pairs, (first + bins[0, n]) * _FOLDED)
    fetch_ahead(pairs, (first + bins[1, n]) * _FOLDED + _FOLDED - 1)


@part
def _show_folded(
    stored: Any, per_vertex: Any, batch: Any, count: Any, bins: Any, weights: Any, radiance: Any, sums: Any
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
        of_a, of_b, of_c, of_d = weights[0, n], weights[1, n], weights[2, n], weights[3, n]
        red, green, blue = blend(pairs, a, b, a + 3, b + 3, of_a, of_b, of_c, of_d)
        of_pole = weights[4, n]
        if of_pole > 0.0:
            red += of_pole * poles[v, 0]
            green += of_pole * poles[v, 1]
            blue += of_pole * poles[v, 2]
        more, whole = show(radiance, v, red, green, blue)
        kept += more
        cut += more - whole
    sums[0] += cut
    sums[1] += kept


@compiled(parallel=True, **FAST)
def draw_folded(stored: Any, scene: Any, eye: Any, cull: Any, grid: Any, desks: Any, radiance: Any, sums: Any) -> None:
    """Radiance of each bin: stored, that of a bin and of the one below it in the next ring side by side, flat, so that
    the four that a view lies between are one place in memory, and the means of ring 0 [V,3].
    """
    threads, per_vertex, lanes = sums.shape[0], grid[0] * grid[1], scene[1].shape[0]
    for t in prange(threads):
        lane = SPAN * t
        while lane < lanes:
            count, lane = look(t, lane, threads, scene, eye, cull, grid, desks, radiance)
            batch, bins, weights = desks[0][t], desks[2][t], desks[3][t]
            _show_folded(stored, per_vertex, batch, count, bins, weights, radiance, sums[t])


@compiled(parallel=True, **FAST)
def fold_rows(rows: Any, size: Any, light: Any, grid: Any, valid: Any, pairs: Any) -> None:
    """Set the pairs of `draw_folded` from the rows of `draw_rows`."""
    rings, sectors = grid
    whole = (np.float32(1.0), np.float32(0.0), np.float32(0.0), np.float32(0.0))
    for v in prange(valid.shape[0]):
        if valid[v]:
            for j in range(rings * sectors):
                row = v * rings * sectors + j
                red, green, blue = _lit(rows, size, row, row, row, row, whole, light)
                _keep_pair(pairs, row, j, sectors, red, green, blue)


@compiled(parallel=True, **FAST)
def pair_up(radiance: Any, grid: Any, vertices: Any, pairs: Any) -> None:
    """Set the pairs of `draw_folded` from the radiance [n,B,3] of some vertices [n]."""
    rings, sectors = grid
    for n in prange(vertices.shape[0]):
        for j in range(rings * sectors):
            row = vertices[n] * rings * sectors + j
            _keep_pair(pairs, row, j, sectors, radiance[n, j, 0], radiance[n, j, 1], radiance[n, j, 2])


@part
def _keep_pair(pairs: Any, row: Any, j: Any, sectors: Any, red: Any, green: Any, blue: Any) -> None:
    place = row * _FOLDED
    pairs[place], pairs[place + 1], pairs[place + 2] = red, green, blue
    if j >= sectors:
        place = (row - sectors) * _FOLDED + 3
        pairs[place], pairs[place + 1], pairs[place + 2] = red, green, blue


@part
def interpolate(table: Any, bins: Any, weights: Any, poles: Any, n: Any, view: Any) -> None:
    """Set view [R]: each function of the view in the n-th direction."""
    a, b, c, d = table[bins[0, n]], table[bins[1, n]], table[bins[2, n]], table[bins[3, n]]
    of_a, of_b, of_c, of_d, of_pole = weights[0, n], weights[1, n], weights[2, n], weights[3, n], weights[4, n]
    for r in range(table.shape[1]):
        view[r] = of_a * a[r] + of_b * b[r] + of_c * c[r] + of_d * d[r] + of_pole * poles[r]


@compiled(parallel=True, **FAST)
def draw_compact(
    codes: Any,
    lights: Any,
    scene: Any,
    eye: Any,
    cull: Any,
    grid: Any,
    desks: Any,
    views: Any,
    radiance: Any,
    sums: Any,
) -> None:
    """Compact coefficients as `frame_codes.Codes` lays them out; lights: `vectors.laid_out` of Σ_k channels · light,
    and the same [J,3]; views: float32 [threads,R], a place for each function of the view.
    """
    table, poles, dense, size, runs, which, channel, values = codes
    laid, plain = lights
    threads, lanes, most = sums.shape[0], scene[1].shape[0], dense.shape[1] // size
    for t in prange(threads):
        lane = SPAN * t
        while lane < lanes:
            count, lane = look(t, lane, threads, scene, eye, cull, grid, desks, radiance)
            batch, bins, weights, view = desks[0][t], desks[2][t], desks[3][t], views[t]
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
                more, whole = show(radiance, v, red, green, blue)
                sums[t, 0] += more - whole
                sums[t, 1] += more
