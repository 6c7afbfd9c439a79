"""Vertices foretold from the views of their parents in one sweep: `bakers.adaptive.vertex_interpolation.turned` and
`foretold`.
"""

import numpy as np
from numpy.typing import NDArray

from bakers.adaptive.vertex_interpolation import Parents, cubic_taps
from prt_bake.jit.compilation import compiled

Array = NDArray[np.float64]


def foretold_from(
    known: NDArray[np.float32], places: NDArray[np.int64], parents: Parents, row: int
) -> tuple[Array, Array]:
    """Values [R·S,C] of the vertex in that row and their variance [R·S], its parents being known[places], known
    [G,R,S,C] over rings and sectors.
    """
    rings, sectors, width = known.shape[1:]
    steps = [cubic_taps(float(turn), sectors) for turn in parents.turn[row]]
    whole, taps = np.array([step[0] % sectors for step in steps]), np.array([step[1] for step in steps])
    values, squared = np.empty((rings, sectors * width)), np.empty((rings, sectors * width))
    fit, terms = parents.fit[row], np.ascontiguousarray(parents.terms[row])
    by_ring = known.reshape(len(known), rings, -1)
    _sweep(by_ring, places, whole * width, taps, fit, terms, parents.trust[row], width, values, squared)
    gain = (parents.weights[row] ** 2).sum() / parents.freedom[row]
    return values.reshape(-1, width), gain * squared.reshape(-1, width).mean(axis=1)


@compiled(nogil=True)
def _sweep(
    known: NDArray[np.float32],
    places: NDArray[np.int64],
    shifts: NDArray[np.int64],
    taps: Array,
    fit: Array,
    terms: Array,
    trust: Array,
    width: int,
    values: Array,
    squared: Array,
) -> None:
    """Fills in values and squared [R,S·C], ring by ring, so that what all parents have there stays at hand."""
    many, length, count = len(places), known.shape[2], terms.shape[1]
    ring = np.empty(length + 3 * width)
    seen, function, left = np.empty((many, length)), np.empty((count, length)), np.empty(length)
    for r in range(known.shape[1]):
        function[:] = 0.0
        for p in range(many):
            _turn(known[places[p], r], shifts[p], taps[p], width, ring, seen[p])
            for k in range(count):
                weight = fit[k, p]
                for i in range(length):
                    function[k, i] += weight * seen[p, i]
        values[r], squared[r] = function[0], 0.0
        for p in range(many):
            left[:] = seen[p]
            for k in range(count):
                term = terms[p, k]
                for i in range(length):
                    left[i] -= term * function[k, i]
            for i in range(length):
                squared[r, i] += trust[p] * left[i] * left[i]


@compiled(nogil=True)
def _turn(values: NDArray[np.float32], shift: int, taps: Array, width: int, ring: Array, out: Array) -> None:
    """Values [S·C] of a ring, turned. `ring` is laid out with its ends repeated, so that sums run straight through."""
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
