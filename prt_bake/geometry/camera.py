"""Perspective and orthographic cameras, and ray casting for visibility.

Rays start where they enter the object's bounding ball, computed in float64. Embree traces them in float32 relative to
the centre of the bounding box and in units of the ball's radius. Distant cameras and objects far from the origin thus
lose no precision.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from formats import arguments
from formats.errors import QueryError
from formats.mesh import Mesh
from formats.mesh.geometry import MOST_COORDINATE

Array = NDArray[np.float64]

_AXES = {"y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
View = Literal["front", "back", "left", "right", "three-quarter", "three-quarter-back"]
_FROM: dict[View, tuple[float, float, float]] = {
    "front": (0.0, 0.0, 1.0),
    "back": (0.0, 0.0, -1.0),
    "left": (-1.0, 0.0, 0.0),
    "right": (1.0, 0.0, 0.0),
    "three-quarter": (0.43, 0.24, 0.87),
    "three-quarter-back": (-0.43, 0.24, -0.87),
}
"""Direction from the object to the eye with y up, as in glTF, whose front is +z. With z up, as in Blender, it is −y."""
_MARGIN = 1.08
_MOST_TURNS = 72
"""Between turns 5° apart the object stays within the margin."""
_MOST_PIXELS = 1 << 28
_CONTACT = 1e-4
"""An eye within this distance of the surface, in diagonals of the object, counts as on it."""


@dataclass(frozen=True, eq=False)
class Camera:
    """A camera in object space.

    Args:
        eye, target: points [3] in scene units.
        up: direction [3], normalised; a view straight along it uses another one.
        fov: vertical field of view in degrees.
        width, height: in pixels, which are square.
        extent: scene units from the lower to the upper edge of an orthographic picture, whose rays are parallel and
            start in the plane through the eye; None for a perspective camera.

    Raises QueryError for values that define no picture, and for more than 2^28 pixels.

    >>> import numpy as np
    >>> import prt_bake as prt
    >>> eye, target, up = np.array([0.0, 0.0, 5.0]), np.zeros(3), np.array([0.0, 1.0, 0.0])
    >>> prt.Camera(eye, target, up, fov=30.0, width=640, height=480).forward.tolist()
    [0.0, 0.0, -1.0]
    """

    eye: Array
    target: Array
    up: Array
    fov: float
    width: int
    height: int
    extent: float | None = None

    def __post_init__(self) -> None:
        for name in ("eye", "target", "up"):
            object.__setattr__(self, name, _point(getattr(self, name), name))
        length = float(np.linalg.norm(self.up))
        if length == 0.0 or np.array_equal(self.eye, self.target):
            raise QueryError(
                "camera: expected an eye off the target and an up that is not zero, found eye "
                f"{self.eye.tolist()}, target {self.target.tolist()} and up {self.up.tolist()}"
            )
        object.__setattr__(self, "up", self.up / length)
        for name in ("width", "height"):
            object.__setattr__(self, name, arguments.whole_number(name, getattr(self, name)))
        for name in ("fov",) if self.extent is None else ("fov", "extent"):
            object.__setattr__(self, name, arguments.real_number(name, getattr(self, name)))
        if self.width < 1 or self.height < 1:
            raise QueryError(f"camera: expected at least 1x1 pixels, found {self.width}x{self.height}")
        if self.width * self.height > _MOST_PIXELS:
            raise QueryError(f"camera: expected at most {_MOST_PIXELS:,} pixels, found {self.width}x{self.height}")
        if not 0.0 < self.fov < 180.0:
            raise QueryError(f"camera: expected a field of view between 0 and 180 degrees, found {self.fov:g}")
        if self.extent is not None and not 0.0 < self.extent <= MOST_COORDINATE:
            raise QueryError(
                f"camera: expected an extent above 0 and up to {MOST_COORDINATE:g} scene units, found {self.extent:g}"
            )

    @property
    def forward(self) -> Array:
        """Unit direction [3] of the view."""
        along = self.target - self.eye
        return np.asarray(along / np.linalg.norm(along))

    @property
    def axes(self) -> Array:
        """Unit vectors [3,3], as rows: to the right and upwards in the picture, and forward."""
        return np.stack([*_across(self.forward, self.up), self.forward])

    def towards(self, positions: ArrayLike) -> Array:
        """Directions [N,3] from points [N,3] to the eye, not normalised; all equal for an orthographic camera."""
        points = np.asarray(positions, np.float64)
        return self.eye - points if self.extent is None else np.broadcast_to(-self.forward, points.shape)


class Rays(NamedTuple):
    """Rays [...]: origins [3] or [...,3], unit directions [...,3]."""

    origins: Array
    directions: Array

    def rows(self) -> "Rays":
        """The rays in one axis: origins [3] or [R,3], directions [R,3]."""
        return Rays(
            self.origins if self.origins.ndim == 1 else self.origins.reshape(-1, 3), self.directions.reshape(-1, 3)
        )


@dataclass(frozen=True)
class Hits:
    """First hits of R rays: faces int64 [R] (−1: none), barycentric (u, v) [R,2]."""

    faces: NDArray[np.int64]
    barycentric: Array


def fit(
    mesh: Mesh,
    width: int = 640,
    height: int = 480,
    eye: ArrayLike | None = None,
    up: str = "y",
    fov: float = 30.0,
    *,
    view: View | None = None,
    target: ArrayLike | None = None,
    orthographic: bool = False,
    extent: float | None = None,
    turns: int = 1,
) -> Camera:
    """A camera that looks at `target`, by default the centre of the mesh.

    Without an `eye` the camera is placed where the object just fills the frame, on the side that `view` names: "front"
    (+z with y up, −y with z up), "back", "left" (−x), "right" (+x), "three-quarter" (from the front, the right and
    above, the default) or "three-quarter-back" (opposite to it, and above). An `orthographic` camera fits its frame
    to the object from any eye, unless `extent` is given. The object fits in all of `turns` views, evenly spaced around
    the up axis through the target.

    Raises QueryError for sizes, angles, axes, extents or eyes that define no picture, for an unknown `view`, and for a
    `view` beside an `eye`.

    >>> import prt_bake as prt
    >>> import trimesh
    >>> ball = trimesh.creation.icosphere()
    >>> mesh = prt.Mesh(ball.vertices, ball.faces, ball.vertex_normals)
    >>> prt.fit_camera(mesh, width=64, height=64, view="front").eye.round(1).tolist()
    [0.0, 0.0, 4.2]
    """
    if up not in _AXES:
        raise QueryError(f'camera: expected up to be "y" or "z", found {up!r}')
    if view is not None and eye is not None:
        raise QueryError(f"camera: expected a view or an eye, found both, {view!r} and {np.asarray(eye).tolist()}")
    center, above = mesh.center if target is None else _point(target, "target"), np.array(_AXES[up])
    towards = direction_of_view(view or "three-quarter", up)
    camera = Camera(center + towards if eye is None else _point(eye, "eye"), center, above, fov, width, height, extent)
    relative, aspect = mesh.positions - center, width / height
    if orthographic and extent is None:
        forward = camera.forward
        extents = (_extent_to_fit(rotated, -forward, above, aspect) for rotated in _rotated(relative, turns, above))
        camera = replace(camera, extent=max(extents))
    if eye is not None:
        return camera
    if camera.extent is not None:
        # Any distance at which the object is in front of the camera will do.
        nearest = max(float(np.max(rotated @ towards)) for rotated in _rotated(relative, turns, above))
        return replace(camera, eye=center + towards * (nearest + mesh.diagonal))
    distance = max(
        _distance_to_fit(rotated, towards, above, fov, aspect) for rotated in _rotated(relative, turns, above)
    )
    return replace(camera, eye=center + towards * distance)


def direction_of_view(view: View, up: str = "y") -> Array:
    """Unit direction [3] from the object to the eye of a view, with `up` "y" or "z".

    Raises QueryError for an unknown view.
    """
    if view not in _FROM:
        raise QueryError(f"camera: expected a view of {', '.join(_FROM)}, found {view!r}")
    x, y, z = _FROM[view]
    towards = np.array([x, y, z] if up == "y" else [x, -z, y])
    return np.asarray(towards / np.linalg.norm(towards))


def rays(camera: Camera, rows: slice, offsets: Array) -> Rays:
    """Rays [R,W,S] through the pixels of some rows.

    offsets: positions within the pixels in [0,1)², x to the right, y down; [S,2] for all or [R,W,S,2] per pixel.
    """
    return _through(camera, np.arange(camera.height)[rows, None, None], np.arange(camera.width)[:, None], offsets)


def pixel_rays(camera: Camera, pixels: NDArray[np.int64], offsets: Array) -> Rays:
    """Rays [N,S] through `pixels` [N], indexed row by row; offsets [N,S,2] as in `rays`."""
    rows, columns = np.divmod(pixels, camera.width)
    return _through(camera, rows[:, None], columns[:, None], offsets)


def directions(camera: Camera, rows: slice, offsets: Array) -> Array:
    """Unit directions [R,W,S,3] of `rays`."""
    return rays(camera, rows, offsets).directions


def _through(camera: Camera, rows: NDArray[np.int64], columns: NDArray[np.int64], offsets: Array) -> Rays:
    forward = camera.forward
    right, above = _across(forward, camera.up)
    half = np.tan(np.radians(camera.fov) / 2.0) if camera.extent is None else camera.extent / 2.0
    y = 1.0 - 2.0 * (rows + offsets[..., 1]) / camera.height
    x = (2.0 * (columns + offsets[..., 0]) / camera.width - 1.0) * camera.width / camera.height
    across = half * (x[..., None] * right + y[..., None] * above)
    if camera.extent is not None:
        return Rays(camera.eye + across, np.broadcast_to(forward, across.shape))
    towards = forward + across
    return Rays(camera.eye, np.asarray(towards / np.sqrt(np.einsum("...i,...i->...", towards, towards))[..., None]))


class Visibility:
    """Ray casting against a mesh by Embree."""

    def __init__(self, mesh: Mesh) -> None:
        """Build the acceleration structure."""
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        self._center = mesh.center
        relative = mesh.positions - self._center
        self._radius = 1.0001 * float(np.linalg.norm(relative, axis=1).max())
        self._scene: Any = EmbreeScene(robust=True)
        scaled = np.ascontiguousarray(relative / self._radius, np.float32)
        self._mesh = TriangleMesh(self._scene, scaled, np.ascontiguousarray(mesh.faces, np.int32))

    def first_hits(self, origins: ArrayLike, rays: Array) -> Hits:
        """First hits of rays with unit directions [R,3] from origins [3] or [R,3]; both sides of a face count."""
        start = (np.asarray(origins, np.float64) - self._center) / self._radius
        along = -np.sum(start * rays, axis=1)
        nearest = start + along[:, None] * rays
        closest = np.einsum("ri,ri->r", nearest, nearest)
        into_ball = np.maximum(0.0, along - np.sqrt(np.maximum(0.0, 1.0 - closest)))
        begins_inside = np.sum(start * start, axis=-1) < 1.0
        meets = np.flatnonzero((closest <= 1.0) & ((along > 0.0) | begins_inside))
        faces = np.full(len(rays), -1, np.int64)
        barycentric = np.zeros((len(rays), 2))
        if len(meets):
            towards = rays[meets]
            entry = (start if start.ndim == 1 else start[meets]) + into_ball[meets, None] * towards
            found = self._scene.run(entry.astype(np.float32), towards.astype(np.float32), output=True)
            faces[meets] = found["primID"]
            barycentric[meets] = np.stack([found["u"], found["v"]], axis=1)
        return Hits(faces, barycentric)


def refuse_eye_in_object(mesh: Mesh, eye: Array) -> None:
    """Raise QueryError if the eye [3] is inside the mesh or on it; assets describe views from outside only."""
    low, high = mesh.bounds
    contact = _CONTACT * mesh.diagonal
    if ((eye < low - contact) | (eye > high + contact)).any():
        return
    corners = mesh.positions[mesh.faces] - eye
    if _distance_to_faces(corners, mesh.face_normals) <= contact:
        raise QueryError(f"eye: expected a point off the surface, found {eye.tolist()} on the surface of the object")
    if abs(_winding_number(corners)) > 0.5:
        raise QueryError(f"eye: expected a point outside, found {eye.tolist()} inside the object; move the eye away")


def _point(value: ArrayLike, name: str) -> Array:
    point = np.array(arguments.numbers(name, value), np.float64)
    if point.shape != (3,) or not np.isfinite(point).all():
        found = point.tolist() if point.size <= 3 else f"shape {list(point.shape)}"
        raise QueryError(f"camera: expected three finite numbers for {name}, found {found}")
    if np.abs(point).max() > MOST_COORDINATE:
        raise QueryError(
            f"camera: expected three numbers within ±{MOST_COORDINATE:g} for {name}, found {point.tolist()}; bring it "
            "nearer, or widen the field of view that placed it there"
        )
    return point


def _rotated(positions: Array, turns: int, above: Array) -> Iterator[Array]:
    """Positions, relative to the target, after each of `turns` even rotations about the unit axis `above`."""
    upright = np.outer(positions @ above, above)
    level, sideways = positions - upright, np.cross(above, positions)
    count = min(turns, _MOST_TURNS)
    for angle in 2.0 * np.pi * np.arange(count) / count:
        yield positions if angle == 0.0 else upright + np.cos(angle) * level + np.sin(angle) * sideways


def _extent_to_fit(positions: Array, view: Array, up: Array, aspect: float) -> float:
    """Extent that contains all positions, relative to the target, with a margin."""
    right, above = _across(-view, up)
    return float(2.0 * _MARGIN * np.maximum(np.abs(positions @ above), np.abs(positions @ right) / aspect).max())


def _distance_to_fit(positions: Array, view: Array, up: Array, fov: float, aspect: float) -> float:
    """Distance along `view` at which all positions, relative to the target, are in the frame."""
    right, above = _across(-view, up)
    half = np.tan(np.radians(fov) / 2.0)
    depth = positions @ view
    needed = np.maximum(np.abs(positions @ above) / half, np.abs(positions @ right) / (half * aspect))
    return float(np.max(depth + _MARGIN * needed))


def _across(forward: Array, up: Array) -> tuple[Array, Array]:
    """Unit vectors to the right and upwards in the image plane; a view along `up` uses another up."""
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 1e-9:
        right = np.cross(forward, np.eye(3)[np.argmin(np.abs(forward))])
    right /= np.linalg.norm(right)
    return right, np.cross(right, forward)


def _distance_to_faces(corners: Array, normals: Array) -> float:
    """Distance from the origin to the nearest of faces with corners [F,3,3] and unit normals [F,3]."""
    edges = np.roll(corners, -1, axis=1) - corners
    # Edges of no length are points.
    length = np.maximum(np.einsum("fki,fki->fk", edges, edges), np.finfo(np.float64).tiny)
    share = -np.einsum("fki,fki->fk", corners, edges) / length
    to_edges = np.linalg.norm(corners + np.clip(share, 0.0, 1.0)[..., None] * edges, axis=2)
    sides = np.einsum("fki,fi->fk", np.cross(corners, edges), normals)
    over_face = (sides >= 0.0).all(axis=1) & normals.any(axis=1)  # faces without area have edges alone
    heights = np.abs(np.einsum("fi,fi->f", corners[:, 0], normals)[over_face])
    return float(min(to_edges.min(), heights.min(initial=np.inf)))


def _winding_number(corners: Array) -> float:
    """Winding number of faces with corners [F,3,3] about the origin: ±1 inside a closed surface, 0 outside.

    It is the sum of the faces' solid angles over 4π (Van Oosterom and Strackee 1983; Jacobson et al. 2013).
    """
    a, b, c = np.moveaxis(corners, 1, 0)
    length = np.linalg.norm(corners, axis=2)
    triple = np.einsum("fi,fi->f", a, np.cross(b, c))
    denominator = length.prod(axis=1)
    for first, second, other in ((a, b, 2), (b, c, 0), (c, a, 1)):
        denominator += np.einsum("fi,fi->f", first, second) * length[:, other]
    return float(np.arctan2(triple, denominator).sum() / (2.0 * np.pi))
