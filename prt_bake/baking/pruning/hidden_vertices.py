"""Which vertices an eye outside an object can see, by rays that leave the object without meeting it again."""

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
"""(points on a face, rays from each side of each): the later ones for faces that nothing has been seen of before."""
OFF_SURFACE = 1e-5
"""Of the diagonal: how far off its face a ray begins."""
RAYS_AT_ONCE = 1 << 18
_STREAM = 26


def seen_from_outside(mesh: Mesh, seed: int = 0) -> NDArray[np.bool_]:
    """True for vertices [V] of faces of which some point has a way out; for all where there are no faces.

    Both sides of a face count. A face is given up after 4,096 rays from either side: what is seen through cracks that
    less than a ten-thousandth of all directions lead out of may be missed.
    """
    if not len(mesh.faces):
        return np.ones(len(mesh.positions), bool)
    visibility = Visibility(mesh)
    left = np.arange(len(mesh.faces))
    for number, (points, rays) in enumerate(STAGES):
        left = left[~_escapes(mesh, visibility, left, points, rays, (seed, number))]
    seen = np.zeros(len(mesh.positions), bool)
    open_faces = np.ones(len(mesh.faces), bool)
    open_faces[left] = False
    seen[mesh.faces[open_faces]] = True
    used = np.zeros(len(mesh.positions), bool)
    used[mesh.faces] = True
    return np.asarray(seen | ~used)


def _escapes(
    mesh: Mesh, visibility: Visibility, faces: Index, points: int, rays: int, key: tuple[int, int]
) -> NDArray[np.bool_]:
    """Of the faces [n], those that one of these rays leaves from and meets nothing."""
    out = np.zeros(len(faces), bool)
    step = max(1, RAYS_AT_ONCE // (2 * points * rays))
    for first in range(0, len(faces), step):
        some = faces[first : first + step]
        origins, directions = _rays(mesh, some, points, rays, key)
        hits = visibility.first_hits(origins.reshape(-1, 3), directions.reshape(-1, 3))
        out[first : first + step] = (hits.faces < 0).reshape(len(some), -1).any(axis=1)
    return out


def _rays(mesh: Mesh, faces: Index, points: int, rays: int, key: tuple[int, int]) -> tuple[Array, Array]:
    """Origins and directions [n, 2·points·rays, 3]: a turned lattice of directions at points drawn on each face, those
    above it from its front and those below from its back.
    """
    places, numbers = _places(mesh, faces, points, key)
    turns = rotations(numbers.reshape(-1, 3)).reshape(len(faces), points, 3, 3)
    directions = sphere.fibonacci(2 * rays) @ turns.transpose(0, 1, 3, 2)
    normals = mesh.face_normals[faces][:, None, None]
    side = np.sign((directions * normals).sum(axis=-1, keepdims=True))
    origins = places[:, :, None] + OFF_SURFACE * mesh.diagonal * side * normals
    return np.broadcast_to(origins, directions.shape).reshape(len(faces), -1, 3), directions.reshape(len(faces), -1, 3)


def _places(mesh: Mesh, faces: Index, points: int, key: tuple[int, int]) -> tuple[Array, Array]:
    """Points [n,points,3] drawn on faces [n], and three more numbers [n,points,3] for each."""
    u = uniforms((_STREAM, *key, faces[:, None] * points + np.arange(points)), 5)
    flipped = u[..., 0] + u[..., 1] > 1.0
    shares = np.where(flipped[..., None], 1.0 - u[..., :2], u[..., :2])
    a, b, c = (mesh.positions[mesh.faces[faces, corner]][:, None] for corner in range(3))
    return a + shares[..., :1] * (b - a) + shares[..., 1:] * (c - a), u[..., 2:]


def seen_from_eye(mesh: Mesh, eye: Array, seed: int = 0) -> NDArray[np.bool_]:
    """True for vertices [V] of faces that are seen from the point `eye` [3], and of the faces beside those."""
    if not len(mesh.faces):
        return np.ones(len(mesh.positions), bool)
    visibility = Visibility(mesh)
    left = np.arange(len(mesh.faces))
    for number, (points, _rays) in enumerate(STAGES):
        places = _places(mesh, left, points, (seed, number))[0]
        rays = (places - eye).reshape(-1, 3)
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        met = visibility.first_hits(eye, rays).faces.reshape(len(left), points)
        left = left[~(met == left[:, None]).any(axis=1)]
    seen = np.zeros(len(mesh.positions), bool)
    shown = np.ones(len(mesh.faces), bool)
    shown[left] = False
    seen[mesh.faces[shown]] = True
    beside = seen[mesh.faces].any(axis=1)
    seen[mesh.faces[beside]] = True
    return seen
