"""Kernel for the interpolation of vertices (`bakers.adaptive.vertex_interpolation`)."""

import numpy as np
from numpy.typing import NDArray

from bakers.adaptive.vertex_interpolation import Parents, cubic_taps
from prt_bake.jit.compilation import compiled

Array = NDArray[np.float64]


def interpolated_from(
    known: NDArray[np.float32], indices: NDArray[np.int64], parents: Parents, row: int
) -> tuple[Array, Array]:
    """Interpolated values [R·S,C] of the vertex in that row of `parents`, and their variance [R·S], mean over C.

    The variance is estimated from the residuals of the fit: the parents' noise, and what is not quadratic about them.
    known: [G,R,S,C] over rings and sectors. indices: [P] of the vertex's parents in `known`.
    """
    rings, sectors, width = known.shape[1:]
    steps = [cubic_taps(float(turn), sectors) for turn in parents.azimuth_shifts[row]]
    shifts, taps = np.array([step[0] % sectors for step in steps]), np.array([step[1] for step in steps])
    values, squared = np.empty((rings, sectors * width)), np.empty((rings, sectors * width))
    fit, terms = parents.fit[row], np.ascontiguousarray(parents.terms[row])
    by_ring = known.reshape(len(known), rings, -1)
    _interpolate_rings(
        by_ring, indices, shifts * width, taps, fit, terms, parents.fit_weights[row], width, values, squared
    )
    gain = (parents.weights[row] ** 2).sum() / parents.residual_freedom[row]
    return values.reshape(-1, width), gain * squared.reshape(-1, width).mean(axis=1)


@compiled(nogil=True)
def _interpolate_rings(
    known: NDArray[np.float32],
    indices: NDArray[np.int64],
    shifts: NDArray[np.int64],
    taps: Array,
    fit: Array,
    terms: Array,
    fit_weights: Array,
    width: int,
    values: Array,
    squared: Array,
) -> None:
    """Fills values and squared residuals [R,S·C], ring by ring, so that the values of all parents stay in the cache."""
    many, length, count = len(indices), known.shape[2], terms.shape[1]
    ring = np.empty(length + 3 * width)
    rotated, function, residual = np.empty((many, length)), np.empty((count, length)), np.empty(length)
    for r in range(known.shape[1]):
        function[:] = 0.0
        for p in range(many):
            _rotate(known[indices[p], r], shifts[p], taps[p], width, ring, rotated[p])
            for k in range(count):
                weight = fit[k, p]
                for i in range(length):
                    function[k, i] += weight * rotated[p, i]
        values[r], squared[r] = function[0], 0.0
        for p in range(many):
            residual[:] = rotated[p]
            for k in range(count):
                term = terms[p, k]
                for i in range(length):
                    residual[i] -= term * function[k, i]
            for i in range(length):
                squared[r, i] += fit_weights[p] * residual[i] * residual[i]


@compiled(nogil=True)
def _rotate(values: NDArray[np.float32], shift: int, taps: Array, width: int, ring: Array, out: Array) -> None:
    """Rotates the values [S·C] of a ring by cubic interpolation. `ring` repeats its ends, so that sums need no wrap."""
    length, done = len(values), 0
    start = (shift - width) % length
    while done < len(ring):
        many = min(length - start, len(ring) - done)
        ring[done : done + many] = values[start : start + many]
        done += many
        start = (start + many) % length
    a, b, c, d = taps
    one, two, three = ring[width:], ring[2 * width :], ring[3 * width :]
    for i in range(length):
        out[i] = a * ring[i] + b * one[i] + c * two[i] + d * three[i]
