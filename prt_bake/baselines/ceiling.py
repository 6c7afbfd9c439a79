"""What no BRDF can do better: the error of the best Lambert albedo of each single query.

A Lambert surface whose albedo is free in position and view has the Ŝ a(x, ωo) V max(n·ωi, 0) / π. Its least error is
known in closed form. A NeRFactor has one albedo for all views of a position; its glossy lobe can only add what is
reflected at the surface. From two independent estimates of Ŝ the error follows without the bias of their noise.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from formats.scene import Scene
from prt_bake.baselines.lit_surface import LitSurface, Normals, Points
from prt_bake.mathematics import sh
from prt_bake.mathematics.noise_free import Interval, Sums, ratio, relative_rmse
from prt_bake.mathematics.sphere import fibonacci
from prt_bake.tracer.estimate import estimate_coefficients
from prt_bake.tracer.prepared import prepare, smooth_part
from prt_bake.trainer.samples.queries import QuerySource
from prt_bake.trainer.samples.rows import trace_values

Array = NDArray[np.float64]

_DEGREE = 2
_LATTICE = 2048
_SEED = 0xCE11


class Ceiling(NamedTuple):
    """The least relative error of a Lambert surface on Ŝ and on its coefficients a_lm, and the share of Ŝ from behind
    the tangent plane. Ŝ and the share are None behind a smooth interface, where Ŝ has no values.
    """

    transport: Interval | None
    coefficients: Interval
    behind: Interval | None


def lambert_ceiling(first: Array, second: Array, lambert: Array, seed: int = 0) -> Interval:
    """The relative error of the best albedo of each query and channel, with its 95 % confidence interval.

    Args:
        first, second: two independent, unbiased estimates of N queries [N,D,3]: Ŝ in D directions that are evenly
            spread over the sphere, or its D coefficients.
        lambert: the same of a white Lambert surface [N,D].
        seed: of the interval's resamples.

    Returns sqrt(min Σ|a g − Ŝ|² / Σ|Ŝ|²) over all queries, g being `lambert`. A query that no light reaches has the
    error 1.

    >>> import numpy as np
    >>> lambert = np.array([[0.3, 0.0]])
    >>> transport = np.array([[[0.6, 0.6, 0.6], [0.8, 0.8, 0.8]]])
    >>> round(lambert_ceiling(transport, transport, lambert).value, 6)
    0.8
    """
    squares = np.einsum("nd,nd->n", lambert, lambert)[:, None]
    projected = np.prod([np.einsum("ndc,nd->nc", estimate, lambert) for estimate in (first, second)], axis=0)
    value = np.einsum("ndc,ndc->nc", first, second)
    error = value - np.divide(projected, squares, out=np.zeros_like(projected), where=squares > 0.0)
    return relative_rmse(Sums(error.sum(axis=1), value.sum(axis=1), np.zeros(len(value))), seed)


def measure_ceiling(scene: Scene, queries: int = 400, directions: int = 128, walks: int = 64, seed: int = 0) -> Ceiling:
    """The ceiling of a scene, from path-traced `queries` in `directions`, with two times `walks` walks each.

    >>> import prt_bake as prt
    >>> from prt_bake.baselines.ceiling import measure_ceiling
    >>> found = measure_ceiling(prt.load_scene("spot.toml"), queries=32, directions=32, walks=8)
    >>> 0.0 < found.transport.value < 1.0
    True
    """
    prepared = prepare(scene)
    source = QuerySource(prepared, directions, _SEED + seed)
    drawn = source.draw(0, queries)
    kind: Normals = "vertex" if scene.normals == "vertex" else "face"
    lit = LitSurface(scene.mesh, kind)
    points = lit.points(drawn.positions, drawn.outgoing)
    transport = behind = None
    if smooth_part(scene) is None:
        traced = [trace_values(prepared, source, drawn, walks, directions, 2 * seed + half)[0] for half in (0, 1)]
        transport = lambert_ceiling(traced[0], traced[1], lit.lambert(points, drawn.incident), seed)
        mean = 0.5 * (traced[0] + traced[1]).sum(axis=2)
        away = np.einsum("ndc,nc->nd", drawn.incident, points.normals) <= 0.0
        behind = ratio((mean * away).sum(axis=1), mean.sum(axis=1), seed)
    halves = [
        estimate_coefficients(scene, drawn.positions, drawn.outgoing, _DEGREE, 8 * walks, 2 * seed + half).mean
        for half in (0, 1)
    ]
    return Ceiling(transport, lambert_ceiling(halves[0], halves[1], _coefficients(lit, points), seed), behind)


def _coefficients(lit: LitSurface, points: Points) -> Array:
    """The coefficients [N,9] of the Ŝ of a white Lambert surface."""
    lattice = fibonacci(_LATTICE)
    basis = 4.0 * math.pi / _LATTICE * sh.evaluate(lattice, _DEGREE)
    found = np.empty((len(points.normals), basis.shape[1]))
    for row in range(len(found)):  # a row at a time: the shadow rays of all would fill the memory
        some = points.select(slice(row, row + 1))
        found[row] = lit.lambert(some, lattice[None])[0] @ basis
    return found
