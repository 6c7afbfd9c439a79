"""How a bake samples the light: sets of directions, which of them each view bin takes, and how many are enough."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, cast, get_args

import numpy as np
from numpy.typing import NDArray

from bakers.baker import Sampling
from bakers.error_estimate import choose_estimator, how_many_held
from bakers.path_traced import Walks
from bakers.projection import direction_pool
from bakers.transport import way_in
from formats.errors import QueryError
from prt_bake.mathematics import sh, sphere
from prt_bake.mathematics.random import hashed, uniforms

DirectionKind = Literal["fibonacci", "sobol", "uniform"]

DEFAULT_SAMPLES = 64
MOST_SAMPLES = 1 << 20
POOL_SIZE = 256
SMALLEST_POOL = 32
POOL_DIRECTIONS = 1 << 14
"""Most directions in a pool, as many as a network holds tables for: larger sets come in fewer copies."""
_POOL_STREAM, _BIN_STREAM, _WALK_STREAM, _HELD_STREAM = 11, 12, 13, 15


@dataclass(frozen=True)
class Resolved:
    """A sampling and what a report says about it."""

    sampling: Sampling | Walks
    directions: str
    samples: int
    """Evaluations (or walks) per bin."""
    error_estimate: str
    condition: float | None


def resolve_sampling(
    transport: Any, degree: int, bins: int, sectors: int, directions: str, samples: int, seed: int
) -> Resolved:
    """Decides how `transport` is sampled.

    `samples` directions a bin (walks, if the transport estimates coefficients itself). The default of 64 is raised to
    2K, K = (degree + 1)². The Fibonacci lattice is fitted by least squares and needs at least K directions, Sobol and
    uniform sets are summed with equal weights. Where the error comes from two half-size sets an odd number is rounded
    up. Raises QueryError on an unknown kind of directions or too few of them.
    """
    if samples < 1:
        raise QueryError(f"samples must be at least 1, found {samples}")
    if samples > MOST_SAMPLES:
        raise QueryError(f"samples: {samples:,} a bin, where at most {MOST_SAMPLES:,} are possible")
    if way_in(transport) == "coefficients":
        if samples < 2:
            raise QueryError("samples: 1 walk a bin, where at least 2 are needed for an error estimate")
        walks = Walks(degree, samples, lambda vertex: int(hashed(_WALK_STREAM, seed, vertex) >> np.uint64(1)))
        return Resolved(walks, "random walks", samples, "independent walks", None)
    if directions not in get_args(DirectionKind):
        raise QueryError(f"directions must be one of {', '.join(get_args(DirectionKind))}, found {directions!r}")
    count = sh.count(degree)
    fitted = directions == "fibonacci"
    if samples == DEFAULT_SAMPLES:
        samples = max(samples, 2 * count)
    if fitted and samples < count:
        raise QueryError(
            f"samples: degree {degree} has {count} coefficients and needs at least as many directions, "
            f"better {2 * count}; found {samples}"
        )
    estimator = choose_estimator(sectors, samples, count, fitted)
    size = -(-samples // 2) if estimator == "halves" else samples
    incident = direction_sets(cast(DirectionKind, directions), size, seed)
    pool = direction_pool(incident, sh.evaluate(incident, degree), fitted)
    taken = _taken_by_bin(bins, len(incident), seed)
    second = None if estimator == "residual" else lambda a, b: (taken(a, b) + len(incident) // 2) % len(incident)
    held = _held(bins, seed) if estimator == "neighbours" else None
    total = 2 * size if estimator == "halves" else size
    return Resolved(
        Sampling(pool, taken, second, estimator, held), directions, total, estimator, pool.condition if fitted else None
    )


def direction_sets(kind: DirectionKind, size: int, seed: int) -> NDArray[np.float64]:
    """R independent sets of `size` unit directions [R,D,3], keyed by the seed; R is 256, fewer for very large sets.

    fibonacci: one lattice, turned by rotations uniform on SO(3). sobol: independent scramblings. uniform: all
    independent.
    """
    copies = POOL_SIZE
    while copies > SMALLEST_POOL and copies * size > POOL_DIRECTIONS:
        copies //= 2
    key = int(hashed(_POOL_STREAM, seed) >> np.uint64(1))
    if kind == "fibonacci":
        return sphere.fibonacci(size) @ sphere.random_rotations(copies, key).transpose(0, 2, 1)
    if kind == "sobol":
        return np.stack([sphere.sobol(size, key + copy) for copy in range(copies)])
    return sphere.uniform(copies * size, key).reshape(copies, size, 3)


def _taken_by_bin(bins: int, copies: int, seed: int) -> Callable[[int, int], NDArray[np.int64]]:
    """Which set each bin takes: steps through the pool from a random start, with a random odd stride, for each vertex.

    The number of sets is a power of two, so that neighbouring bins never share one.
    """

    def taken(first: int, last: int) -> NDArray[np.int64]:
        vertex = np.arange(first, last)
        start = hashed(_BIN_STREAM, seed, vertex, 0) % np.uint64(copies)
        stride = hashed(_BIN_STREAM, seed, vertex, 1) % np.uint64(copies) | np.uint64(1)
        steps = np.arange(bins, dtype=np.uint64)
        return ((start[:, None] + stride[:, None] * steps) % np.uint64(copies)).astype(np.int64)

    return taken


def _held(bins: int, seed: int) -> Callable[[int, int], NDArray[np.int64]]:
    """The bins that a vertex is evaluated at twice: spread evenly, begun elsewhere at each."""
    many = how_many_held(bins)

    def held(first: int, last: int) -> NDArray[np.int64]:
        begin = uniforms((_HELD_STREAM, seed, np.arange(first, last)), 1)
        return ((np.arange(many) + begin) * (bins / many)).astype(np.int64)

    return held
