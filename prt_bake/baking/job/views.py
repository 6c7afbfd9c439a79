"""View bins of every vertex as world-space directions, clamped to the horizon of the faces around it."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from bakers.horizon import VertexFaces, clamp_to_horizon, merged_vertex_faces
from formats.errors import QueryError
from formats.mesh import Mesh
from prt_bake.mathematics import sphere

MOST_BINS = 1 << 16

Views = Callable[[int, int], tuple[NDArray[np.float64], int]]
"""(first vertex, last vertex) → directions to the eye [n,B,3] and how many of them were clamped to the horizon."""


def views_of(mesh: Mesh, rings: int, sectors: int) -> tuple[NDArray[np.float64], Views]:
    """Tangents [V,3], and the directions of the view bins; those below the horizon are clamped to it.

    Raises QueryError for more than 65,536 bins.
    """
    if rings * sectors > MOST_BINS:
        raise QueryError(f"rings × sectors: at most {MOST_BINS:,} view bins, found {rings} × {sectors}; give fewer")
    local = sphere.view_bins(rings, sectors)
    tangents = sphere.tangent_frame(mesh.normals)
    faces = horizons(mesh)

    def outgoing(first: int, last: int) -> tuple[NDArray[np.float64], int]:
        world = sphere.to_world(local, mesh.normals[first:last, None], tangents[first:last, None])
        return clamp_to_horizon(world, faces, first)

    return tangents, outgoing


def horizons(mesh: Mesh) -> VertexFaces:
    """The faces around each vertex; vertices with the same position and normal share their faces."""
    return merged_vertex_faces(np.concatenate([mesh.positions, mesh.normals], axis=1), mesh.faces, mesh.face_normals)
