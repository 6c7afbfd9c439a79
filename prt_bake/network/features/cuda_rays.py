"""View rays with total internal reflections, traced on a GPU."""

from collections.abc import Callable
from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from prt_bake.network.features import interior, view_ray
from prt_bake.network.features.view_ray import Ray

ROWS = 32
"""Rays per program, traced in lockstep."""
_kernel: Callable[[Callable[..., Any]], Any] = triton.jit
_REACH = tl.constexpr(interior.REACH)
_STEP = tl.constexpr(view_ray.STEP)
_MIN_STEP = tl.constexpr(view_ray.MIN_STEP)
_ENTRY_DEPTH = tl.constexpr(view_ray.ENTRY_DEPTH)
_MIN_SLOPE = tl.constexpr(view_ray.MIN_SLOPE)


def trace_rays(
    levels: Tensor,
    corner: Tensor,
    spacing: float,
    eta: float,
    reflections: int,
    longest: float,
    x: Tensor,
    back: Tensor,
) -> Ray:
    """`view_ray.trace` in the grid levels [X,Y,Z], whose first node is at `corner`."""
    segments = len(x), reflections + 1
    starts, towards = (torch.empty((*segments, 3), device=x.device) for _ in range(2))
    begins = torch.empty(segments, device=x.device)
    _trace[(-(-len(x) // ROWS),)](
        starts, towards, begins, levels, (x - corner).contiguous(), (-back).contiguous(), len(x), *levels.shape,
        spacing, eta, longest, SEGMENTS=reflections + 1, ROWS=ROWS, num_warps=1, enable_fp_fusion=True,
    )  # fmt: skip
    return Ray(starts + corner, towards, begins)


@_kernel
def _distance(levels, x, y, z, nx, ny, nz):
    """The grid's trilinear value at points in spacings from its corner, clamped to its border."""
    u = tl.minimum(tl.maximum(x, 0.0), nx - 1.0)
    v = tl.minimum(tl.maximum(y, 0.0), ny - 1.0)
    w = tl.minimum(tl.maximum(z, 0.0), nz - 1.0)
    i, j, k = tl.minimum(u.to(tl.int32), nx - 2), tl.minimum(v.to(tl.int32), ny - 2), tl.minimum(w.to(tl.int32), nz - 2)
    u, v, w = u - i, v - j, w - k
    at = levels + (i * ny + j) * nz + k
    near = (tl.load(at) * (1.0 - w) + tl.load(at + 1) * w) * (1.0 - v)
    near += (tl.load(at + nz) * (1.0 - w) + tl.load(at + nz + 1) * w) * v
    at += ny * nz
    far = (tl.load(at) * (1.0 - w) + tl.load(at + 1) * w) * (1.0 - v)
    far += (tl.load(at + nz) * (1.0 - w) + tl.load(at + nz + 1) * w) * v
    return near * (1.0 - u) + far * u


@_kernel
def _store(vectors, at, x, y, z, mask):
    tl.store(vectors + 3 * at, x, mask=mask)
    tl.store(vectors + 3 * at + 1, y, mask=mask)
    tl.store(vectors + 3 * at + 2, z, mask=mask)


@_kernel
def _trace(
    starts, towards, begins, levels, points, along, count, nx, ny, nz, spacing, eta, longest,
    SEGMENTS: tl.constexpr, ROWS: tl.constexpr,
):  # fmt: skip
    """`view_kernel.trace_rows`, ROWS rays in lockstep."""
    n = tl.program_id(0) * ROWS + tl.arange(0, ROWS)
    active = n < count
    n = tl.minimum(n, count - 1)
    x, y, z = tl.load(points + 3 * n), tl.load(points + 3 * n + 1), tl.load(points + 3 * n + 2)
    u, v, w = tl.load(along + 3 * n), tl.load(along + 3 * n + 1), tl.load(along + 3 * n + 2)
    begin, length, inside = x * 0.0, x * 0.0, x * 0.0
    for segment in tl.static_range(SEGMENTS):
        at = n * SEGMENTS + segment
        tl.store(begins + at, begin if segment == 0 else begin + float("inf"), mask=active)
        _store(starts, at, x, y, z, active)
        _store(towards, at, u, v, w, active)
    segment, entered = tl.zeros((ROWS,), tl.int32), tl.zeros((ROWS,), tl.int1)
    per_length = 1.0 / spacing
    while tl.max(active.to(tl.int32), axis=0) > 0:
        step = spacing * tl.maximum(_STEP * inside, _MIN_STEP)
        s = length + step - begin
        distance = _REACH * _distance(
            levels, (x + s * u) * per_length, (y + s * v) * per_length, (z + s * w) * per_length, nx, ny, nz
        )
        met = active & entered & (distance <= 0.0)
        entered = entered | (active & (distance > _ENTRY_DEPTH))
        length += tl.where(active, tl.where(met, inside / tl.maximum(inside - distance, 1e-6) * step, step), 0.0)
        inside = tl.where(met, 0.0, distance)
        if tl.max(met.to(tl.int32), axis=0) > 0:
            s = length - begin
            hit_x, hit_y, hit_z = x + s * u, y + s * v, z + s * w
            p, q, r = hit_x * per_length, hit_y * per_length, hit_z * per_length
            a = _distance(levels, p - 1.0, q, r, nx, ny, nz) - _distance(levels, p + 1.0, q, r, nx, ny, nz)
            b = _distance(levels, p, q - 1.0, r, nx, ny, nz) - _distance(levels, p, q + 1.0, r, nx, ny, nz)
            c = _distance(levels, p, q, r - 1.0, nx, ny, nz) - _distance(levels, p, q, r + 1.0, nx, ny, nz)
            slope = tl.maximum(tl.sqrt(a * a + b * b + c * c), _MIN_SLOPE)
            a, b, c = a / slope, b / slope, c / slope
            cosine = u * a + v * b + w * c
            reflected = met & (segment + 1 < SEGMENTS) & (cosine > 0.0) & (eta * eta * (1.0 - cosine * cosine) > 1.0)
            active = active & ~(met & ~reflected)
            segment += reflected.to(tl.int32)
            x, y, z = tl.where(reflected, hit_x, x), tl.where(reflected, hit_y, y), tl.where(reflected, hit_z, z)
            back = tl.where(reflected, 2.0 * cosine, 0.0)
            u, v, w = u - back * a, v - back * b, w - back * c
            begin = tl.where(reflected, length, begin)
            entered = entered & ~reflected
            at = n * SEGMENTS + segment
            tl.store(begins + at, begin, mask=reflected)
            _store(starts, at, x, y, z, reflected)
            _store(towards, at, u, v, w, reflected)
        active = active & (length < longest)
