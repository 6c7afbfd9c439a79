"""The same scenes in Mitsuba 3 (variant scalar_rgb), an independent renderer, one path at a time.

Under a directional emitter of unit irradiance the radiance is Ŝ. At a rough or smooth interface the first event is
sampled from the transmission lobe alone, since Ŝ excludes light reflected at x. Directional light cannot be connected
through a smooth boundary, so scenes with one are compared under a white sky.
"""

import tempfile
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from formats.scene import Scene
from prt_bake.export.mitsuba import mitsuba_dictionary

mi.set_variant("scalar_rgb")

LONGEST_SIDE = 100.0
"""Mitsuba offsets rays by about 1e-4 · (1 + |x|), relative to this size a third of that in a unit object."""
START = 1e-6
"""Paths start this far below x, in sides; Mitsuba's own offset would lengthen a thin chord at a grazing view by a
tenth."""


def transport(
    scene: Scene, position: np.ndarray, outgoing: np.ndarray, incident: np.ndarray, paths: int, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Mean [3] and standard error [3] of Ŝ from `paths` paths, for index-matched, rough and diffuse boundaries."""
    return _estimate(scene, position, outgoing, incident, paths, seed)


def under_white_sky(
    scene: Scene, position: np.ndarray, outgoing: np.ndarray, paths: int, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Mean [3] and standard error [3] of ∫ Ŝ dωi plus the unscattered light under a sky of radiance 1, for boundaries
    of any kind."""
    return _estimate(scene, position, outgoing, None, paths, seed)


def _scale(scene: Scene) -> float:
    low, high = scene.mesh.bounds
    return LONGEST_SIDE / float((high - low).max())


def load(scene: Scene, incident: np.ndarray | None) -> Any:
    """The scene in Mitsuba, centred at the origin and scaled to the longest side LONGEST_SIDE."""
    with tempfile.TemporaryDirectory() as folder:
        return mi.load_dict(mitsuba_dictionary(scene, Path(folder), incident=incident, scale=_scale(scene)))


def _estimate(
    scene: Scene, position: np.ndarray, outgoing: np.ndarray, incident: np.ndarray | None, paths: int, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    world = load(scene, incident)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed)
    integrator = world.integrator()
    scaled = (position - scene.mesh.center) * _scale(scene)
    hit = world.ray_intersect(mi.Ray3f((scaled + 1e-3 * LONGEST_SIDE * outgoing).tolist(), (-outgoing).tolist()))
    start = (scaled - START * LONGEST_SIDE * np.array(hit.n)).tolist()
    inside = hit.target_medium(-hit.n)
    values = np.empty((paths, 3))
    if scene.eta == 1.0:
        ray = mi.RayDifferential3f(mi.Ray3f(start, (-outgoing).tolist()))
        for path in range(paths):
            values[path] = integrator.sample(world, sampler, ray, inside, True)[0]
    else:
        bsdf, context = hit.bsdf(), mi.BSDFContext()
        context.component = 1
        for path in range(paths):
            sample, weight = bsdf.sample(context, hit, sampler.next_1d(), sampler.next_2d())
            towards = hit.to_world(sample.wo)
            if max(weight) == 0.0:
                values[path] = 0.0
                continue
            ray = mi.RayDifferential3f(mi.Ray3f(mi.Point3f(start), towards))
            values[path] = np.array(weight) * np.array(integrator.sample(world, sampler, ray, inside, True)[0])
    return values.mean(axis=0), values.std(axis=0, ddof=1) / np.sqrt(paths)
