"""GPU kernels: features and all layers of a network in one kernel, with no memory traffic between layers.

The input is the rows of a block, each a pair of a view and an incident direction. A program computes ROWS of them from
their features to RGB. No row depends on another. A float32 product is the sum of three TF32 products (`tf32x3`), which
run on the matrix units and are exact to about 10⁻⁶.
"""

from collections.abc import Callable
from typing import Any

import triton
import triton.language as tl

from prt_bake.network.features.light_ray import OCCUPANCY_SCALE

_kernel: Callable[[Callable[..., Any]], Any] = triton.jit
_OCCUPANCY_SCALE = tl.constexpr(OCCUPANCY_SCALE)


@_kernel
def _activation(h, RELU: tl.constexpr):
    return tl.maximum(h, 0.0) if RELU else h * tl.sigmoid(h)


@_kernel
def _product(h, weight, before, EXACT: tl.constexpr):
    """before + h @ weight; h is rounded to the weight's dtype."""
    if EXACT:
        return tl.dot(h, weight, before, input_precision="tf32x3")
    return tl.dot(h.to(weight.dtype), weight, before)


@_kernel
def _product_and_next(h, weight, before, following, EXACT: tl.constexpr):
    """The product, and the weights of the following product.

    In bfloat16 there are registers to load these before the product, which hides their latency.
    """
    if EXACT:
        result = _product(h, weight, before, EXACT)
        return result, tl.load(following)
    next_weight = tl.load(following)
    return _product(h, weight, before, EXACT), next_weight


@_kernel
def network_rows(
    result, light, chosen, view, first_weight, weights, biases, output, count, directions, scale,
    FEATURES: tl.constexpr, WIDTH: tl.constexpr, LAYERS: tl.constexpr, SKIPS: tl.constexpr, RELU: tl.constexpr,
    EXACT: tl.constexpr, ROWS: tl.constexpr, STEP: tl.constexpr, OUTPUTS: tl.constexpr,
):  # fmt: skip
    """Ŝ [count,3], count = N·D, of a network whose first layer sees all inputs.

    light [R·D,2F] and view [N,2F]: cosines, then sines; chosen [N]: the rotation under which a view is lit;
    first_weight [W,2F]; weights [·,W,W]: those of the other hidden layers in order, two for a layer whose bit of SKIPS
    is set (on the layer before, then on the one before that), and one unused block at the end; biases
    [LAYERS·W + OUTPUTS]; output [OUTPUTS,W].
    """
    row = tl.minimum(tl.program_id(0) * ROWS + tl.arange(0, ROWS), count - 1)
    view_row = row // directions
    light_row = tl.load(chosen + view_row) * directions + row % directions
    frequency, unit = tl.arange(0, STEP), tl.arange(0, WIDTH)
    light_at = light_row[:, None] * (2 * FEATURES) + frequency[None, :]
    view_at = view_row[:, None] * (2 * FEATURES) + frequency[None, :]
    weight_at = unit[None, :] * (2 * FEATURES) + frequency[:, None]
    h = tl.zeros((ROWS, WIDTH), tl.float32)
    for begin in range(0, FEATURES, STEP):
        a, b = tl.load(light + begin + light_at), tl.load(light + (begin + FEATURES) + light_at)
        c, s = tl.load(view + begin + view_at), tl.load(view + (begin + FEATURES) + view_at)
        h = _product(a * c - b * s, tl.load(first_weight + begin + weight_at), h, EXACT)
        h = _product(a * s + b * c, tl.load(first_weight + (begin + FEATURES) + weight_at), h, EXACT)
    dtype = weights.dtype.element_ty
    square, block = unit[None, :] * WIDTH + unit[:, None], 0
    weight = tl.load(weights + square)
    h = _activation(h + tl.load(biases + unit)[None, :], RELU).to(dtype)
    previous = h
    for layer in tl.static_range(2, LAYERS + 1):
        total = tl.load(biases + (layer - 1) * WIDTH + unit)[None, :] + tl.zeros((ROWS, WIDTH), tl.float32)
        block += 1
        total, weight = _product_and_next(h, weight, total, weights + block * WIDTH * WIDTH + square, EXACT)
        if (SKIPS >> layer) & 1:
            block += 1
            total, weight = _product_and_next(previous, weight, total, weights + block * WIDTH * WIDTH + square, EXACT)
        previous = h
        h = _activation(total, RELU).to(dtype)
    channel = tl.arange(0, OUTPUTS)
    last = tl.load(output + channel[None, :] * WIDTH + unit[:, None])
    radiance = tl.load(biases + LAYERS * WIDTH + channel)[None, :] + tl.zeros((ROWS, OUTPUTS), tl.float32)
    radiance = _product(h, last, radiance, EXACT) * scale
    tl.store(result + row[:, None] * 3 + channel[None, :], radiance, mask=channel[None, :] < 3)


@_kernel
def _trilinear(grid, base, u, v, w, ny, nz, within):
    """Trilinear values at (u, v, w), in spacings, of a grid whose node (i, j, k) is at base + (i·ny + j)·nz + k."""
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
    x, y, z, cosine, view_row, frame, grids, numbers, lengths,
    POWERS: tl.constexpr, FRAME_ROWS: tl.constexpr, LIGHT_PLACES: tl.constexpr, PAIRS: tl.constexpr,
):  # fmt: skip
    """Features [ROWS,PAIRS] of views and directions (x, y, z) together: `NetworkCore.pair_features`.

    numbers [PAIRS,5] int32: the row of the view's frame that a column uses, where its grid begins, and the grid's
    shape; lengths [PAIRS,5]: the distance along the direction, the grid's corner, and nodes per length.
    """
    column = tl.arange(0, PAIRS)
    vector = frame + (view_row[:, None] * FRAME_ROWS + tl.load(numbers + 5 * column)[None, :]) * 3
    fx, fy, fz = tl.load(vector), tl.load(vector + 1), tl.load(vector + 2)
    features = fx * x[:, None] + fy * y[:, None] + fz * z[:, None]
    power = cosine
    for number in tl.static_range(POWERS):
        features = tl.where(column[None, :] == number, power[:, None], features)
        power *= cosine
    if LIGHT_PLACES > 0:
        reach, per_length = tl.load(lengths + 5 * column)[None, :], tl.load(lengths + 5 * column + 4)[None, :]
        u = (fx + reach * x[:, None] - tl.load(lengths + 5 * column + 1)[None, :]) * per_length
        v = (fy + reach * y[:, None] - tl.load(lengths + 5 * column + 2)[None, :]) * per_length
        w = (fz + reach * z[:, None] - tl.load(lengths + 5 * column + 3)[None, :]) * per_length
        base, nx = tl.load(numbers + 5 * column + 1)[None, :], tl.load(numbers + 5 * column + 2)[None, :]
        ny, nz = tl.load(numbers + 5 * column + 3)[None, :], tl.load(numbers + 5 * column + 4)[None, :]
        occupancy = (column[None, :] >= POWERS) & (column[None, :] < POWERS + LIGHT_PLACES)
        within = occupancy & (u >= 0.0) & (v >= 0.0) & (w >= 0.0) & (u < nx - 1) & (v < ny - 1) & (w < nz - 1)
        u, v, w = tl.where(within, u, 0.0), tl.where(within, v, 0.0), tl.where(within, w, 0.0)
        values = _OCCUPANCY_SCALE * _trilinear(grids, base, u, v, w, ny, nz, within)
        features = tl.where(occupancy, values, features)
    return features


@_kernel
def _lobe_sum(
    x, y, z, view_row, channel, axes, shapes, peaks,
    LOBES: tl.constexpr, BANDS: tl.constexpr, ROWS: tl.constexpr, OUTPUTS: tl.constexpr,
):  # fmt: skip
    """The sum of lobes, or of their bands if BANDS > 0 [ROWS,OUTPUTS]: `lobes.evaluate_lobes`."""
    total = tl.zeros((ROWS, OUTPUTS), tl.float32)
    for lobe in tl.static_range(LOBES):
        which = view_row * LOBES + lobe
        cosine = x * tl.load(axes + 3 * which) + y * tl.load(axes + 3 * which + 1) + z * tl.load(axes + 3 * which + 2)
        if BANDS == 0:
            shape = tl.exp(tl.load(shapes + which) * (cosine - 1.0))
        else:
            shape, previous, value = tl.load(shapes + which * BANDS), cosine * 0.0 + 1.0, cosine
            for band in tl.static_range(1, BANDS):
                shape += tl.load(shapes + which * BANDS + band) * value
                following = ((2 * band + 1) * cosine * value - band * previous) / (band + 1)
                previous, value = value, following
        peak = tl.load(peaks + which[:, None] * 3 + channel[None, :], channel[None, :] < 3, 0.0)
        total += shape[:, None] * peak
    return total


@_kernel
def late_rows(
    result, table, chosen, views, incident, eye, frame, grids, numbers, lengths, pair_weights, weights, output,
    output_bias, axes, shapes, peaks, count, directions, sets, view_count, scale,
    WIDTH: tl.constexpr, LAYERS: tl.constexpr, POWERS: tl.constexpr, FRAME_ROWS: tl.constexpr,
    LIGHT_PLACES: tl.constexpr, PAIRS: tl.constexpr, LOBES: tl.constexpr, BANDS: tl.constexpr, RELU: tl.constexpr,
    EXACT: tl.constexpr, ROWS: tl.constexpr, OUTPUTS: tl.constexpr,
):  # fmt: skip
    """Ŝ [count,3] of a network whose late layers see ωi; each late layer acts on the late layer before it alone.

    table [LAYERS,sets·D,W] and views [LAYERS,view_count,W]: contributions of directions and views to the late layers;
    incident [sets·D,3], eye [N,3], frame [N,FRAME_ROWS,3]; pair_weights [LAYERS,W,PAIRS], weights [LAYERS−1,W,W],
    output [OUTPUTS,W].
    """
    row = tl.minimum(tl.program_id(0) * ROWS + tl.arange(0, ROWS), count - 1)
    view_row = row // directions
    light_row = tl.load(chosen + view_row) * directions + row % directions
    light, view = incident + 3 * light_row, eye + 3 * view_row
    x, y, z = tl.load(light), tl.load(light + 1), tl.load(light + 2)
    cosine = x * tl.load(view) + y * tl.load(view + 1) + z * tl.load(view + 2)
    pairs = _pair_inputs(
        x, y, z, cosine, view_row, frame, grids, numbers, lengths, POWERS, FRAME_ROWS, LIGHT_PLACES, PAIRS
    )
    unit, column = tl.arange(0, WIDTH), tl.arange(0, PAIRS)
    light_at, view_at = light_row[:, None] * WIDTH + unit[None, :], view_row[:, None] * WIDTH + unit[None, :]
    pair_at = pair_weights + unit[None, :] * PAIRS + column[:, None]
    square = unit[None, :] * WIDTH + unit[:, None]
    h = tl.load(table + light_at).to(tl.float32) + tl.load(views + view_at).to(tl.float32)
    dtype = weights.dtype.element_ty
    pairs = pairs.to(dtype)
    h = _activation(_product(pairs, tl.load(pair_at), h, EXACT), RELU).to(dtype)
    for layer in tl.static_range(1, LAYERS):
        table += sets * directions * WIDTH
        views += view_count * WIDTH
        total = tl.load(table + light_at).to(tl.float32) + tl.load(views + view_at).to(tl.float32)
        total = _product(pairs, tl.load(pair_at + layer * WIDTH * PAIRS), total, EXACT)
        total = _product(h, tl.load(weights + (layer - 1) * WIDTH * WIDTH + square), total, EXACT)
        h = _activation(total, RELU).to(dtype)
    channel = tl.arange(0, OUTPUTS)
    last = tl.load(output + channel[None, :] * WIDTH + unit[:, None])
    radiance = tl.load(output_bias + channel)[None, :] + tl.zeros((ROWS, OUTPUTS), tl.float32)
    radiance = _product(h, last, radiance, EXACT)
    if LOBES > 0:
        radiance += _lobe_sum(x, y, z, view_row, channel, axes, shapes, peaks, LOBES, BANDS, ROWS, OUTPUTS)
    tl.store(result + row[:, None] * 3 + channel[None, :], radiance * scale, mask=channel[None, :] < 3)
