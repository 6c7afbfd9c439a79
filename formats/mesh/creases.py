"""Normals at the corners of faces: smooth over the surface, but not across sharp edges.

No library: trimesh splits a mesh at sharp edges for this (`graph.smooth_shade`) and drops the normals of its file.
"""

import numpy as np
from numpy.typing import NDArray

from formats.mesh import geometry
from formats.mesh.edges import edges_of

Array = NDArray[np.float64]

CREASE_ANGLE = 60.0
"""In degrees. Edges between faces whose normals differ by more are sharp; a usual setting of engines."""
_MOST_TILT = 75.0
"""In degrees. A vertex normal that is farther from the normal of a face does not count there."""
_CONSTANT = 0.1
"""In degrees. Normals of a face's corners that differ by less are those of flat shading."""
_BENT = 1.0
"""In degrees. The surface bends at a face whose vertex normals differ by more."""
_MOST_BENT = 0.01
"""Share of the bent faces up to which flat shading may have normals that are not constant."""


def corner_normals(positions: Array, faces: NDArray[np.integer], normals: Array) -> Array:
    """Return unit normals at the corners of each face [F,3,3]: those of the vertices [V,3], apart at sharp edges.

    Sharp edges are those between faces whose normals differ by more than `CREASE_ANGLE`. They divide the faces around a
    vertex into groups; with several groups each has the angle-weighted mean of its own face normals. A face keeps its
    own normal at a corner where the other one is more than 75 degrees from it.
    """
    of_faces = geometry.face_normals(positions, faces)
    group = _smooth_groups(faces, of_faces)
    vertex_of_group = np.zeros(int(group.max()) + 1, np.int64)
    vertex_of_group[group] = faces
    divided = np.bincount(vertex_of_group, minlength=len(positions))[vertex_of_group] > 1
    at_groups = normals[vertex_of_group]
    at_groups[divided] = geometry.vertex_normals(positions[vertex_of_group], group)[0][divided]
    at_corners = at_groups[group]
    cosines = np.einsum("fki,fi->fk", at_corners, of_faces)
    near = cosines > np.cos(np.radians(_MOST_TILT)) * np.linalg.norm(at_corners, axis=2)
    return np.where(near[..., None], at_corners, of_faces[:, None])


def _smooth_groups(faces: NDArray[np.integer], face_normals: Array) -> NDArray[np.int64]:
    """Return the number of the group of each corner [F,3]: corners of a vertex are joined across smooth edges."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    edges = edges_of(faces)
    sides = np.argsort(edges.of_side.ravel(), kind="stable")
    sides = sides[(edges.uses == 2)[edges.of_side.ravel()[sides]]].reshape(-1, 2)
    (face, side), (other, back) = (np.divmod(sides[:, i], 3) for i in range(2))
    smooth = np.einsum("ei,ei->e", face_normals[face], face_normals[other]) > np.cos(np.radians(CREASE_ANGLE))
    # Consistent faces traverse their edge in opposite directions.
    smooth &= faces[face, side] != faces[other, back]
    face, side, other, back = (each[smooth] for each in (face, side, other, back))
    ends, others = 3 * face, 3 * other
    one = np.concatenate([ends + side, ends + (side + 1) % 3])
    two = np.concatenate([others + (back + 1) % 3, others + back])
    graph = coo_array((np.ones(len(one), np.bool_), (one, two)), shape=(faces.size, faces.size))
    labels = connected_components(graph, directed=False)[1]
    return np.asarray(labels, np.int64).reshape(faces.shape)


def is_flat_shaded(corner_normals: Array, vertex_normals: Array) -> bool:
    """Return whether a file's normals [F,3,3] are constant on each face where the surface bends.

    vertex_normals [F,3,3] are their means at the vertices. A plane has constant normals in any case.
    """
    bent = _varies(vertex_normals, _BENT)
    return bool(bent.any()) and float(_varies(corner_normals[bent], _CONSTANT).mean()) <= _MOST_BENT


def _varies(normals: Array, degrees: float) -> NDArray[np.bool_]:
    """Return whether unit normals at the corners of a face [F,3,3] differ by more than an angle, face by face [F]."""
    chords = np.linalg.norm(normals - np.roll(normals, 1, axis=1), axis=2).max(axis=1, initial=0.0)
    return np.asarray(chords > 2.0 * np.sin(0.5 * np.radians(degrees)))
