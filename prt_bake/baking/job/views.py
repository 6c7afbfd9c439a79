"""View bins of every vertex as world-space directions, clamped to the horizon of the faces around it."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from bakers.horizon import VertexFaces, bend_to_horizon, faces_about
from formats.errors import QueryError
from formats.mesh import Mesh
from prt_bake.mathematics import sphere

MOST_BINS = 1 << 16

Views = Callable[[int, int], tuple[NDArray[np.float64], int]]
"""(first vertex, last vertex) → directions to the eye [n,B,3] and how many of them were bent to the horizon."""


def views_of(mesh: Mesh, rings: int, sectors: int) -> tuple[NDArray[np.float64], Views]:
    """Tangents [V,3], and the directions of the view bins, bent to the horizon where they lie below it. Raises
    QueryError for more bins than are possible.
    """
    if rings * sectors > MOST_BINS:
        raise QueryError(f"rings × sectors: {rings} × {sectors} view bins, where at most {MOST_BINS:,} are possible")
    local = sphere.view_bins(rings, sectors)
    tangents = sphere.tangent_frame(mesh.normals)
    around = horizons(mesh)

    def outgoing(first: int, last: int) -> tuple[NDArray[np.float64], int]:
        world = sphere.to_world(local, mesh.normals[first:last, None], tangents[first:last, None])
        return bend_to_horizon(world, around, first)

    return tangents, outgoing


def horizons(mesh: Mesh) -> VertexFaces:
    """The faces around each vertex; vertices at one place with one normal have them in common, as one point has."""
    return faces_about(np.concatenate([mesh.positions, mesh.normals], axis=1), mesh.faces, mesh.face_normals)
