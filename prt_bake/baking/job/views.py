"""View bins of every vertex as world-space directions, clamped to the horizon of the faces around it."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from bakers.horizon import VertexFaces, clamp_to_horizon, merged_vertex_faces
from formats.errors import QueryError, warn
from formats.mesh import Mesh
from prt_bake.mathematics import sphere

MOST_BINS = 1 << 16
_MOST_CLAMPED = 0.02
"""Share of clamped view bins that a sound mesh does not reach; the meshes of the paper's scenes have none."""
_TESTED = 256

Views = Callable[[NDArray[np.int64]], tuple[NDArray[np.float64], int]]
"""Vertices [n] → directions to the eye [n,B,3] and how many of them were clamped to the horizon."""


def views_of(mesh: Mesh, rings: int, sectors: int) -> Views:
    """The directions of the view bins; those below the horizon are clamped to it.

    Raises QueryError for more than 65,536 bins.
    """
    if rings * sectors > MOST_BINS:
        raise QueryError(f"rings × sectors: at most {MOST_BINS:,} view bins, found {rings} × {sectors}; give fewer")
    local = sphere.view_bins(rings, sectors)
    tangents = sphere.tangent_frame(mesh.normals)
    faces = horizons(mesh)

    def outgoing(vertices: NDArray[np.int64]) -> tuple[NDArray[np.float64], int]:
        world = sphere.to_world(local, mesh.normals[vertices, None], tangents[vertices, None])
        return clamp_to_horizon(world, faces, vertices)

    return outgoing


def horizons(mesh: Mesh) -> VertexFaces:
    """The faces around each vertex; vertices with the same position and normal share their faces."""
    return merged_vertex_faces(np.concatenate([mesh.positions, mesh.normals], axis=1), mesh.faces, mesh.face_normals)


def warn_of_clamped_views(mesh: Mesh, rings: int, sectors: int) -> None:
    """Warn if more than 2 % of the view bins at 256 vertices lie below the horizon of the faces around them."""
    tested = np.unique(np.linspace(0, len(mesh.positions) - 1, _TESTED).astype(np.int64))
    outgoing = views_of(mesh, rings, sectors)
    share = sum(outgoing(vertex)[1] for vertex in tested[:, None]) / (len(tested) * rings * sectors)
    if share > _MOST_CLAMPED:
        warn(
            f"mesh: {share:.0%} of the view bins lie below the horizon of the faces around their vertex and are "
            f"clamped to it: the vertex normals do not match the faces; recompute the normals in a mesh editor"
        )
