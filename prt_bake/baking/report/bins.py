"""View bins at which methods are compared with a reference: one complete ring at each of a few vertices."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bakers.evaluation import values_at
from formats.mesh import Mesh
from prt_bake.baking.job.lattices import sample_without_replacement
from prt_bake.baking.job.views import views_of
from prt_bake.mathematics import sh, sphere
from prt_bake.mathematics.directions import rotations
from prt_bake.mathematics.random import uniforms

Array = NDArray[np.float64]
Index = NDArray[np.int64]

VALUES_AT_ONCE = 1 << 21
_REFERENCE_STREAM = 31


@dataclass(frozen=True)
class Bins:
    """n vertices, the bins [n,b] of one ring of each, and their directions `outgoing` [n,b,3]."""

    mesh: Mesh
    vertices: Index
    bins: Index
    outgoing: Array
    rings: int
    sectors: int
    degree: int

    @property
    def count(self) -> int:
        """Number of bins, n·b."""
        return self.bins.size


def drawn_bins(mesh: Mesh, rings: int, sectors: int, degree: int, vertices: int, seed: int) -> Bins:
    """One ring at each of `vertices` random vertices; all rings are equally frequent."""
    chosen = sample_without_replacement(seed, len(mesh.positions), min(vertices, len(mesh.positions)))
    ring = np.arange(len(chosen)) * rings // len(chosen)
    bins = ring[:, None] * sectors + np.arange(sectors)
    outgoing = np.take_along_axis(views_of(mesh, rings, sectors)(chosen)[0], bins[..., None], axis=1)
    return Bins(mesh, chosen, bins, outgoing, rings, sectors, degree)


def fitted(transport: Any, positions: Array, outgoing: Array, degree: int, directions: int, seed: int) -> Array:
    """Coefficients [N,K,3] at positions [N,3] along outgoing [N,3], by least squares over a Fibonacci lattice with its
    own random rotation for each.
    """
    lattice = sphere.fibonacci(directions)
    y = sh.evaluate(lattice, degree)
    fit = np.linalg.solve(y.T @ y, y.T)
    found = np.empty((len(positions), sh.count(degree), 3))
    step = max(1, VALUES_AT_ONCE // directions)
    for first in range(0, len(positions), step):
        some = slice(first, min(first + step, len(positions)))
        turns = rotations(uniforms((_REFERENCE_STREAM, seed, np.arange(some.start, some.stop)), 3))
        rows = np.arange(some.stop - some.start)
        values = values_at(transport, lattice @ turns.transpose(0, 2, 1), rows, positions[some], outgoing[some])
        found[some] = sh.rotations(turns, degree) @ (fit @ values.astype(np.float64))
    return found


def relative(difference: Array, reference: Array) -> float:
    """The root of Σ difference² over Σ reference²; 0 without a signal."""
    signal = float((reference**2).sum())
    return float(np.sqrt((difference**2).sum() / signal)) if signal > 0.0 else 0.0
