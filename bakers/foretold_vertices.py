"""Vertices that were foretold from those around them, held against the transport."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bakers.refined import WAYS, Checks, Refinement
from bakers.refinement import Work

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
    squared errors [n,m], mean over K and channels, over the mean square of the vertex, less what of that is noise of
    the directions that they are held against; and evaluations.
    """
    work = _foretold(transport, refinement, vertices, positions, outgoing, coefficients)
    rows = np.repeat(np.arange(len(bins)), bins.shape[1])
    where = bins.ravel(), rows
    work.integrate(rows, where[0], refinement.checked**2 * work.scale[rows])
    own = work.coefficients[where].reshape(len(rows), -1, 3)
    left = work.turn[rows] @ own - coefficients[rows, where[0]]
    squared = (left**2).mean(axis=(1, 2)) - work.noise[where]
    return (squared / work.scale[rows]).reshape(bins.shape), work.evaluations


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
    _found, work.rough[bins, rows] = work.fit_alone(rows, bins, np.full(len(rows), work.fewest), 1)
    begun = work.evaluations
    checks = work.check(variance, coefficients)
    way = np.full(len(checks.rows), WAYS.index("nearby"), np.uint8)
    return replace(checks, way=way, evaluations=checks.evaluations + begun)


def _foretold(
    transport: object, refinement: Refinement, vertices: Index, positions: Array, outgoing: Array, coefficients: Array
) -> Work:
    work = Work(transport, replace(refinement, lattices="own"), vertices, positions, outgoing)
    work.scale = np.maximum((coefficients**2).mean(axis=(1, 2, 3)), refinement.floor**2)
    return work
