"""Vertices that were foretold from those around them, held against the transport."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bakers.adaptive.block_state import Work
from bakers.adaptive.evaluation_cache import NOTHING
from bakers.adaptive.records import WAYS, Checks, Refinement

Array = NDArray[np.float64]
Index = NDArray[np.int64]


def held_against(
    transport: object,
    refinement: Refinement,
    vertices: Index,
    positions: Array,
    outgoing: Array,
    coefficients: Array,
    bins: Index,
) -> tuple[Array, int]:
    """What vertices are off by that were foretold from those around them, coefficients [n,B,K,3], at these bins [n,m]:
    squared errors [n,m], mean over K and channels, over the mean square of the vertex, without bias for the noise of
    the directions that they are held against, and so at times negative; and evaluations.
    """
    work = _foretold(transport, refinement, vertices, positions, outgoing, coefficients)
    rows = np.repeat(np.arange(len(bins)), bins.shape[1])
    _look(work, rows, bins.ravel())
    one, other = work.held(rows, bins.ravel(), coefficients)
    squared = (one * other).mean(axis=(1, 2)) / work.scale[rows]
    return squared.reshape(bins.shape), work.evaluations


def checked(
    transport: object,
    refinement: Refinement,
    vertices: Index,
    positions: Array,
    outgoing: Array,
    coefficients: Array,
    variance: Array,
) -> Checks:
    """Some bins of vertices that were foretold from those around them, coefficients [n,B,K,3] of that variance [n,B],
    held against independent directions, as those are that `refine` evaluates.
    """
    work = _foretold(transport, refinement, vertices, positions, outgoing, coefficients)
    rows, bins = np.nonzero(refinement.checks(vertices))
    _look(work, rows, bins)
    begun = work.evaluations
    checks = work.check(variance, coefficients)
    way = np.full(len(checks.rows), WAYS.index("nearby"), np.uint8)
    return replace(checks, way=way, evaluations=checks.evaluations + begun)


def _look(work: Work, rows: Index, bins: Index) -> None:
    """Sees how rough Ŝ is at these bins."""
    work.rough[bins, rows] = work.fit_alone(rows, bins, np.full(len(rows), work.fewest), 1).rough


def _foretold(
    transport: object, refinement: Refinement, vertices: Index, positions: Array, outgoing: Array, coefficients: Array
) -> Work:
    work = Work(transport, replace(refinement, lattices="own", answers=NOTHING), vertices, positions, outgoing)
    work.scale = np.maximum((coefficients**2).mean(axis=(1, 2, 3)), refinement.floor**2)
    return work
