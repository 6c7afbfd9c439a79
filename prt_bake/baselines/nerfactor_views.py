"""Pictures that a NeRFactor learns from: path-traced views of a scene under one sky, and what lights their pixels."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from formats.scene import Scene
from prt_bake.baselines.lit_surface import LitSurface
from prt_bake.geometry.camera import Camera, Visibility, rays
from prt_bake.lights.environment import direction_of
from prt_bake.lights.lighting import Lighting
from prt_bake.mathematics.sphere import fibonacci
from prt_bake.rendering.scene import render_scene

Array = NDArray[np.float64]

_FOV = 30.0
_MARGIN = 1.05
_COVERED = 0.999


@dataclass(frozen=True)
class LightPixels:
    """The pixels of a small lat-long picture, P = rows · columns: directions [P,3] and solid angles [P,1]."""

    directions: Array
    solid_angles: Array
    shape: tuple[int, int]


class View(NamedTuple):
    """The R pixels of a view that lie on the object.

    positions, outgoing, normals [R,3]; visible: V(x, ωi) for the P pixels of the light, packed in bits [R,P/8];
    radiance [R,3].
    """

    positions: Array
    outgoing: Array
    normals: Array
    visible: NDArray[np.uint8]
    radiance: Array

    def rays(self, rows: Any, light: LightPixels) -> tuple[Tensor, Tensor, Tensor]:
        """What `NeRFactor.lobe` needs of some pixels: cosines [n,P], n·ωo [n,1] and ωi·ωo [n,P]."""
        normals, outgoing, pixels = self.normals[rows], self.outgoing[rows], len(light.directions)
        lit = np.unpackbits(self.visible[rows], axis=1, count=pixels)
        cosines = np.maximum(normals @ light.directions.T, 0.0) * lit
        eye = np.einsum("nc,nc->n", normals, outgoing)[:, None]
        arrays = (cosines, eye, outgoing @ light.directions.T)
        cosines_of, eye_of, between = (torch.from_numpy(array.astype(np.float32)) for array in arrays)
        return cosines_of, eye_of, between


def light_pixels(shape: tuple[int, int], up: str) -> LightPixels:
    """The pixels of a lat-long picture of rows × columns."""
    rows, columns = shape
    v, u = np.meshgrid((np.arange(rows) + 0.5) / rows, (np.arange(columns) + 0.5) / columns, indexing="ij")
    edges = np.cos(np.pi * np.arange(rows + 1) / rows)
    angles = np.repeat(2.0 * np.pi / columns * (edges[:-1] - edges[1:]), columns)
    return LightPixels(direction_of(u.ravel(), v.ravel(), up), angles[:, None], shape)


def cameras(scene: Scene, count: int, size: int) -> list[Camera]:
    """Cameras all around the object that have all of it in the frame, `size` pixels wide and high."""
    center = scene.mesh.center
    radius = float(np.linalg.norm(scene.mesh.positions - center, axis=1).max())
    distance = _MARGIN * radius / np.sin(np.radians(0.5 * _FOV))
    above = np.array([0.0, 1.0, 0.0] if scene.up == "y" else [0.0, 0.0, 1.0])
    return [Camera(center + distance * towards, center, above, _FOV, size, size) for towards in fibonacci(count)]


def path_traced_views(
    scene: Scene,
    lighting: Lighting,
    lit: LitSurface,
    light: LightPixels,
    cameras: list[Camera],
    spp: int,
    seed: int,
    seconds: Callable[[int], float | None],
    follow: Callable[[float], None],
) -> tuple[list[View], int]:
    """A view for each camera, of at most `spp` walks per pixel and `seconds(n)` for view n, and the number of walks.

    Surface reflection and unscattered light, which Ŝ leaves out, are not in the pictures. A pixel stands for the point
    of the surface in its centre; pixels on the object's outline are left out.
    """
    visibility, views, walks = Visibility(scene.mesh), [], 0
    for number, camera in enumerate(cameras):
        limit = seconds(number)
        picture = render_scene(
            scene,
            lighting,
            camera,
            spp=spp,
            minutes=None if limit is None else limit / 60.0,
            seed=seed + number,
            background=False,
            shown="scattered",
        )
        walks += picture.walks
        views.append(_view(lit, light, visibility, camera, picture.image, picture.coverage))
        follow((number + 1) / len(cameras))
    return views, walks


def _view(
    lit: LitSurface,
    light: LightPixels,
    visibility: Visibility,
    camera: Camera,
    image: NDArray[np.float32],
    coverage: NDArray[np.float32],
) -> View:
    through = rays(camera, slice(0, camera.height), np.array([[0.5, 0.5]])).rows()
    hits = visibility.first_hits(through.origins, np.ascontiguousarray(through.directions))
    chosen = np.flatnonzero((hits.faces >= 0) & (coverage.ravel() > _COVERED))
    corners = lit.mesh.positions[np.asarray(lit.mesh.faces)[hits.faces[chosen]]]
    u, v = hits.barycentric[chosen, :1], hits.barycentric[chosen, 1:]
    positions = (1.0 - u - v) * corners[:, 0] + u * corners[:, 1] + v * corners[:, 2]
    outgoing = -through.directions[chosen]
    points = lit.points(positions, outgoing)
    packed = []
    for first in range(0, len(chosen), 256):
        some = points.select(slice(first, first + 256))
        incident = np.broadcast_to(light.directions, (len(some.normals), *light.directions.shape))
        packed.append(np.packbits(lit.visible(some, incident), axis=1))
    visible = np.concatenate(packed) if packed else np.zeros((0, -(-len(light.directions) // 8)), np.uint8)
    radiance = image.reshape(-1, 3)[chosen].astype(np.float64)
    return View(positions, outgoing, points.normals, visible, radiance)
