"""The finish of an object's interface, in NumPy: normal and roughness at points of its mesh.

Both are those of the walk's kernels (`prt_bake.tracer.surface.boundary`).
"""

from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from formats.mesh import Mesh

Array = NDArray[np.float64]
Normals = Literal["face", "vertex"]


class SurfacePoints(NamedTuple):
    """Points of a reflecting surface, each seen along one direction.

    faces [N]; (u, v) barycentric [N,2]; unit normals [N,3] of the interface; unit directions to the eye, outgoing
    [N,3]; GGX alpha [N].
    """

    faces: NDArray[np.int64]
    barycentric: Array
    normals: Array
    outgoing: Array
    alpha: Array


def surface_points(
    mesh: Mesh,
    faces: NDArray[np.int64],
    barycentric: Array,
    outgoing: Array,
    normals: Normals,
    roughness: float | Array,
) -> SurfacePoints:
    """Points at (u, v) [N,2] of faces [N], seen along outgoing [N,3], with the interface's normals and roughness."""
    interface = interface_normals(mesh, faces, barycentric, normals)
    return SurfacePoints(faces, barycentric, interface, outgoing, interface_alpha(mesh, faces, barycentric, roughness))


def interface_normals(mesh: Mesh, faces: NDArray[np.int64], barycentric: Array, kind: Normals) -> Array:
    """Unit normals [N,3] of the interface at (u, v) [N,2] of faces [N].

    "face" gives face normals, "vertex" interpolated vertex normals. Face normals replace vertex normals that cancel.
    """
    face_normals = mesh.face_normals[faces]
    if kind == "face":
        return face_normals
    blended = _interpolate(mesh.normals[mesh.faces[faces]], barycentric)
    length = np.linalg.norm(blended, axis=1, keepdims=True)
    return np.where(length > 1e-6, blended / np.maximum(length, 1e-6), face_normals)


def interface_alpha(mesh: Mesh, faces: NDArray[np.int64], barycentric: Array, roughness: float | Array) -> Array:
    """GGX alpha [N] at (u, v) [N,2] of faces [N]: one number, or a texture [H,W] in the mesh's texture coordinates.

    Textures are bilinear and repeat. Row 0 is their top; t = 0 is the lower edge of the last row.
    """
    texture = np.asarray(roughness, np.float64)
    if texture.ndim == 0 or mesh.corner_uv is None:
        return np.full(len(faces), float(texture.mean()))
    s, t = _interpolate(mesh.corner_uv[faces], barycentric).T
    height, width = texture.shape
    x, y = s * width - 0.5, (1.0 - t) * height - 0.5
    column, row = np.floor(x), np.floor(y)
    right, down = x - column, y - row
    columns = [(column.astype(np.int64) + step) % width for step in (0, 1)]
    rows = [(row.astype(np.int64) + step) % height for step in (0, 1)]
    upper, lower = (texture[at, columns[0]] * (1.0 - right) + texture[at, columns[1]] * right for at in rows)
    return np.asarray(upper * (1.0 - down) + lower * down)


def _interpolate(corners: Array, barycentric: Array) -> Array:
    """Values at (u, v) [N,2] between those at corners [N,3,C]."""
    weights = np.concatenate([1.0 - barycentric.sum(axis=1, keepdims=True), barycentric], axis=1)
    return np.asarray(np.einsum("nk,nkc->nc", weights, corners))
