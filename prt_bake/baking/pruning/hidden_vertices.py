"""Vertices that are visible from outside an object, or from one eye, found by ray casting."""

import numpy as np
from numpy.typing import NDArray

from formats.mesh import Mesh
from prt_bake.geometry.camera import Visibility
from prt_bake.mathematics import sphere
from prt_bake.mathematics.directions import rotations
from prt_bake.mathematics.random import uniforms

Array = NDArray[np.float64]
Index = NDArray[np.int64]

STAGES = ((1, 8), (4, 32), (16, 256))
"""(points on a face, rays from each side of each point); later stages test only faces that were not visible before."""
OFF_SURFACE = 1e-5
"""Offset of a ray's origin from its face, in diagonals of the mesh."""
RAYS_AT_ONCE = 1 << 18
_STREAM, _SEED = 26, 0


def seen_from_outside(mesh: Mesh) -> NDArray[np.bool_]:
    """True for vertices [V] of faces from which a ray escapes, and for vertices without a face.

    Both sides of a face count. A face is hidden if none of 4,096 rays from each side escapes: faces that are visible
    only through cracks of less than a ten-thousandth of all directions may be missed.
    """
    if not len(mesh.faces):
        return np.ones(len(mesh.positions), bool)
    visibility = Visibility(mesh)
    hidden = np.arange(len(mesh.faces))
    for stage, (points, rays) in enumerate(STAGES):
        hidden = hidden[~_escapes(mesh, visibility, hidden, points, rays, stage)]
    return _corners(mesh, np.delete(mesh.faces, hidden, axis=0)) | ~_corners(mesh, mesh.faces)


def _corners(mesh: Mesh, faces: NDArray[np.integer]) -> NDArray[np.bool_]:
    """True for the vertices [V] of `faces` [n,3]."""
    corners = np.zeros(len(mesh.positions), bool)
    corners[faces] = True
    return corners


def _escapes(mesh: Mesh, visibility: Visibility, faces: Index, points: int, rays: int, stage: int) -> NDArray[np.bool_]:
    """True for the faces [n] from which at least one ray meets nothing."""
    escapes = np.zeros(len(faces), bool)
    step = max(1, RAYS_AT_ONCE // (2 * points * rays))
    for first in range(0, len(faces), step):
        some = faces[first : first + step]
        origins, directions = _rays(mesh, some, points, rays, stage)
        hits = visibility.first_hits(origins.reshape(-1, 3), directions.reshape(-1, 3))
        escapes[first : first + step] = (hits.faces < 0).reshape(len(some), -1).any(axis=1)
    return escapes


def _rays(mesh: Mesh, faces: Index, points: int, rays: int, stage: int) -> tuple[Array, Array]:
    """Origins and directions [n, 2·points·rays, 3]: a rotated direction lattice at random points of each face. Rays
    above the face start at its front, rays below at its back.
    """
    positions, numbers = _random_points(mesh, faces, points, stage)
    turns = rotations(numbers.reshape(-1, 3)).reshape(len(faces), points, 3, 3)
    directions = sphere.fibonacci(2 * rays) @ turns.transpose(0, 1, 3, 2)
    normals = mesh.face_normals[faces][:, None, None]
    side = np.sign((directions * normals).sum(axis=-1, keepdims=True))
    origins = positions[:, :, None] + OFF_SURFACE * mesh.diagonal * side * normals
    return np.broadcast_to(origins, directions.shape).reshape(len(faces), -1, 3), directions.reshape(len(faces), -1, 3)


def _random_points(mesh: Mesh, faces: Index, points: int, stage: int) -> tuple[Array, Array]:
    """Points [n,points,3] drawn uniformly on faces [n], and three more random numbers [n,points,3] for each."""
    u = uniforms((_STREAM, _SEED, stage, faces[:, None] * points + np.arange(points)), 5)
    flipped = u[..., 0] + u[..., 1] > 1.0
    shares = np.where(flipped[..., None], 1.0 - u[..., :2], u[..., :2])
    a, b, c = (mesh.positions[mesh.faces[faces, corner]][:, None] for corner in range(3))
    return a + shares[..., :1] * (b - a) + shares[..., 1:] * (c - a), u[..., 2:]


def seen_from_eye(mesh: Mesh, eye: Array) -> NDArray[np.bool_]:
    """True for vertices [V] of faces that are visible from the point `eye` [3], and of the faces next to those."""
    if not len(mesh.faces):
        return np.ones(len(mesh.positions), bool)
    visibility = Visibility(mesh)
    hidden = np.arange(len(mesh.faces))
    for stage, (points, _rays) in enumerate(STAGES):
        positions = _random_points(mesh, hidden, points, stage)[0]
        rays = (positions - eye).reshape(-1, 3)
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        hits = visibility.first_hits(eye, rays).faces.reshape(len(hidden), points)
        hidden = hidden[~(hits == hidden[:, None]).any(axis=1)]
    seen = _corners(mesh, np.delete(mesh.faces, hidden, axis=0))
    return _corners(mesh, mesh.faces[seen[mesh.faces].any(axis=1)])
