"""Kernels for graphics cards: the layers of a network and what they are told, without a look at memory between them.

What comes in is a block's rows, one of an outgoing direction and one of incidence each; a program takes ROWS of them
from their features to RGB. A row's numbers depend on no other row. Float32 products are sums of three TF32 ones each
(`tf32x3`), which the matrix units do, and which is exact to some 10⁻⁶.
"""

from collections.abc import Callable
from typing import Any

import triton
import triton.language as tl

from prt_bake.network.features.light_ray import OCCUPANCY_SCALE

_kernel: Callable[[Callable[..., Any]], Any] = triton.jit
_OCCUPANCY_SCALE = tl.constexpr(OCCUPANCY_SCALE)


@_kernel
def _active(h, RELU: tl.constexpr):
    return tl.maximum(h, 0.0) if RELU else h * tl.sigmoid(h)


@_kernel
def _product(h, weight, before, EXACT: tl.constexpr):
    """before + h @ weight, in the type of the weight."""
    if EXACT:
        return tl.dot(h, weight, before, input_precision="tf32x3")
    return tl.dot(h.to(weight.dtype), weight, before)


@_kernel
def _and_next(h, weight, before, following, EXACT: tl.constexpr):
    """The product, and the weights of the following one. Where there is room, they are asked for ahead: they take as
    long to come as a product takes.
    """
    if EXACT:
        told = _product(h, weight, before, EXACT)
        return told, tl.load(following)
    coming = tl.load(following)
    return _product(h, weight, before, EXACT), coming


@_kernel
def network_rows(
    answer, light, chosen, view, first_weight, weights, biases, output, count, directions, scale,
    FEATURES: tl.constexpr, WIDTH: tl.constexpr, LAYERS: tl.constexpr, JOINED: tl.constexpr, RELU: tl.constexpr,
    EXACT: tl.constexpr, ROWS: tl.constexpr, PIECE: tl.constexpr, OUTPUTS: tl.constexpr,
):  # fmt: skip
    """Ŝ [count,3], count = N·D, of a network whose first layer sees everything.

    light [R·D,2F] and view [N,2F]: cosines, then sines; chosen [N]: which set of directions lights a view;
    first_weight [W,2F]; weights [·,W,W]: of the layers after it, one after another, two of a layer whose bit of JOINED
    says that it sees the one before its own source, too, and one that is not used; biases [LAYERS·W + OUTPUTS]; output
    [OUTPUTS,W].
    """
    row = tl.minimum(tl.program_id(0) * ROWS + tl.arange(0, ROWS), count - 1)
    seen = row // directions
    lit = tl.load(chosen + seen) * directions + row % directions
    piece, across = tl.arange(0, PIECE), tl.arange(0, WIDTH)
    light_at = lit[:, None] * (2 * FEATURES) + piece[None, :]
    view_at = seen[:, None] * (2 * FEATURES) + piece[None, :]
    weight_at = across[None, :] * (2 * FEATURES) + piece[:, None]
    h = tl.zeros((ROWS, WIDTH), tl.float32)
    for begin in range(0, FEATURES, PIECE):
        a, b = tl.load(light + begin + light_at), tl.load(light + (begin + FEATURES) + light_at)
        c, s = tl.load(view + begin + view_at), tl.load(view + (begin + FEATURES) + view_at)
        h = _product(a * c - b * s, tl.load(first_weight + begin + weight_at), h, EXACT)
        h = _product(a * s + b * c, tl.load(first_weight + (begin + FEATURES) + weight_at), h, EXACT)
    kind = weights.dtype.element_ty
    square, block = across[None, :] * WIDTH + across[:, None], 0
    weight = tl.load(weights + square)
    h = _active(h + tl.load(biases + across)[None, :], RELU).to(kind)
    before = h
    for layer in tl.static_range(2, LAYERS + 1):
        told = tl.load(biases + (layer - 1) * WIDTH + across)[None, :] + tl.zeros((ROWS, WIDTH), tl.float32)
        block += 1
        told, weight = _and_next(h, weight, told, weights + block * WIDTH * WIDTH + square, EXACT)
        if (JOINED >> layer) & 1:
            block += 1
            told, weight = _and_next(before, weight, told, weights + block * WIDTH * WIDTH + square, EXACT)
        before = h
        h = _active(told, RELU).to(kind)
    channel = tl.arange(0, OUTPUTS)
    last = tl.load(output + channel[None, :] * WIDTH + across[:, None])
    told = tl.load(biases + LAYERS * WIDTH + channel)[None, :] + tl.zeros((ROWS, OUTPUTS), tl.float32)
    told = _product(h, last, told, EXACT) * scale
    tl.store(answer + row[:, None] * 3 + channel[None, :], told, mask=channel[None, :] < 3)


@_kernel
def _trilinear(grid, base, u, v, w, ny, nz, within):
    """Values linear between the eight places around (u, v, w), which lie at base + (i·ny + j)·nz + k of the grid."""
    i, j, k = u.to(tl.int32), v.to(tl.int32), w.to(tl.int32)
    u, v, w = u - i, v - j, w - k
    at = grid + base + (i * ny + j) * nz + k
    near = tl.load(at, within, 0.0) * (1.0 - w) + tl.load(at + 1, within, 0.0) * w
    far = tl.load(at + nz, within, 0.0) * (1.0 - w) + tl.load(at + nz + 1, within, 0.0) * w
    low = near * (1.0 - v) + far * v
    at += ny * nz
    near = tl.load(at, within, 0.0) * (1.0 - w) + tl.load(at + 1, within, 0.0) * w
    far = tl.load(at + nz, within, 0.0) * (1.0 - w) + tl.load(at + nz + 1, within, 0.0) * w
    return low * (1.0 - u) + (near * (1.0 - v) + far * v) * u


@_kernel
def _pair_inputs(
    x, y, z, cosine, seen, frame, grids, numbers, lengths,
    POWERS: tl.constexpr, FRAME_VECTORS: tl.constexpr, LIGHT_PLACES: tl.constexpr, PAIRS: tl.constexpr,
):  # fmt: skip
    """What is told of views and directions (x, y, z) together [ROWS,PAIRS]: `NeuralBSSRDF.pair_features`.

    numbers [PAIRS,5] int32: which of the FRAME_VECTORS vectors of the frame a column is of, then where its grid begins and how
    many places that has each way; lengths [PAIRS,5]: how far along the direction, the grid's corner, and places a
    length.
    """
    column = tl.arange(0, PAIRS)
    held = frame + (seen[:, None] * FRAME_VECTORS + tl.load(numbers + 5 * column)[None, :]) * 3
    fx, fy, fz = tl.load(held), tl.load(held + 1), tl.load(held + 2)
    told = fx * x[:, None] + fy * y[:, None] + fz * z[:, None]
    power = cosine
    for number in tl.static_range(POWERS):
        told = tl.where(column[None, :] == number, power[:, None], told)
        power *= cosine
    if LIGHT_PLACES > 0:
        reach, per_length = tl.load(lengths + 5 * column)[None, :], tl.load(lengths + 5 * column + 4)[None, :]
        u = (fx + reach * x[:, None] - tl.load(lengths + 5 * column + 1)[None, :]) * per_length
        v = (fy + reach * y[:, None] - tl.load(lengths + 5 * column + 2)[None, :]) * per_length
        w = (fz + reach * z[:, None] - tl.load(lengths + 5 * column + 3)[None, :]) * per_length
        base, nx = tl.load(numbers + 5 * column + 1)[None, :], tl.load(numbers + 5 * column + 2)[None, :]
        ny, nz = tl.load(numbers + 5 * column + 3)[None, :], tl.load(numbers + 5 * column + 4)[None, :]
        way = (column[None, :] >= POWERS) & (column[None, :] < POWERS + LIGHT_PLACES)
        within = way & (u >= 0.0) & (v >= 0.0) & (w >= 0.0) & (u < nx - 1) & (v < ny - 1) & (w < nz - 1)
        u, v, w = tl.where(within, u, 0.0), tl.where(within, v, 0.0), tl.where(within, w, 0.0)
        told = tl.where(way, _OCCUPANCY_SCALE * _trilinear(grids, base, u, v, w, ny, nz, within), told)
    return told


@_kernel
def _lobe_sum(
    x, y, z, seen, channel, axes, shapes, peaks,
    LOBES: tl.constexpr, BANDS: tl.constexpr, ROWS: tl.constexpr, OUTPUTS: tl.constexpr,
):  # fmt: skip
    """What lobes add, or their bands, if there are any [ROWS,OUTPUTS]: `lobes.evaluate_lobes`."""
    added = tl.zeros((ROWS, OUTPUTS), tl.float32)
    for lobe in tl.static_range(LOBES):
        which = seen * LOBES + lobe
        cosine = x * tl.load(axes + 3 * which) + y * tl.load(axes + 3 * which + 1) + z * tl.load(axes + 3 * which + 2)
        if BANDS == 0:
            shape = tl.exp(tl.load(shapes + which) * (cosine - 1.0))
        else:
            shape, before, value = tl.load(shapes + which * BANDS), cosine * 0.0 + 1.0, cosine
            for band in tl.static_range(1, BANDS):
                shape += tl.load(shapes + which * BANDS + band) * value
                following = ((2 * band + 1) * cosine * value - band * before) / (band + 1)
                before, value = value, following
        peak = tl.load(peaks + which[:, None] * 3 + channel[None, :], channel[None, :] < 3, 0.0)
        added += shape[:, None] * peak
    return added


@_kernel
def late_rows(
    answer, table, chosen, views, incident, eye, frame, grids, numbers, lengths, pair_weights, weights, output,
    output_bias, axes, shapes, peaks, count, directions, sets, many, scale,
    WIDTH: tl.constexpr, LAYERS: tl.constexpr, POWERS: tl.constexpr, FRAME_VECTORS: tl.constexpr, LIGHT_PLACES: tl.constexpr,
    PAIRS: tl.constexpr, LOBES: tl.constexpr, BANDS: tl.constexpr, RELU: tl.constexpr, EXACT: tl.constexpr,
    ROWS: tl.constexpr, OUTPUTS: tl.constexpr,
):  # fmt: skip
    """Ŝ [count,3] of a network that sees ωi late, as `network_rows`, where each late layer acts on the one before.

    table [LAYERS,sets·D,W] and views [LAYERS,many,W]: what directions and views add to each late layer; incident
    [sets·D,3], eye [N,3], frame [N,FRAME_VECTORS,3]; pair_weights [LAYERS,W,PAIRS], weights [LAYERS−1,W,W], output [OUTPUTS,W].
    """
    row = tl.minimum(tl.program_id(0) * ROWS + tl.arange(0, ROWS), count - 1)
    seen = row // directions
    lit = tl.load(chosen + seen) * directions + row % directions
    x, y, z = tl.load(incident + 3 * lit), tl.load(incident + 3 * lit + 1), tl.load(incident + 3 * lit + 2)
    cosine = x * tl.load(eye + 3 * seen) + y * tl.load(eye + 3 * seen + 1) + z * tl.load(eye + 3 * seen + 2)
    told = _pair_inputs(x, y, z, cosine, seen, frame, grids, numbers, lengths, POWERS, FRAME_VECTORS, LIGHT_PLACES, PAIRS)
    across, column = tl.arange(0, WIDTH), tl.arange(0, PAIRS)
    of_light, of_view = lit[:, None] * WIDTH + across[None, :], seen[:, None] * WIDTH + across[None, :]
    pair_at = pair_weights + across[None, :] * PAIRS + column[:, None]
    square = across[None, :] * WIDTH + across[:, None]
    h = tl.load(table + of_light).to(tl.float32) + tl.load(views + of_view).to(tl.float32)
    kind = weights.dtype.element_ty
    told = told.to(kind)
    h = _active(_product(told, tl.load(pair_at), h, EXACT), RELU).to(kind)
    for layer in tl.static_range(1, LAYERS):
        table += sets * directions * WIDTH
        views += many * WIDTH
        after = tl.load(table + of_light).to(tl.float32) + tl.load(views + of_view).to(tl.float32)
        after = _product(told, tl.load(pair_at + layer * WIDTH * PAIRS), after, EXACT)
        h = _active(_product(h, tl.load(weights + (layer - 1) * WIDTH * WIDTH + square), after, EXACT), RELU).to(kind)
    channel = tl.arange(0, OUTPUTS)
    last = tl.load(output + channel[None, :] * WIDTH + across[:, None])
    radiance = tl.load(output_bias + channel)[None, :] + tl.zeros((ROWS, OUTPUTS), tl.float32)
    radiance = _product(h, last, radiance, EXACT)
    if LOBES > 0:
        radiance += _lobe_sum(x, y, z, seen, channel, axes, shapes, peaks, LOBES, BANDS, ROWS, OUTPUTS)
    tl.store(answer + row[:, None] * 3 + channel[None, :], radiance * scale, mask=channel[None, :] < 3)
