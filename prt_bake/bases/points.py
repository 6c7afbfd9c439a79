"""Points of an object and directions to the eye, at which bases are compared.

A few thin places hold most of Ŝ². Points are therefore drawn by an estimate of it, from many candidates, and weighted.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from formats.mesh import Mesh
from prt_bake.mathematics.directions import on_sphere
from prt_bake.mathematics.random import uniforms
from prt_bake.mathematics.sphere import tangent_frame, to_world

Array = NDArray[np.float64]

_STREAM = 61
_CANDIDATES = 16
"""Candidates for a point that is drawn."""
_EVEN = 0.2
"""Share of the points that are drawn alike from all candidates, so that weights stay below 1 / _EVEN."""


class Points(NamedTuple):
    """N points of a mesh: faces [N], barycentric (u, v) [N,2], positions [N,3], unit directions to the eye [N,3]."""

    faces: NDArray[np.int64]
    barycentric: Array
    positions: Array
    outgoing: Array

    def subset(self, chosen: NDArray[np.int64] | slice) -> "Points":
        """The points of an index."""
        return Points._make(part[chosen] for part in self)


def points_on(mesh: Mesh, faces: NDArray[np.int64], barycentric: Array, outgoing: Array) -> Points:
    """Points at barycentric (u, v) of faces."""
    a, b, c = (mesh.positions[mesh.faces[faces, corner]] for corner in range(3))
    positions = a + barycentric[:, :1] * (b - a) + barycentric[:, 1:] * (c - a)
    return Points(faces, barycentric, positions, outgoing)


def drawn_points(mesh: Mesh, count: int, seed: int, squares: Callable[[Points], Array]) -> tuple[Points, Array]:
    """Draw `count` points by an estimate `squares` [N] of Σ Ŝ² over directions of incidence; return weights [N] too.

    Weighted means over them estimate those over the surface, uniform by area, and over hemispheres, uniform by solid
    angle.
    """
    number = _CANDIDATES * count
    candidates = _evenly_drawn(mesh, number, seed)
    found = squares(candidates)
    mean = float(found.mean())
    chance = (1.0 - _EVEN) * found / mean + _EVEN if mean > 0.0 else np.ones(number)
    start = float(uniforms((_STREAM, seed, number), 1)[0])
    levels = np.cumsum(chance) / chance.sum()
    taken = np.searchsorted(levels, (np.arange(count) + start) / count).clip(0, number - 1)
    return candidates.subset(taken), 1.0 / chance[taken]


def _evenly_drawn(mesh: Mesh, count: int, seed: int) -> Points:
    number, u, v, height, turn = uniforms((_STREAM, seed, np.arange(count)), 5).T
    a, b, c = (mesh.positions[mesh.faces[:, corner]] for corner in range(3))
    areas = np.cumsum(np.linalg.norm(np.cross(b - a, c - a), axis=1))
    faces = np.searchsorted(areas, number * areas[-1], side="right").clip(0, len(areas) - 1)
    normals = mesh.face_normals[faces]
    outgoing = to_world(on_sphere(0.5 * height, turn), normals, tangent_frame(normals))
    folded = np.where((u + v > 1.0)[:, None], np.stack([1.0 - u, 1.0 - v], axis=1), np.stack([u, v], axis=1))
    return points_on(mesh, faces, folded, outgoing)
