"""Compiled features of views: the CPU version of `view_features`, several times as fast as torch."""

from typing import Any

import numpy as np

from prt_bake.jit.compilation import compiled
from prt_bake.network.features.pair_kernel import cos_sin

_ONE = np.float32(1.0)
_ZERO = np.float32(0.0)


@compiled(nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def distance_at(levels: Any, per_length: Any, x: Any, y: Any, z: Any) -> Any:
    """The grid's trilinear value at a point from its corner, clamped to its border."""
    nx, ny, nz = levels.shape
    u = min(max(x * per_length, _ZERO), np.float32(nx - 1))
    v = min(max(y * per_length, _ZERO), np.float32(ny - 1))
    w = min(max(z * per_length, _ZERO), np.float32(nz - 1))
    i, j, k = min(int(u), nx - 2), min(int(v), ny - 2), min(int(w), nz - 2)
    u, v, w = u - np.float32(i), v - np.float32(j), w - np.float32(k)
    low = levels[i, j, k] * (_ONE - w) + levels[i, j, k + 1] * w
    high = levels[i, j + 1, k] * (_ONE - w) + levels[i, j + 1, k + 1] * w
    near = low * (_ONE - v) + high * v
    low = levels[i + 1, j, k] * (_ONE - w) + levels[i + 1, j, k + 1] * w
    high = levels[i + 1, j + 1, k] * (_ONE - w) + levels[i + 1, j + 1, k + 1] * w
    return near * (_ONE - u) + (low * (_ONE - v) + high * v) * u


@compiled(nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def distance_rows(levels: Any, per_length: Any, points: Any, distances: Any) -> None:
    """Sets distances [N,K] to the grid's values at points [N,K,3] from its corner."""
    for n in range(points.shape[0]):
        for k in range(points.shape[1]):
            distances[n, k] = distance_at(levels, per_length, points[n, k, 0], points[n, k, 1], points[n, k, 2])


@compiled(nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def shape_rows(grid: Any, per_length: Any, points: Any, rows: Any) -> None:
    """Sets rows [N,C] to the values of a grid [X,Y,Z,C] at points [N,3] from its corner: `shape.trilinear`."""
    nx, ny, nz, channels = grid.shape
    for n in range(len(points)):
        u = min(max(points[n, 0] * per_length, _ZERO), np.float32(nx - 1))
        v = min(max(points[n, 1] * per_length, _ZERO), np.float32(ny - 1))
        w = min(max(points[n, 2] * per_length, _ZERO), np.float32(nz - 1))
        i, j, k = min(int(u), nx - 2), min(int(v), ny - 2), min(int(w), nz - 2)
        u, v, w = u - np.float32(i), v - np.float32(j), w - np.float32(k)
        rows[n] = _ZERO
        for a in range(2):
            for b in range(2):
                across = (u if a else _ONE - u) * (v if b else _ONE - v)
                low, high = across * (_ONE - w), across * w
                for c in range(channels):
                    rows[n, c] += low * grid[i + a, j + b, k, c] + high * grid[i + a, j + b, k + 1, c]


@compiled(nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def sample_rows(depths: Any, edges: Any, lengths: Any, opacities: Any) -> None:
    """Sets lengths [N,K] along rays from where light comes, equally probable, and the rays' opacities [N].

    depths [N,M] are the optical depths of the intervals between edges [M+1], uniform within each. At the k-th length
    the opacity is (k + ½)/K of that at the end of the ray. All are 0 for a ray that meets nothing.
    """
    count, last = lengths.shape[1], depths.shape[1]
    for n in range(len(depths)):
        total = 0.0
        for j in range(last):
            total += depths[n, j]
        opacity = -np.expm1(-total)
        opacities[n] = opacity
        lengths[n] = 0.0
        if opacity <= 0.0:
            continue
        before, j = 0.0, 0
        for k in range(count):
            target = -np.log1p(-(k + 0.5) / count * opacity)
            while before + depths[n, j] < target and j + 1 < last:
                before += depths[n, j]
                j += 1
            share = min(max((target - before) / max(float(depths[n, j]), 1e-30), 0.0), 1.0)
            lengths[n, k] = edges[j] + share * (edges[j + 1] - edges[j])


@compiled(nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def mean_rows(positions: Any, points: Any, eyes: Any, weights: Any, frequencies: Any, first: Any, rows: Any) -> None:
    """Fills rows [N,2F] with [cosines, sines]: of x for the `first` frequencies, for the others averaged over points.

    All float32: positions and eyes [N,3] are x and ωo; points [N,K,3] on the rays; weights [N] of the averages;
    frequencies [6,F] of x and ωo, in cycles.
    """
    features, averaged = frequencies.shape[1], frequencies.shape[1] - first
    count = points.shape[1]
    a, b, c = frequencies[0, first:], frequencies[1, first:], frequencies[2, first:]
    cosine_sums, sine_sums = np.empty(averaged, np.float32), np.empty(averaged, np.float32)
    eye_cycles = np.empty(features, np.float32)
    for n in range(len(positions)):
        u, v, w = eyes[n, 0], eyes[n, 1], eyes[n, 2]
        x, y, z = positions[n, 0], positions[n, 1], positions[n, 2]
        for i in range(features):
            eye_cycles[i] = u * frequencies[3, i] + v * frequencies[4, i] + w * frequencies[5, i]
        for i in range(first):
            cycles = eye_cycles[i] + x * frequencies[0, i] + y * frequencies[1, i] + z * frequencies[2, i]
            rows[n, i], rows[n, features + i] = cos_sin(cycles)
        cosine_sums[:] = _ZERO
        sine_sums[:] = _ZERO
        weight = weights[n] / np.float32(count)
        averaged_cycles = eye_cycles[first:]
        for k in range(count if weight > _ZERO else 0):
            x, y, z = points[n, k, 0], points[n, k, 1], points[n, k, 2]
            for i in range(averaged):
                cosine, sine = cos_sin(averaged_cycles[i] + x * a[i] + y * b[i] + z * c[i])
                cosine_sums[i] += cosine
                sine_sums[i] += sine
        for i in range(averaged):
            rows[n, first + i], rows[n, features + first + i] = weight * cosine_sums[i], weight * sine_sums[i]
