"""The error that a transport's arithmetic adds to a bake in half precision, measured against float32."""

from typing import Any

import numpy as np

from bakers.evaluation import values_at
from formats.mesh import Mesh
from prt_bake.baking.job.lattices import sample_without_replacement
from prt_bake.baking.job.views import Views
from prt_bake.mathematics import sh, sphere
from prt_bake.mathematics.directions import rotations
from prt_bake.mathematics.random import uniforms

BINS, DIRECTIONS = 256, 64
_ROUNDING_STREAM = 33


def measure_rounding(transport: Any, mesh: Mesh, views: Views, bins: int, degree: int, seed: int) -> tuple[float, int]:
    """Relative RMSE that half precision adds to the coefficients, and the evaluations of the measurement.

    Random view bins, of `bins` at each vertex, are projected in the same directions by the transport and by its float32
    version `transport.exact()`. Returns 0 at no cost for transports in float32 or without that method.
    """
    if not hasattr(transport, "exact") or transport.precision == "float32":
        return 0.0, 0
    chosen = sample_without_replacement(seed + 4, len(mesh.positions) * bins, min(BINS, len(mesh.positions) * bins))
    vertices, local = np.divmod(chosen, bins)
    outgoing = np.stack([views(v)[0][0, b] for v, b in zip(vertices[:, None], local, strict=True)])
    lattice = sphere.fibonacci(max(DIRECTIONS, 3 * sh.count(degree)))
    harmonics = sh.evaluate(lattice, degree)
    fit = np.linalg.solve(harmonics.T @ harmonics, harmonics.T)
    turned = lattice @ rotations(uniforms((_ROUNDING_STREAM, seed, np.arange(len(chosen))), 3)).transpose(0, 2, 1)
    # Coefficients are in each bin's rotated frame: a rotation changes no sum of squares.
    rounded, exact = (
        fit @ values_at(each, turned, np.arange(len(chosen)), mesh.positions[vertices], outgoing).astype(np.float64)
        for each in (transport, transport.exact())
    )
    finite = np.isfinite(rounded).all(axis=(1, 2)) & np.isfinite(exact).all(axis=(1, 2))
    signal = float((exact[finite] ** 2).sum())
    error = float(((rounded - exact)[finite] ** 2).sum())
    return float(np.sqrt(error / signal)) if signal > 0.0 else 0.0, 2 * len(chosen) * len(lattice)
