"""What a refined bake draws: the lattice of directions and its turns, and the bins that are checked. All keyed by the
seed, and by vertex and bin.
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
POOL_DIRECTIONS = 1 << 14
"""In all copies of a lattice: as many as a network holds tables for."""
_TURN_STREAM, _CHECK_STREAM, _POOL_STREAM, _PILOT_STREAM, _PAIR_STREAM, _COPY_STREAM = 21, 22, 23, 24, 25, 27


@cache
def lattice_for(degree: int) -> NestedLattice:
    """The lattice that coefficients to `degree` are fitted over: its sizes double from about 3K to 2¹⁴ directions.

    Raises QueryError for degrees that these do not determine.
    """
    count = sh.count(degree)
    first = max(SMALLEST_LATTICE, 1 << (3 * count - 1).bit_length())
    if first > LARGEST_LATTICE:
        raise QueryError(f"degree: {degree} has {count} coefficients, too many to be refined")
    sizes = tuple(1 << power for power in range(first.bit_length() - 1, LARGEST_LATTICE.bit_length()))
    directions = extensible_lattice(LARGEST_LATTICE)
    return nested_lattice(directions, sh.evaluate(directions, degree), sizes)


def vertex_turns(seed: int) -> Callable[[Index], NDArray[np.float64]]:
    """Vertices [n] → rotations [n,3,3], uniform on SO(3)."""
    return lambda vertices: rotations(uniforms((_TURN_STREAM, seed, vertices), 3))


def pools_for(degree: int, seed: int) -> Pools:
    """Fibonacci lattices of about 3K to 2¹⁴ directions, each √2 times the one before, in 16 to 256 copies.

    Raises QueryError for degrees that these do not determine.
    """
    first, last = lattice_for(degree).sizes[0], LARGEST_LATTICE
    steps = 2 * (last.bit_length() - first.bit_length())
    sizes = tuple(round(first * 2.0 ** (step / 2.0)) for step in range(steps + 1))

    def made(size: int) -> Pool:
        lattice = fibonacci(size)
        copies = int(np.clip(POOL_DIRECTIONS // size, *COPIES))
        turns = rotations(uniforms((_POOL_STREAM, seed, size, np.arange(copies)), 3))
        harmonics = sh.evaluate(lattice, degree)
        weights = np.asarray(np.linalg.solve(harmonics.T @ harmonics, harmonics.T), np.float64)
        return Pool(lattice, lattice @ turns.transpose(0, 2, 1), sh.rotations(turns, degree), harmonics, weights)

    def taken(vertices: Index, bins: Index, which: int) -> Index:
        return (hashed(_COPY_STREAM, seed, which, vertices, bins) >> np.uint64(1)).astype(np.int64)

    return Pools(sizes, made, taken)


def pair_turns(seed: int, size: int, which: int, bins: Index) -> NDArray[np.float64]:
    """Rotations [M,3,3] of one of the two lattices of `size` directions that a bin's noise is seen by."""
    return rotations(uniforms((_PAIR_STREAM, seed, size, which, bins), 3))


def checked_bins(seed: int, bins: int, share: float) -> Callable[[Index], NDArray[np.bool_]]:
    """Vertices [n] → bins [n,B] that are drawn, each with the probability `share`.

    They are spread evenly over the bins of each vertex and, begun elsewhere at the next, over all rings and sectors:
    errors are larger at some views than at others, and a few bins that are drawn apart may meet too few of those.
    """
    steps, first = np.arange(bins + 1) * share, uniforms((_CHECK_STREAM, seed), 1)[0]

    def chosen(vertices: Index) -> NDArray[np.bool_]:
        begin = (first + vertices * GOLDEN) % 1.0
        return np.asarray(np.diff(np.floor(begin[:, None] + steps), axis=1) > 0.0)

    return chosen


def drawn(seed: int, many: int, count: int) -> Index:
    """`count` of `many` numbers, drawn without repetition, in the order in which they are drawn."""
    return np.argsort(hashed(_PILOT_STREAM, seed, np.arange(many)), kind="stable")[:count]
