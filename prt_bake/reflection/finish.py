"""The finish of an object's interface, in NumPy: normal and roughness at points of its mesh.

Roughness and face normals are those of the walk's kernels (`prt_bake.tracer.surface.boundary`). Vertex normals are
theirs up to two exceptions: they are apart at sharp edges, and tilted where they would reflect the eye's ray into the
surface.
"""

from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from formats.errors import QueryError
from formats.mesh import Mesh

Array = NDArray[np.float64]
Normals = Literal["face", "vertex"]

_LEAST_RISE = 0.01
"""Least cosine to the face of a mirrored ray; nine tenths of the eye's own cosine if that is less."""


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
    if normals == "vertex":
        interface = tilted_to_reflect(interface, mesh.face_normals[faces], outgoing)
    return SurfacePoints(faces, barycentric, interface, outgoing, interface_alpha(mesh, faces, barycentric, roughness))


def chosen_normals(mesh: Mesh, normals: Normals | None) -> Normals:
    """The kind of normals that reflections have: the given one; by default "vertex", or "face" on a flat shaded mesh.

    Raises QueryError for another kind.
    """
    if normals is None:
        return "face" if mesh.flat_shaded else "vertex"
    if normals not in ("face", "vertex"):
        raise QueryError(f'normals: expected "vertex" or "face", found {normals!r}')
    return normals


def interface_normals(mesh: Mesh, faces: NDArray[np.int64], barycentric: Array, kind: Normals) -> Array:
    """Unit normals [N,3] of the interface at (u, v) [N,2] of faces [N].

    "face" gives face normals, "vertex" interpolates `Mesh.corner_normals`, none of which is far from its face.
    """
    if kind == "face":
        return mesh.face_normals[faces]
    blended = _interpolate(mesh.corner_normals[faces], barycentric)
    return np.asarray(blended / np.maximum(np.linalg.norm(blended, axis=1, keepdims=True), 1e-6))


def tilted_to_reflect(normals: Array, face_normals: Array, outgoing: Array) -> Array:
    """Unit normals [N,3], tilted towards the face normals [N,3] as little as makes the mirrored ray leave the face.

    Without it, interpolated normals reflect into the surface near silhouettes, which shows as black triangles. This is
    `ensure_valid_specular_reflection` of Blender's Cycles (intern/cycles/kernel/closure/bsdf_util.h, Apache 2.0).
    Faces seen from behind keep their normals.
    """
    up = np.einsum("ni,ni->n", outgoing, face_normals)
    least = np.minimum(0.9 * up, _LEAST_RISE)
    rise = 2.0 * np.einsum("ni,ni->n", normals, outgoing) * np.einsum("ni,ni->n", normals, face_normals) - up
    below = np.flatnonzero((rise < least) & (up > 0.0))
    if not len(below):
        return normals
    # In the plane of both normals: the eye at (x, z), the tilted normal at (sin, cos) with a mirrored z of `least`.
    face, z, least = face_normals[below], up[below], least[below]
    across = normals[below] - np.einsum("ni,ni->n", normals[below], face)[:, None] * face
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
    x = np.einsum("ni,ni->n", outgoing[below], across)
    a = x * x + z * z
    b = 2.0 * (a + z * least)
    root = np.sqrt(np.maximum(b * b - 4.0 * a * (least + z) ** 2, 0.0))
    squared = np.clip(0.25 * np.where(x < 0.0, b + root, b - root) / a, 0.0, 1.0)
    tilted = normals.copy()
    tilted[below] = np.sqrt(1.0 - squared)[:, None] * across + np.sqrt(squared)[:, None] * face
    return tilted


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
