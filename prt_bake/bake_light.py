"""What a refined bake draws: the lattice of directions and its turns, and the bins that are checked. All keyed by the
seed, and by vertex and bin.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from bakers.nested_lattice import NestedLattice, nested_lattice
from formats.errors import QueryError
from prt_bake import sh
from prt_bake.directions import LARGEST_LATTICE, extensible_lattice, rotations
from prt_bake.randomness import hashed, uniforms

Index = NDArray[np.int64]

SMALLEST_LATTICE = 16
_TURN_STREAM, _CHECK_STREAM, _CHECK_TURN_STREAM, _PILOT_STREAM, _PAIR_STREAM = 21, 22, 23, 24, 25


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


def bin_turns(seed: int) -> Callable[[Index, Index, int], NDArray[np.float64]]:
    """(vertices [M], bins [M], which of two) → rotations [M,3,3], independent of the vertices' own."""
    return lambda vertices, bins, which: rotations(uniforms((_CHECK_TURN_STREAM, seed, which, vertices, bins), 3))


def pair_turns(seed: int, size: int, which: int, bins: Index) -> NDArray[np.float64]:
    """Rotations [M,3,3] of one of the two lattices of `size` directions that a bin's noise is seen by."""
    return rotations(uniforms((_PAIR_STREAM, seed, size, which, bins), 3))


def checked_bins(seed: int, bins: int, share: float) -> Callable[[Index], NDArray[np.bool_]]:
    """Vertices [n] → bins [n,B] that are drawn, each with the probability `share`."""
    limit = np.uint64(min(int(share * 2.0**64), 2**64 - 1))
    return lambda vertices: hashed(_CHECK_STREAM, seed, vertices[:, None], np.arange(bins)) < limit


def drawn(seed: int, many: int, count: int) -> Index:
    """`count` of `many` numbers, drawn without repetition, in the order in which they are drawn."""
    return np.argsort(hashed(_PILOT_STREAM, seed, np.arange(many)), kind="stable")[:count]
