"""The walks of a query told by a few rays, whatever their number.

In a clear object a walk takes no longer than learning from the direction in which it left. What the learner wants of
the exits of P walks is sums Σ T f(ω_exit) with an f that it does not know yet, but that changes slowly with ω. The
exits are put in order along a Hilbert curve over the sphere, and K of them are drawn by systematic sampling, each as
often as the light that it carries is of the whole: one number decides all draws, so that every stretch of the curve,
which is a patch of the sphere, keeps its share. The sums keep their expectation whatever f is, and their noise is
nearly that of P rays where f is smooth at the scale of a patch. Systematic sampling: Madow 1949, "On the theory of
systematic sampling II"; the octahedral map: Engelhardt and Dachsbacher 2008.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from prt_bake.jit.compilation import compiled
from prt_bake.jit.threads import in_threads
from prt_bake.mathematics.random import uniforms

Array = NDArray[np.float64]

_STREAM = 0x7417
_LEVELS = 8
"""Of the Hilbert curve: patches of 0.6 square degrees on average."""


def resampled(directions: Array, carried: Array, kept: int, seed: int, keys: NDArray[Any]) -> tuple[Array, Array]:
    """Directions and what they carry [N,K,3] of `kept` rays in place of those [N,P,3] of P walks; means over them have
    the walks' means as expectation.

    Each query's draw depends on the seed, its key [N] and its walks alone. A channel carries at most three times what
    the brightest walk of its query carries. Of a query with a walk that is not finite all rays are that walk: the
    learner must stop at it.
    """
    drawn, drawn_carry = np.zeros((2, len(carried), kept, 3))
    drawn[..., 2] = 1.0
    offsets = uniforms((_STREAM, seed, keys), 1)[:, 0]
    in_threads(resample_rows, len(carried), directions, carried, offsets, drawn, drawn_carry, least=16)
    return drawn, drawn_carry


@compiled(nogil=True)
def resample_rows(
    begun: Any, ended: Any, directions: Any, carried: Any, offsets: Any, drawn: Any, throughput: Any
) -> None:
    """Fill rows of drawn and throughput [N,K,3] from directions and what they carry [N,P,3]; offsets [N] in [0, 1).

    Queries that carry nothing are left as they are; a walk that is not finite is all that is drawn of its query.
    """
    walks, kept = carried.shape[1], drawn.shape[1]
    for n in range(begun, ended):
        place, light = np.empty(walks, np.int64), np.empty(walks)
        for p in range(walks):
            place[p] = hilbert_index(directions[n, p, 0], directions[n, p, 1], directions[n, p, 2])
            light[p] = (carried[n, p, 0] + carried[n, p, 1] + carried[n, p, 2]) / 3.0
        whole = light.sum()
        if not np.isfinite(whole):
            for p in range(walks):
                if not np.isfinite(light[p]):
                    for k in range(kept):
                        _take(directions[n, p], carried[n, p], 1.0, drawn[n, k], throughput[n, k])
        elif whole > 0.0:
            order, reached, k = np.argsort(place, kind="mergesort"), 0.0, 0
            for p in order:
                reached += light[p]
                while k < kept and (offsets[n] + k) * whole < reached * kept:
                    _take(directions[n, p], carried[n, p], whole / (walks * light[p]), drawn[n, k], throughput[n, k])
                    k += 1


@compiled(nogil=True)
def _take(direction: Any, carried: Any, scale: Any, drawn: Any, throughput: Any) -> None:
    for c in range(3):
        drawn[c], throughput[c] = direction[c], carried[c] * scale


@compiled(nogil=True)
def hilbert_index(x: Any, y: Any, z: Any) -> Any:
    """How far along a Hilbert curve over the sphere a unit vector lies: an integer below 4**8."""
    reach = abs(x) + abs(y) + abs(z)
    u, v = x / reach, y / reach
    if z < 0.0:
        u, v = np.copysign(1.0 - abs(v), u), np.copysign(1.0 - abs(u), v)
    side = 1 << _LEVELS
    i, j = min(int((0.5 + 0.5 * u) * side), side - 1), min(int((0.5 + 0.5 * v) * side), side - 1)
    place, half = 0, side >> 1
    while half:
        right, up = int(i & half != 0), int(j & half != 0)
        place += half * half * ((3 * right) ^ up)
        if not up:
            if right:
                i, j = side - 1 - i, side - 1 - j
            i, j = j, i
        half >>= 1
    return place
