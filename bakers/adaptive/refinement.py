"""Bakes a block of vertices to a tolerance: few view bins first, finer ones where they are not foretold well enough,
and at each bin as many directions as it takes.

Level by level (`bakers.adaptive.view_levels`) the bins of the next level are foretold from those that are known. Where
those beside one came as no surprise the prediction is kept; elsewhere Ŝ is evaluated, in one of the ways of
`bakers.adaptive.records.Lattices`.

A vertex's numbers depend on itself alone: not on the cut of the blocks, nor on what is baked beside it.
"""

import numpy as np
from numpy.typing import NDArray

from bakers.adaptive.block_state import Work
from bakers.adaptive.light_components import LearnedWork
from bakers.adaptive.records import Lattices, Refined, Refinement
from bakers.adaptive.shared_lattice import SharedWork

Array = NDArray[np.float64]
Index = NDArray[np.int64]

WORKS: dict[Lattices, type[Work]] = {"own": Work, "shared": SharedWork, "learned": LearnedWork}


def refine(transport: object, refinement: Refinement, vertices: Index, positions: Array, outgoing: Array) -> Refined:
    """Bakes the vertices of these numbers [n] at positions [n,3] seen along outgoing [n,B,3].

    A vertex at which the transport answers something that is not finite has coefficients that are not finite.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        work = WORKS[refinement.lattices](transport, refinement, vertices, positions, outgoing)
        for number, level in enumerate(refinement.levels):
            work.add(number, level)
        return work.finished()
