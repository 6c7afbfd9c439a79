"""Systematic resampling of a query's exits: K rays represent those of P walks.

In a clear object tracing a walk costs no more than learning from its exit. The learner needs sums Σ T f(ω_exit) over
the exits of P walks, for an f that is unknown but varies slowly with ω. The exits are sorted along a Hilbert curve over
the sphere, and K of them are drawn by systematic sampling with probabilities proportional to their throughput. A single
random number decides all draws, so every stretch of the curve, a patch of the sphere, keeps its share of the light. The
sums are unbiased for any f, and their noise is close to that of all P exits where f is smooth at the scale of a patch.

Systematic sampling: Madow 1949, "On the theory of systematic sampling II". Octahedral map: Engelhardt and Dachsbacher
2008, "Octahedron environment maps".
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prt_bake.jit.compilation import compiled
from prt_bake.jit.threads import in_threads
from prt_bake.mathematics.random import uniforms

Array = NDArray[np.float64]

_STREAM = 0x7417
_LEVELS = 8
"""Levels of the Hilbert curve: its patches have 0.6 square degrees on average."""


def resampled(directions: Array, throughput: Array, kept: int, seed: int, keys: NDArray[Any]) -> tuple[Array, Array]:
    """Directions and throughput [N,K,3] of K = `kept` rays that represent those [N,P,3] of P walks.

    Means over the rays are unbiased estimates of means over the walks. A query's draws depend on the seed, its key [N]
    and its walks alone. No channel of a ray exceeds three times the throughput of its query's brightest walk. If a walk
    is not finite, all rays of its query are that walk, so that the learner stops at it.
    """
    rays = np.zeros((2, len(throughput), kept, 3))
    rays[0, ..., 2] = 1.0
    offsets = resampling_offsets(seed, keys)
    in_threads(resample_rows, len(throughput), directions, throughput, offsets, rays[0], rays[1], least=16)
    return rays[0], rays[1]


def resampling_offsets(seed: int, keys: NDArray[Any]) -> Array:
    """The random number [N] in [0, 1) that decides all draws of each query."""
    return np.asarray(uniforms((_STREAM, seed, keys), 1)[:, 0])


@compiled(nogil=True)
def resample_rows(
    begun: Any, ended: Any, directions: Any, throughput: Any, offsets: Any, kept_directions: Any, kept_throughput: Any
) -> None:
    """Fill queries begun … ended − 1 of the kept rays [N,K,3] from the walks [N,P,3], with offsets [N] in [0, 1).

    Queries whose walks carry no light are left as they are.
    """
    walks, kept = throughput.shape[1], kept_directions.shape[1]
    for n in range(begun, ended):
        index, light = np.empty(walks, np.int64), np.empty(walks)
        for p in range(walks):
            index[p] = hilbert_index(directions[n, p, 0], directions[n, p, 1], directions[n, p, 2])
            light[p] = (throughput[n, p, 0] + throughput[n, p, 1] + throughput[n, p, 2]) / 3.0
        total = light.sum()
        if not np.isfinite(total):
            for p in range(walks):
                if not np.isfinite(light[p]):
                    for k in range(kept):
                        _copy(directions[n, p], throughput[n, p], 1.0, kept_directions[n, k], kept_throughput[n, k])
        elif total > 0.0:
            order, cumulative, k = np.argsort(index, kind="mergesort"), 0.0, 0
            for p in order:
                cumulative += light[p]
                while k < kept and (offsets[n] + k) * total < cumulative * kept:
                    scale = total / (walks * light[p])
                    _copy(directions[n, p], throughput[n, p], scale, kept_directions[n, k], kept_throughput[n, k])
                    k += 1


@compiled(nogil=True)
def _copy(direction: Any, throughput: Any, scale: Any, kept_direction: Any, kept_throughput: Any) -> None:
    for c in range(3):
        kept_direction[c], kept_throughput[c] = direction[c], throughput[c] * scale


@compiled(nogil=True)
def hilbert_index(x: Any, y: Any, z: Any) -> Any:
    """Position of a unit vector along a Hilbert curve over the sphere, an integer below 4**8."""
    reach = abs(x) + abs(y) + abs(z)
    u, v = x / reach, y / reach
    if z < 0.0:
        u, v = math.copysign(1.0 - abs(v), u), math.copysign(1.0 - abs(u), v)
    side = 1 << _LEVELS
    i, j = min(int((0.5 + 0.5 * u) * side), side - 1), min(int((0.5 + 0.5 * v) * side), side - 1)
    index, half = 0, side >> 1
    while half:
        right, up = int(i & half != 0), int(j & half != 0)
        index += half * half * ((3 * right) ^ up)
        if not up:
            if right:
                i, j = side - 1 - i, side - 1 - j
            i, j = j, i
        half >>= 1
    return index
