"""A perspective camera and what its rays meet first.

Rays are begun where they enter the ball around the object, in float64, and cast by Embree relative to the object's
centre: a camera a million units away sees as sharply as one that is near.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from formats.errors import QueryError
from formats.mesh import Mesh

Array = NDArray[np.float64]

_AXES = {"y": np.array([0.0, 1.0, 0.0]), "z": np.array([0.0, 0.0, 1.0])}
_VIEW = {"y": np.array([-0.43, 0.24, -0.87]), "z": np.array([-0.43, 0.87, 0.24])}
"""Where the default eye stands, seen from the object: in front of it (−z with y up), a little to the side and above."""
_MARGIN = 1.08


@dataclass(frozen=True)
class Camera:
    """Eye, target and up vector in object space; `fov` is the vertical field of view in degrees."""

    eye: Array
    target: Array
    up: Array
    fov: float
    width: int
    height: int


@dataclass(frozen=True)
class Hits:
    """First hits of R rays: faces int64 [R] (−1: the sky), barycentric (u, v) [R,2]."""

    faces: NDArray[np.int64]
    barycentric: Array


def fit(
    mesh: Mesh,
    width: int = 640,
    height: int = 480,
    eye: ArrayLike | None = None,
    up: str = "y",
    fov: float = 30.0,
) -> Camera:
    """A camera that looks at the middle of the mesh; without an `eye` it stands where the whole object fits.

    Raises QueryError for sizes, angles or eyes that make no picture.
    """
    if width < 1 or height < 1:
        raise QueryError(f"camera: {width}x{height} pixels where at least 1x1 is expected")
    if not 0.0 < fov < 180.0:
        raise QueryError(f"camera: a field of view of {fov:g} degrees where one between 0 and 180 is expected")
    low, high = mesh.positions.min(axis=0), mesh.positions.max(axis=0)
    target = 0.5 * (low + high)
    if eye is None:
        view = _VIEW[up] / np.linalg.norm(_VIEW[up])
        place = target + view * _distance(mesh.positions - target, view, _AXES[up], fov, width / height)
    else:
        place = np.asarray(eye, np.float64)
        if place.shape != (3,) or not np.isfinite(place).all() or np.allclose(place, target, rtol=0, atol=1e-12):
            raise QueryError(
                f"camera: eye {np.asarray(eye).tolist()} where three finite numbers off the target are expected"
            )
    return Camera(place, target, _AXES[up], fov, width, height)


def _distance(positions: Array, view: Array, up: Array, fov: float, aspect: float) -> float:
    """How far along `view` the eye must stand for all positions (about the target) to lie in the frame."""
    right, above = _across(-view, up)
    half = np.tan(np.radians(fov) / 2.0)
    depth = positions @ view
    needed = np.maximum(np.abs(positions @ above) / half, np.abs(positions @ right) / (half * aspect))
    return float(np.max(depth + _MARGIN * needed))


def _across(forward: Array, up: Array) -> tuple[Array, Array]:
    """Unit vectors to the right of and above a view; another up is taken for a view straight along it."""
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 1e-9:
        right = np.cross(forward, np.roll(up, 1))
    right /= np.linalg.norm(right)
    return right, np.cross(right, forward)


def directions(camera: Camera, rows: slice, offsets: Array) -> Array:
    """Unit directions [R,W,S,3] of rays through the pixels of some rows; offsets [S,2] in [0,1)², x to the right, y
    down.
    """
    forward = camera.target - camera.eye
    forward = forward / np.linalg.norm(forward)
    right, above = _across(forward, camera.up)
    half = np.tan(np.radians(camera.fov) / 2.0)
    y = 1.0 - 2.0 * (np.arange(camera.height)[rows, None] + offsets[:, 1]) / camera.height
    x = (2.0 * (np.arange(camera.width)[:, None] + offsets[:, 0]) / camera.width - 1.0) * camera.width / camera.height
    rays = forward + half * (x[None, :, :, None] * right + y[:, None, :, None] * above)
    return np.asarray(rays / np.linalg.norm(rays, axis=-1, keepdims=True))


class Visibility:
    """A mesh in an Embree tree; tells what rays meet first."""

    def __init__(self, mesh: Mesh) -> None:
        """Build the tree."""
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        self._center = 0.5 * (mesh.positions.min(axis=0) + mesh.positions.max(axis=0))
        relative = mesh.positions - self._center
        self._radius = 1.0001 * float(np.linalg.norm(relative, axis=1).max())
        self._scene: Any = EmbreeScene()
        scaled = np.ascontiguousarray(relative / self._radius, np.float32)
        self._mesh = TriangleMesh(self._scene, scaled, np.ascontiguousarray(mesh.faces, np.int32))

    def first_hits(self, origins: ArrayLike, rays: Array) -> Hits:
        """What rays [R,3] from origins [3] or [R,3] meet first."""
        start = np.broadcast_to((np.asarray(origins, np.float64) - self._center) / self._radius, rays.shape)
        along = -np.sum(start * rays, axis=1)
        closest = np.sum((start + along[:, None] * rays) ** 2, axis=1)
        near = np.maximum(0.0, along - np.sqrt(np.maximum(0.0, 1.0 - closest)))
        meets = (closest <= 1.0) & ((along > 0.0) | (np.sum(start**2, axis=1) < 1.0))
        faces = np.full(len(rays), -1, np.int64)
        barycentric = np.zeros((len(rays), 2))
        if meets.any():
            entry = np.ascontiguousarray((start + near[:, None] * rays)[meets], np.float32)
            found = self._scene.run(entry, np.ascontiguousarray(rays[meets], np.float32), output=True)
            faces[meets] = found["primID"]
            barycentric[meets] = np.stack([found["u"], found["v"]], axis=1)
        return Hits(faces, barycentric)
