"""The finish of an object's interface at points of its mesh, in NumPy: its normal and its roughness.

Both are what the walk's kernels find there (`prt_bake.tracer.surface.boundary`).
"""

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from formats.mesh import Mesh

Array = NDArray[np.float64]


def interface_normals(
    mesh: Mesh, faces: NDArray[np.int64], barycentric: Array, kind: Literal["face", "vertex"]
) -> Array:
    """Unit normals [N,3] of the interface at (u, v) [N,2] of faces [N]: the face's own, or the interpolated vertex
    normals, where these do not cancel.
    """
    own = mesh.face_normals[faces]
    if kind == "face":
        return own
    blended = _blend(mesh.normals[mesh.faces[faces]], barycentric)
    length = np.linalg.norm(blended, axis=1, keepdims=True)
    return np.where(length > 1e-6, blended / np.maximum(length, 1e-6), own)


def interface_alpha(mesh: Mesh, faces: NDArray[np.int64], barycentric: Array, roughness: float | Array) -> Array:
    """GGX alpha [N] at (u, v) [N,2] of faces [N]: one number, or a texture [H,W] by the mesh's texture coordinates.

    Textures are bilinear and repeat; row 0 is their top, t = 0 the lower edge of the last.
    """
    texture = np.asarray(roughness, np.float64)
    if texture.ndim == 0 or mesh.corner_uv is None:
        return np.full(len(faces), float(texture.mean()))
    s, t = _blend(mesh.corner_uv[faces], barycentric).T
    height, width = texture.shape
    x, y = s * width - 0.5, (1.0 - t) * height - 0.5
    column, row = np.floor(x), np.floor(y)
    right, down = x - column, y - row
    columns = [(column.astype(np.int64) + step) % width for step in (0, 1)]
    rows = [(row.astype(np.int64) + step) % height for step in (0, 1)]
    upper, lower = (texture[at, columns[0]] * (1.0 - right) + texture[at, columns[1]] * right for at in rows)
    return np.asarray(upper * (1.0 - down) + lower * down)


def _blend(corners: Array, barycentric: Array) -> Array:
    """What lies at (u, v) [N,2] between values at corners [N,3,C]."""
    weights = np.concatenate([1.0 - barycentric.sum(axis=1, keepdims=True), barycentric], axis=1)
    return np.asarray(np.einsum("nk,nkc->nc", weights, corners))
