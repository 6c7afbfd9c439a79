"""Features of views, compiled: what `prt_bake.view_features` computes with tensors, several times as fast on a CPU."""

from typing import Any

import numpy as np

from prt_bake.compilation import compiled
from prt_bake.pair_kernel import turned

_ONE = np.float32(1.0)
_ZERO = np.float32(0.0)


@compiled(nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def distance_at(levels: Any, per_length: Any, x: Any, y: Any, z: Any) -> Any:
    """The grid's value at a point in lengths from its corner, linear between places; outside, that of its border."""
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
def distance_rows(levels: Any, per_length: Any, points: Any, backs: Any, along: Any, distances: Any) -> None:
    """Set distances [N,K] to the grid's values at points[n] − along[k]·backs[n], points from the grid's corner."""
    for n in range(len(points)):
        for k in range(len(along)):
            s = along[k]
            distances[n, k] = distance_at(
                levels,
                per_length,
                points[n, 0] - s * backs[n, 0],
                points[n, 1] - s * backs[n, 1],
                points[n, 2] - s * backs[n, 2],
            )


@compiled(nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def place_rows(depths: Any, edges: Any, places: Any, opacities: Any) -> None:
    """Set places [N,K] to where light comes from along rays, all equally likely, and opacities [N].

    depths [N,M]: the optical depth of each interval between edges [M+1], even within; the k-th place is where the
    opacity reaches (k + ½)/K of what it is at the end of the ray; all are 0 where nothing is met.
    """
    count, last = places.shape[1], depths.shape[1]
    for n in range(len(depths)):
        whole = 0.0
        for j in range(last):
            whole += depths[n, j]
        opacity = -np.expm1(-whole)
        opacities[n] = opacity
        places[n] = 0.0
        if opacity <= 0.0:
            continue
        before, j = 0.0, 0
        for k in range(count):
            wanted = -np.log1p(-(k + 0.5) / count * opacity)
            while before + depths[n, j] < wanted and j + 1 < last:
                before += depths[n, j]
                j += 1
            share = min(max((wanted - before) / max(float(depths[n, j]), 1e-30), 0.0), 1.0)
            places[n, k] = edges[j] + share * (edges[j + 1] - edges[j])


@compiled(nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def mean_rows(
    starts: Any, backs: Any, eyes: Any, places: Any, weights: Any, frequencies: Any, own: Any, rows: Any
) -> None:
    """Fill the first 2F columns of rows with [cosines, sines]: of the first `own` frequencies at x itself, of the
    others averaged over places along rays, times their weight.

    starts, backs, eyes [N,3] float32: x, the ray's direction (it runs along −back) and ωo; places [N,K] and weights [N]
    float32; frequencies [6,F] float32, of x and of ωo, in cycles.
    """
    features, averaged = frequencies.shape[1], frequencies.shape[1] - own
    count = places.shape[1]
    a, b, c = frequencies[0, own:], frequencies[1, own:], frequencies[2, own:]
    cosine_sums, sine_sums = np.empty(averaged, np.float32), np.empty(averaged, np.float32)
    begun = np.empty(features, np.float32)
    for n in range(len(starts)):
        u, v, w = eyes[n, 0], eyes[n, 1], eyes[n, 2]
        x, y, z = starts[n, 0], starts[n, 1], starts[n, 2]
        for i in range(features):
            begun[i] = x * frequencies[0, i] + y * frequencies[1, i] + z * frequencies[2, i]
            begun[i] += u * frequencies[3, i] + v * frequencies[4, i] + w * frequencies[5, i]
        for i in range(own):
            rows[n, i], rows[n, features + i] = turned(begun[i])
        cosine_sums[:] = _ZERO
        sine_sums[:] = _ZERO
        weight = weights[n] / np.float32(count)
        here = begun[own:]
        for k in range(count if weight > _ZERO else 0):
            x, y, z = -places[n, k] * backs[n, 0], -places[n, k] * backs[n, 1], -places[n, k] * backs[n, 2]
            for i in range(averaged):
                cosine, sine = turned(here[i] + x * a[i] + y * b[i] + z * c[i])
                cosine_sums[i] += cosine
                sine_sums[i] += sine
        for i in range(averaged):
            rows[n, own + i], rows[n, features + own + i] = weight * cosine_sums[i], weight * sine_sums[i]
