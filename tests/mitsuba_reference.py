"""The same scenes in Mitsuba 3 (variant scalar_rgb), an independent renderer, asked one path at a time.

A directional emitter of unit irradiance makes the radiance Ŝ itself. Behind a rough interface the first event is drawn
from the transmission lobe alone, since Ŝ leaves out light reflected at x.
"""

from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from formats.scene import Scene

mi.set_variant("scalar_rgb")


def _volume(value: ArrayLike, bounds: ArrayLike | None) -> dict[str, Any]:
    value = np.asarray(value, np.float64)
    if value.ndim < 3:
        return {"type": "constvolume", "value": {"type": "rgb", "value": np.broadcast_to(value, 3).tolist()}}
    grid = value[..., None] if value.ndim == 3 else value
    low, high = np.asarray(bounds, np.float64)
    return {
        "type": "gridvolume",
        "grid": mi.VolumeGrid(np.ascontiguousarray(grid, np.float32)),
        "raw": True,
        "wrap_mode": "clamp",
        "to_world": mi.ScalarTransform4f().translate(low.tolist()).scale((high - low).tolist()),
    }


def _load(scene: Scene, incident: np.ndarray) -> Any:
    matched = scene.eta == 1.0
    varies = np.ndim(scene.sigma_t) == 3 or np.ndim(scene.albedo) >= 3
    sigma_t = _volume(scene.sigma_t, scene.bounds) if varies else float(scene.sigma_t)
    medium = {
        "type": "heterogeneous" if varies else "homogeneous",
        "sigma_t": sigma_t,
        "albedo": _volume(scene.albedo, scene.bounds),
        "phase": {"type": "hg", "g": float(scene.phase_g)},
        "has_spectral_extinction": False,
    }
    bsdf = (
        {"type": "null"}
        if matched
        else {
            "type": "roughdielectric",
            "distribution": "ggx",
            "alpha": float(scene.roughness),
            "int_ior": float(scene.eta),
            "ext_ior": 1.0,
        }
    )
    shape = {"type": "ply", "filename": str(scene.mesh_path), "face_normals": True, "bsdf": bsdf, "interior": medium}
    light = {
        "type": "directional",
        "direction": (-incident).tolist(),
        "irradiance": {"type": "rgb", "value": [1.0] * 3},
    }
    integrator = {"type": "volpath", "max_depth": -1, "rr_depth": 2000}
    return mi.load_dict({"type": "scene", "integrator": integrator, "object": shape, "light": light})


def transport(
    scene: Scene, position: np.ndarray, outgoing: np.ndarray, incident: np.ndarray, paths: int, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Mean [3] and standard error [3] of Ŝ from `paths` paths.

    Paths are started by hand 1e-6 under x: Mitsuba's own offset of some 1e-4 lengthens a thin chord at a grazing view
    by a tenth.
    """
    world = _load(scene, incident)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed)
    integrator = world.integrator()
    hit = world.ray_intersect(mi.Ray3f((position + 1e-3 * outgoing).tolist(), (-outgoing).tolist()))
    begin = (position - 1e-6 * np.array(hit.n)).tolist()
    inside = hit.target_medium(-hit.n)
    values = np.empty((paths, 3))
    if scene.eta == 1.0:
        ray = mi.RayDifferential3f(mi.Ray3f(begin, (-outgoing).tolist()))
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
            ray = mi.RayDifferential3f(mi.Ray3f(mi.Point3f(begin), towards))
            values[path] = np.array(weight) * np.array(integrator.sample(world, sampler, ray, inside, True)[0])
    return values.mean(axis=0), values.std(axis=0, ddof=1) / np.sqrt(paths)
