"""Pictures of the surface reflection and the background, which are added to subsurface light."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from formats.scene import Scene
from prt_bake.geometry.camera import Camera, Visibility, directions
from prt_bake.lights.lighting import Lighting
from prt_bake.mathematics.random import hashed, uniforms
from prt_bake.paper.artefacts import Stopped
from prt_bake.reflection.finish import surface_points
from prt_bake.reflection.reflector import Reflector

Array = NDArray[np.float64]

_PIXEL_STREAM, _REFLECTION_STREAM = 0xB0, 0xB1
_RAYS_AT_ONCE = 1 << 17


def surface_picture(
    scene: Scene, lighting: Lighting, view: Camera, spp: int, seed: int, stop: Callable[[], bool] = lambda: False
) -> NDArray[np.float32]:
    """Render the surface reflection and the sky behind the object [H,W,3], `spp` samples per pixel.

    The sum with a picture of subsurface light is the complete picture. Raises Stopped.
    """
    visibility = Visibility(scene.mesh)
    reflector = Reflector(scene.mesh, lighting, scene.eta, visibility)
    image = np.zeros((view.height, view.width, 3))
    step = max(1, _RAYS_AT_ONCE // view.width)
    for number in range(spp):
        if stop():
            raise Stopped("the surface reflection was stopped; the same command renders it again")
        sample = int(hashed(_PIXEL_STREAM, seed, number) >> np.uint64(1))
        for first in range(0, view.height, step):
            rows = slice(first, min(first + step, view.height))
            image[rows] += _rows(scene, lighting, view, visibility, reflector, rows, sample)
    return (image / spp).astype(np.float32)


def _rows(
    scene: Scene,
    lighting: Lighting,
    view: Camera,
    visibility: Visibility,
    reflector: Reflector,
    rows: slice,
    seed: int,
) -> Array:
    """Render one sample per pixel of some rows [R,W,3]."""
    pixels = np.arange(rows.start * view.width, rows.stop * view.width)
    offsets = uniforms((_PIXEL_STREAM, seed, pixels.astype(np.uint64)), 2).reshape(-1, view.width, 1, 2)
    rays = directions(view, rows, offsets).reshape(-1, 3)
    hits = visibility.first_hits(view.eye, rays)
    hit = np.flatnonzero(hits.faces >= 0)
    missed = np.flatnonzero(hits.faces < 0)
    faces, barycentric = hits.faces[hit], hits.barycentric[hit]
    radiance = np.zeros((len(rays), 3))
    radiance[missed] = lighting.radiance(rays[missed])
    points = surface_points(scene.mesh, faces, barycentric, -rays[hit], scene.parts[0].normals, scene.roughness)
    reflection_seed = int(hashed(_REFLECTION_STREAM, seed) >> np.uint64(1))
    radiance[hit] = reflector.reflected(points, pixels[hit].astype(np.uint64), reflection_seed)
    return radiance.reshape(-1, view.width, 3)
