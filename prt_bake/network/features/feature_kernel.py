"""Compiled sums over a grid of learned features, and their gradients: the CPU version of `feature_grid`."""

from typing import Any

import numpy as np

from prt_bake.jit.compilation import compiled

_ONE, _ZERO = np.float32(1.0), np.float32(0.0)


@compiled(nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def _cell(row_index: Any, per_side: Any, corner: Any, point: Any) -> Any:
    """The lowest node (i, j, k) around a point, and the point's position between it and the next one on each axis."""
    nx, ny, nz = row_index.shape
    u = min(max((point[0] - corner[0]) * per_side, _ZERO), np.float32(nx - 1))
    v = min(max((point[1] - corner[1]) * per_side, _ZERO), np.float32(ny - 1))
    w = min(max((point[2] - corner[2]) * per_side, _ZERO), np.float32(nz - 1))
    i, j, k = min(int(u), nx - 2), min(int(v), ny - 2), min(int(w), nz - 2)
    return i, j, k, u - np.float32(i), v - np.float32(j), w - np.float32(k)


@compiled(nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def sum_rows(
    row_index: Any, per_side: Any, corner: Any, rows: Any, points: Any, weights: Any, sums: Any, gradient: Any
) -> None:
    """Weighted sums of trilinear features, or their gradient.

    With an empty `gradient`, sets sums [N,C] to the features of `rows` [R,C] at points [N,K,3] times weights [N,K].
    Otherwise `sums` holds the derivatives of a loss by the sums, and the gradient is added to `gradient` [R,C], except
    for row 0.
    """
    numbers, backward = sums.shape[1], len(gradient) > 0
    for n in range(len(points)):
        if not backward:
            sums[n] = _ZERO
        for m in range(points.shape[1]):
            i, j, k, u, v, w = _cell(row_index, per_side, corner, points[n, m])
            for a in range(2):
                for b in range(2):
                    for c in range(2):
                        row = row_index[i + a, j + b, k + c]
                        if row == 0:
                            continue
                        share = (u if a else _ONE - u) * (v if b else _ONE - v) * (w if c else _ONE - w)
                        share *= weights[n, m]
                        if backward:
                            for d in range(numbers):
                                gradient[row, d] += share * sums[n, d]
                        else:
                            for d in range(numbers):
                                sums[n, d] += share * rows[row, d]
