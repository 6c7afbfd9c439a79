"""Pictures by path tracing a scene under a sky: the reference that baked pictures are measured against.

What is shown is what Ŝ describes, light from under the surface, with the sky behind it; light that crosses the object
without scattering is in the picture too. Light reflected at the surface itself is not.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from formats.errors import QueryError
from formats.scene import Scene
from prt_bake import environment
from prt_bake.camera import Camera, Visibility, directions, refuse_eye_in_object
from prt_bake.randomness import uniforms
from prt_bake.trainer.exits import walk_exits

Array = NDArray[np.float64]

_PIXEL_STREAM = 0x9C
_PATHS_AT_ONCE = 1 << 19
_PATHS_A_POINT = 8
"""Walks from each point that a pixel's rays meet: aiming the camera anew costs more than walking again."""


@dataclass(frozen=True)
class Rendering:
    """A picture [H,W,3] in linear radiance, its standard error [H,W,3], the object's coverage [H,W], its cost.

    The standard error, one sigma, is that of the walks; where in a pixel rays fall is not in it, so that it holds for
    pixels the object covers wholly and says too little at its edge.
    """

    image: NDArray[np.float32]
    standard_error: NDArray[np.float32]
    coverage: NDArray[np.float32]
    walks: int
    seconds: float


def render_scene(
    scene: Scene,
    sky: NDArray[np.float32],
    camera: Camera,
    spp: int = 64,
    seed: int = 0,
    *,
    up: str | None = None,
    rotate: float = 0.0,
    background: bool = True,
    progress: Callable[[float], None] | None = None,
) -> Rendering:
    """Path trace `scene` under a lat-long sky [H,W,3] with `spp` walks a pixel; results depend on the seed alone.

    `up` overrides the scene's up axis for the sky, `rotate` turns the light (degrees, counter-clockwise seen from
    above). Raises QueryError below 2 walks a pixel, which have no error, and for an eye inside the object.
    """
    begun = time.perf_counter()
    if spp < 2:
        raise QueryError(f"spp: {spp} walks a pixel where at least 2 are expected")
    refuse_eye_in_object(scene.mesh, camera.eye)
    axis = up or scene.up
    turn = environment.rotation(rotate, axis)
    visibility = Visibility(scene.mesh)
    image = np.zeros((camera.height, camera.width, 3))
    error, coverage = np.zeros_like(image), np.zeros(image.shape[:2])
    points = max(1, spp // _PATHS_A_POINT)
    paths = -(-spp // points)
    rows_at_once = max(1, _PATHS_AT_ONCE // (camera.width * points * paths))
    walks = 0
    for first in range(0, camera.height, rows_at_once):
        rows = slice(first, min(first + rows_at_once, camera.height))
        mean, variance, covered, walked = _render_rows(
            scene, sky, camera, visibility, rows, points, paths, seed, axis, turn, background
        )
        image[rows], error[rows], coverage[rows] = mean, np.sqrt(variance), covered
        walks += walked
        if progress is not None:
            progress(rows.stop / camera.height)
    return Rendering(
        image.astype(np.float32),
        error.astype(np.float32),
        coverage.astype(np.float32),
        walks,
        time.perf_counter() - begun,
    )


def _render_rows(
    scene: Scene,
    sky: NDArray[np.float32],
    camera: Camera,
    visibility: Visibility,
    rows: slice,
    points: int,
    paths: int,
    seed: int,
    up: str,
    turn: Array,
    background: bool,
) -> tuple[Array, Array, Array, int]:
    """Mean and variance of the mean [R,W,3], coverage [R,W] and walks of some rows of pixels."""
    offsets = _pixel_offsets(points, seed)
    rays = directions(camera, rows, offsets)
    shape = rays.shape[:3]
    flat = rays.reshape(-1, 3)
    hits = visibility.first_hits(camera.eye, flat)
    met = np.flatnonzero(hits.faces >= 0)
    seen = np.zeros((len(flat), 3))
    if background:
        missed = np.flatnonzero(hits.faces < 0)
        seen[missed] = environment.lookup(sky, flat[missed] @ turn, up)
    noise = np.zeros((len(flat), 3))
    if len(met):
        first_key = rows.start * camera.width * points
        exits, throughput = walk_exits(
            scene, hits.faces[met], hits.barycentric[met], -flat[met], (first_key + met).astype(np.uint64), paths, seed
        )
        light = environment.lookup(sky, exits.reshape(-1, 3) @ turn, up).reshape(exits.shape)
        radiance = throughput * light
        seen[met] = radiance.mean(axis=1)
        noise[met] = radiance.var(axis=1, ddof=1) / paths
    seen, noise = seen.reshape(*shape, 3), noise.reshape(*shape, 3)
    covered = (hits.faces >= 0).reshape(shape).mean(axis=2)
    return seen.mean(axis=2), noise.sum(axis=2) / points**2, covered, len(met) * paths


def _pixel_offsets(points: int, seed: int) -> Array:
    """Points in the pixel [S,2]: a rank-1 lattice of golden ratios (Roberts 2018), shifted by the seed."""
    golden = np.array([0.7548776662466927, 0.5698402909980532])
    shift = uniforms((_PIXEL_STREAM, seed), 2)
    return np.asarray((shift + np.arange(points)[:, None] * golden) % 1.0)
