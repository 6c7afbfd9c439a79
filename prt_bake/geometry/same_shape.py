"""Whether two meshes are the same object, in whatever order or format their vertices are."""

import numpy as np

from formats.mesh import Mesh

_TOLERANCE = 1e-4
"""Distance of vertices over the diagonal that rounding in a file may cause."""


def foreign_vertices(mesh: Mesh, of: Mesh) -> int:
    """Number of vertices of a mesh that are not those of another one, within 10⁻⁴ of its diagonal."""
    from scipy.spatial import cKDTree

    distances, _ = cKDTree(of.positions).query(mesh.positions, distance_upper_bound=_TOLERANCE * of.diagonal)
    return int(np.count_nonzero(~np.isfinite(distances)))
