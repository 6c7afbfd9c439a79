"""Refines a block of vertices to a tolerance, level by level of view bins (`bakers.adaptive.view_levels`).

Each level's bins are interpolated from the coarser levels. A bin keeps its interpolated coefficients if the prediction
error near it was small; otherwise Ŝ is evaluated with as many directions as the tolerance requires, by one of the
methods in `bakers.adaptive.records.Lattices`.

A vertex's numbers depend on the vertex alone, not on the block boundaries.
"""

import numpy as np
from numpy.typing import NDArray

from bakers.adaptive.block_state import BlockState
from bakers.adaptive.light_components import LightComponentState
from bakers.adaptive.records import Lattices, RefinedBlock, RefinementSettings
from bakers.adaptive.shared_lattice import SharedLatticeState

Array = NDArray[np.float64]
Index = NDArray[np.int64]

STATES: dict[Lattices, type[BlockState]] = {
    "own": BlockState,
    "shared": SharedLatticeState,
    "learned": LightComponentState,
}


def refine(
    transport: object, settings: RefinementSettings, vertices: Index, positions: Array, outgoing: Array
) -> RefinedBlock:
    """Bakes the vertices [n] at positions [n,3] seen along outgoing [n,B,3].

    A vertex with values of Ŝ that are not finite has coefficients that are not finite.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        state = STATES[settings.lattices](transport, settings, vertices, positions, outgoing)
        for number, level in enumerate(settings.levels):
            state.add_level(number, level)
        return state.result()
