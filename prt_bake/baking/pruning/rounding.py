"""What the precision of a transport's arithmetic adds to the error of a bake: measured, not assumed."""

from typing import Any

import numpy as np

from bakers.evaluation import values_at
from formats.mesh import Mesh
from prt_bake.baking.job.lattices import drawn
from prt_bake.baking.job.views import Views
from prt_bake.mathematics import sh, sphere
from prt_bake.mathematics.directions import rotations
from prt_bake.mathematics.random import uniforms

BINS, DIRECTIONS = 256, 64
_ROUNDING_STREAM = 33


def rounding_of(transport: Any, mesh: Mesh, views: Views, bins: int, degree: int, seed: int) -> tuple[float, int]:
    """Relative RMSE of the coefficients that a transport in half precision adds, and the evaluations that it took.

    Bins drawn by the seed, of `bins` at each vertex, are projected in the same directions by the transport and by its
    twin in float32. 0 without any work for transports that are exact, or say nothing of it.
    """
    if not hasattr(transport, "exact") or transport.precision == "float32":
        return 0.0, 0
    chosen = drawn(seed + 4, len(mesh.positions) * bins, min(BINS, len(mesh.positions) * bins))
    vertices, local = np.divmod(chosen, bins)
    outgoing = np.stack([views(int(v), int(v) + 1)[0][0, b] for v, b in zip(vertices, local, strict=True)])
    lattice = sphere.fibonacci(max(DIRECTIONS, 3 * sh.count(degree)))
    harmonics = sh.evaluate(lattice, degree)
    fit = np.linalg.solve(harmonics.T @ harmonics, harmonics.T)
    turned = lattice @ rotations(uniforms((_ROUNDING_STREAM, seed, np.arange(len(chosen))), 3)).transpose(0, 2, 1)
    # Coefficients in each bin's own frame: a turn changes none of their sums of squares.
    found, exact = (
        fit @ values_at(asked, turned, np.arange(len(chosen)), mesh.positions[vertices], outgoing).astype(np.float64)
        for asked in (transport, transport.exact())
    )
    finite = np.isfinite(found).all(axis=(1, 2)) & np.isfinite(exact).all(axis=(1, 2))
    signal = float((exact[finite] ** 2).sum())
    off = float(((found - exact)[finite] ** 2).sum())
    return float(np.sqrt(off / signal)) if signal > 0.0 else 0.0, 2 * len(chosen) * len(lattice)
