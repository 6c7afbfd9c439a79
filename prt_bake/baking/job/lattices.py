"""Random choices of an adaptive bake: rotations of the direction lattices, and validation bins. All are counter-based,
keyed by the seed, the vertex and the bin.
"""

from collections.abc import Callable
from functools import cache

import numpy as np
from numpy.typing import NDArray

from bakers.adaptive.lattice_pools import Pool, Pools
from bakers.adaptive.nested_lattice import NestedLattice, nested_lattice
from formats.errors import QueryError
from prt_bake.mathematics import sh
from prt_bake.mathematics.directions import LARGEST_LATTICE, extensible_lattice, fibonacci, rotations
from prt_bake.mathematics.random import hashed, uniforms

Index = NDArray[np.int64]

SMALLEST_LATTICE = 16
COPIES = 16, 256
GOLDEN = (np.sqrt(5.0) - 1.0) / 2.0
_AT_ONCE = 1 << 20
POOL_DIRECTIONS = 1 << 14
"""Directions in all copies of a lattice together, as many as a network holds tables for."""
_TURN_STREAM, _VALIDATION_STREAM, _POOL_STREAM, _PILOT_STREAM, _PAIR_STREAM, _COPY_STREAM = 21, 22, 23, 24, 25, 27


@cache
def lattice_for(degree: int) -> NestedLattice:
    """The lattice for least-squares fits to `degree`; its sizes double from about 3K to 2¹⁴ directions.

    Raises QueryError for degrees that need more directions.
    """
    count = sh.count(degree)
    first = max(SMALLEST_LATTICE, 1 << (3 * count - 1).bit_length())
    if first > LARGEST_LATTICE:
        raise QueryError(
            f"degree: {degree} has {count} coefficients, too many for a bake to an error; lower the degree"
        )
    sizes = tuple(1 << power for power in range(first.bit_length() - 1, LARGEST_LATTICE.bit_length()))
    directions = extensible_lattice(LARGEST_LATTICE)
    return nested_lattice(directions, sh.evaluate(directions, degree), sizes)


def vertex_rotations(seed: int) -> Callable[[Index], NDArray[np.float64]]:
    """Vertices [n] → rotations [n,3,3], uniform on SO(3)."""
    return lambda vertices: rotations(uniforms((_TURN_STREAM, seed, vertices), 3))


def pools_for(degree: int, seed: int) -> Pools:
    """Fibonacci lattices of about 3K to 2¹⁴ directions, each √2 times as large as the one before, in 16 to 256 rotated
    copies. Raises QueryError for degrees that need more directions.
    """
    first, last = lattice_for(degree).sizes[0], LARGEST_LATTICE
    steps = 2 * (last.bit_length() - first.bit_length())
    sizes = tuple(round(first * 2.0 ** (step / 2.0)) for step in range(steps + 1))

    def make_pool(size: int) -> Pool:
        lattice = fibonacci(size)
        copies = int(np.clip(POOL_DIRECTIONS // size, *COPIES))
        turns = rotations(uniforms((_POOL_STREAM, seed, size, np.arange(copies)), 3))
        harmonics = sh.evaluate(lattice, degree)
        weights = np.asarray(np.linalg.solve(harmonics.T @ harmonics, harmonics.T), np.float64)
        return Pool(lattice, lattice @ turns.transpose(0, 2, 1), sh.rotations(turns, degree), harmonics, weights)

    def copy_of_bin(vertices: Index, bins: Index, which: int) -> Index:
        return (hashed(_COPY_STREAM, seed, which, vertices, bins) >> np.uint64(1)).astype(np.int64)

    return Pools(sizes, make_pool, copy_of_bin)


def pair_rotations(seed: int, size: int, which: int, bins: Index) -> NDArray[np.float64]:
    """Rotations [M,3,3] of one of the two lattices of `size` directions whose difference measures a bin's noise."""
    return rotations(uniforms((_PAIR_STREAM, seed, size, which, bins), 3))


def validation_bins(seed: int, bins: int, share: float) -> Callable[[Index], NDArray[np.bool_]]:
    """Vertices [n] → mask [n,B] of validation bins, each chosen with the probability `share`.

    Systematic sampling: the bins are evenly spaced at each vertex, and the offset changes from vertex to vertex by the
    golden ratio. Independent draws could miss the views where errors are large.
    """
    steps, first = np.arange(bins + 1) * share, uniforms((_VALIDATION_STREAM, seed), 1)[0]

    def chosen(vertices: Index) -> NDArray[np.bool_]:
        offset = (first + vertices * GOLDEN) % 1.0
        return np.asarray(np.diff(np.floor(offset[:, None] + steps), axis=1) > 0.0)

    return chosen


def sample_without_replacement(seed: int, many: int, count: int) -> Index:
    """`count` of the numbers 0 … many − 1, drawn without replacement, in the order drawn: those of the least hashes.

    Draws from 2²⁰ numbers at once, since the bins of a fine mesh are too many to sort.
    """
    drawn, keys = np.zeros(0, np.int64), np.zeros(0, np.uint64)
    for first in range(0, many, max(_AT_ONCE, count)):
        numbers = np.arange(first, min(first + max(_AT_ONCE, count), many))
        drawn, keys = np.append(drawn, numbers), np.append(keys, hashed(_PILOT_STREAM, seed, numbers))
        if len(drawn) > count:
            least = np.argpartition(keys, count)[:count]
            drawn, keys = drawn[least], keys[least]
    return drawn[np.argsort(keys)]
