"""Clamps directions to the eye that are below a surface to its horizon."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
LOWEST_COSINE = 1e-3


@dataclass(frozen=True)
class VertexFaces:
    """Unit normals of the faces around each vertex, vertex by vertex: those of v are at starts[v] to starts[v+1]."""

    normals: Array
    starts: NDArray[np.int64]


def vertex_faces(vertices: int, faces: NDArray[np.integer], face_normals: Array) -> VertexFaces:
    """Gathers face_normals [F,3] around the vertices of faces [F,3], lowest face first."""
    corners = np.asarray(faces, dtype=np.int64).reshape(-1)
    order = np.argsort(corners, kind="stable")
    starts = np.concatenate(([0], np.cumsum(np.bincount(corners, minlength=vertices))))
    return VertexFaces(np.asarray(face_normals, dtype=np.float64)[order // 3], starts)


def merged_vertex_faces(places: Array, faces: NDArray[np.integer], face_normals: Array) -> VertexFaces:
    """As `vertex_faces`, but vertices with equal rows of `places` [V,m] count as one: each has the faces of all."""
    vertices = len(places)
    # Equal rows have equal sums, and sums are much faster to sort than rows.
    if len(np.unique((places * np.sqrt(2.0 + np.arange(places.shape[1]))).sum(axis=1))) == vertices:
        return vertex_faces(vertices, faces, face_normals)
    _unique, first, inverse = np.unique(places, axis=0, return_index=True, return_inverse=True)
    same = first[inverse.reshape(-1)]
    merged = vertex_faces(vertices, same[faces], face_normals)
    counts = np.diff(merged.starts)[same]
    starts = np.concatenate(([0], np.cumsum(counts)))
    within = np.arange(starts[-1]) - np.repeat(starts[:-1], counts)
    return VertexFaces(merged.normals[np.repeat(merged.starts[same], counts) + within], starts)


def clamp_to_horizon(outgoing: Array, around: VertexFaces, vertices: NDArray[np.int64]) -> tuple[Array, int]:
    """Clamps outgoing [n,B,3] at vertices [n] to the horizon; returns them and how many were clamped.

    The face around a vertex with the largest ωo·n decides (the lowest index on a tie). If that is not positive, the
    direction is turned in the plane of ωo and n until ωo·n = 10⁻³. A vertex without faces has no horizon.
    """
    clamped = outgoing.copy()
    count = 0
    for row, vertex in enumerate(vertices):
        first, last = around.starts[vertex : vertex + 2]
        if first == last:
            continue
        normals = around.normals[first:last]
        cosines = outgoing[row] @ normals.T
        below = np.flatnonzero(cosines.max(axis=1) <= 0.0)
        if below.size:
            highest = normals[cosines[below].argmax(axis=1)]
            clamped[row, below] = _clamped(outgoing[row, below], highest)
            count += below.size
    return clamped, count


def _clamped(directions: Array, normals: Array) -> Array:
    along = directions - (directions * normals).sum(axis=-1, keepdims=True) * normals
    length = np.linalg.norm(along, axis=-1, keepdims=True)
    # A direction along −n spans no plane with n: use a tangent orthogonal to the axis of n's smallest component.
    axis = np.eye(3)[np.abs(normals).argmin(axis=-1)]
    fallback = np.cross(normals, axis)
    fallback /= np.linalg.norm(fallback, axis=-1, keepdims=True)
    tangent = np.where(length > 1e-12, along / np.maximum(length, 1e-300), fallback)
    return np.asarray(np.sqrt(1.0 - LOWEST_COSINE**2) * tangent + LOWEST_COSINE * normals)
