"""How a bake samples the light: sets of directions, which set each view bin uses, and how many directions suffice."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, cast, get_args

import numpy as np
from numpy.typing import NDArray

from bakers.baker import Sampling
from bakers.error_estimate import choose_estimator, validation_bin_count
from bakers.path_traced import Walks
from bakers.projection import direction_pool
from bakers.transport import transport_kind
from formats.errors import QueryError
from prt_bake.mathematics import sh, sphere
from prt_bake.mathematics.random import hashed, uniforms

DirectionKind = Literal["fibonacci", "sobol", "uniform"]

MOST_SAMPLES = 1 << 20
POOL_SIZE = 256
SMALLEST_POOL = 32
POOL_DIRECTIONS = 1 << 14
"""Most directions in a pool, as many as a network holds tables for; larger sets have fewer copies."""
_POOL_STREAM, _BIN_STREAM, _WALK_STREAM, _TWICE_STREAM = 11, 12, 13, 15


@dataclass(frozen=True)
class Resolved:
    """A sampling, and its description for reports."""

    sampling: Sampling | Walks
    directions: str
    samples: int
    """Evaluations (or walks) per bin."""
    error_estimate: str
    condition: float | None


def resolve_sampling(
    transport: Any, degree: int, bins: int, sectors: int, directions: str, samples: int, seed: int
) -> Resolved:
    """Chooses the sampling of `transport`: `samples` directions per bin, or random walks if it estimates coefficients.

    The Fibonacci lattice is fitted by least squares and needs at least K = (degree + 1)² directions; Sobol and uniform
    sets are summed with equal weights. An odd number is rounded up if the error is estimated from two half-size sets.
    Raises QueryError on an unknown kind of directions or too few of them.
    """
    if samples < 1:
        raise QueryError(f"samples must be at least 1, found {samples}")
    if samples > MOST_SAMPLES:
        raise QueryError(f"samples must be at most {MOST_SAMPLES:,} a bin, found {samples:,}")
    if transport_kind(transport) == "coefficients":
        if samples < 2:
            raise QueryError("samples must be at least 2 paths a bin, for an error estimate, found 1")
        walks = Walks(degree, samples, lambda vertex: int(hashed(_WALK_STREAM, seed, vertex) >> np.uint64(1)))
        return Resolved(walks, "random walks", samples, "independent walks", None)
    if directions not in get_args(DirectionKind):
        raise QueryError(f"directions must be one of {', '.join(get_args(DirectionKind))}, found {directions!r}")
    count = sh.count(degree)
    fitted = directions == "fibonacci"
    if fitted and samples < count:
        raise QueryError(
            f"samples: degree {degree} has {count} coefficients and needs as many directions, found {samples}; "
            f"give {2 * count} or more, or another kind of directions"
        )
    estimator = choose_estimator(sectors, samples, count, fitted)
    size = -(-samples // 2) if estimator == "halves" else samples
    incident = direction_sets(cast(DirectionKind, directions), size, seed)
    pool = direction_pool(incident, sh.evaluate(incident, degree), fitted)
    sets = _sets_of_bins(bins, len(incident), seed)
    second = None if estimator == "residual" else lambda a, b: (sets(a, b) + len(incident) // 2) % len(incident)
    twice = _evaluated_twice(bins, seed) if estimator == "neighbours" else None
    total = 2 * size if estimator == "halves" else size
    return Resolved(
        Sampling(pool, sets, second, estimator, twice), directions, total, estimator, pool.condition if fitted else None
    )


def direction_sets(kind: DirectionKind, size: int, seed: int) -> NDArray[np.float64]:
    """R independent sets of `size` unit directions [R,D,3], keyed by the seed; R is 256, less for very large sets.

    fibonacci: one lattice under rotations uniform on SO(3). sobol: independent scramblings. uniform: independent
    points.
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


def _sets_of_bins(bins: int, copies: int, seed: int) -> Callable[[int, int], NDArray[np.int64]]:
    """The set of each bin: a walk through the pool from a random start with a random odd stride, for each vertex.

    The number of sets is a power of two, so neighbouring bins never share one.
    """

    def sets(first: int, last: int) -> NDArray[np.int64]:
        vertex = np.arange(first, last)
        start = hashed(_BIN_STREAM, seed, vertex, 0) % np.uint64(copies)
        stride = hashed(_BIN_STREAM, seed, vertex, 1) % np.uint64(copies) | np.uint64(1)
        steps = np.arange(bins, dtype=np.uint64)
        return ((start[:, None] + stride[:, None] * steps) % np.uint64(copies)).astype(np.int64)

    return sets


def _evaluated_twice(bins: int, seed: int) -> Callable[[int, int], NDArray[np.int64]]:
    """The bins at which a vertex is evaluated twice: evenly spaced, with a random offset for each vertex."""
    count = validation_bin_count(bins)

    def twice(first: int, last: int) -> NDArray[np.int64]:
        offset = uniforms((_TWICE_STREAM, seed, np.arange(first, last)), 1)
        return ((np.arange(count) + offset) * (bins / count)).astype(np.int64)

    return twice
