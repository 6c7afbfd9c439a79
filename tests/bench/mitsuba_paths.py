"""Mitsuba's paths for one query of Ŝ, in batches whose spread gives the variance."""

import tempfile
import time
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from formats.scene import Scene
from prt_bake.export.mitsuba import mitsuba_dictionary

BATCHES = 32
_LONGEST_SIDE = 100.0
_START = 1e-6 * _LONGEST_SIDE


class MitsubaPaths:
    """A scene under a distant light, evaluated at points on its surface by one of Mitsuba's variants."""

    def __init__(self, scene: Scene, variant: str) -> None:
        self.variant = variant
        mi.set_variant(variant)
        low, high = scene.mesh.bounds
        self._center, self._scale = scene.mesh.center, _LONGEST_SIDE / float((high - low).max())
        self._matched = scene.eta == 1.0
        with tempfile.TemporaryDirectory() as folder:
            exported = mitsuba_dictionary(scene, folder, incident=[0.0, 0.0, 1.0], scale=self._scale)
            self._world = mi.load_dict(exported)
        self._parameters = mi.traverse(self._world)
        self._vectorised = variant.startswith("llvm")

    def batch_means(
        self, position: np.ndarray, outgoing: np.ndarray, incident: np.ndarray, paths: int, seed: int
    ) -> tuple[np.ndarray, float]:
        """Means [BATCHES,3] of `paths` paths each, and the CPU seconds of all of them."""
        mi.set_variant(self.variant)
        self._point_light(incident)
        start = (position - self._center) * self._scale
        width = BATCHES * paths if self._vectorised else 1
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(seed, width)
        began = time.process_time()
        if self._vectorised:
            radiance = self._sample(start, outgoing, sampler)
            channels = (radiance.x, radiance.y, radiance.z)
            sums = [dr.block_reduce(dr.ReduceOp.Add, channel, paths) for channel in channels]
            dr.eval(*sums)
            means = np.stack([np.array(channel) for channel in sums], axis=1) / paths
        else:
            means = np.array(
                [
                    np.mean([self._sample(start, outgoing, sampler) for _ in range(paths)], axis=0)
                    for _ in range(BATCHES)
                ]
            )
        return means, time.process_time() - began

    def _point_light(self, incident: np.ndarray) -> None:
        frame = mi.ScalarTransform4f().look_at([0.0] * 3, (-incident).tolist(), _across(incident))
        self._parameters["light.to_world"] = frame
        self._parameters.update()

    def _sample(self, start: np.ndarray, outgoing: np.ndarray, sampler: Any) -> Any:
        """Radiance that leaves the point; the path starts just below it, transmitted if there is an interface."""
        origin, towards = _opaque(mi.Point3f, start + 1e-3 * _LONGEST_SIDE * outgoing), _opaque(mi.Vector3f, -outgoing)
        medium = self._world.shapes()[0].interior_medium()
        integrator = self._world.integrator()
        hit = self._world.ray_intersect(mi.Ray3f(origin, towards))
        begin = _opaque(mi.Point3f, start) - _START * hit.n
        if self._matched:
            return integrator.sample(
                self._world, sampler, mi.RayDifferential3f(mi.Ray3f(begin, towards)), medium, True
            )[0]
        context = mi.BSDFContext()
        context.component = 1
        sample, weight = hit.bsdf().sample(context, hit, sampler.next_1d(), sampler.next_2d())
        ray = mi.RayDifferential3f(mi.Ray3f(begin, hit.to_world(sample.wo)))
        return weight * integrator.sample(self._world, sampler, ray, medium, True)[0]


def _opaque(kind: Any, value: np.ndarray) -> Any:
    """A vector that is not a constant of the compiled kernel, so that all queries share one kernel."""
    if mi.variant().startswith("scalar"):
        return kind(value.tolist())
    return kind(*[dr.opaque(mi.Float, float(number)) for number in value])


def _across(direction: np.ndarray) -> list[float]:
    axis = np.eye(3)[np.argmin(np.abs(direction))]
    return [float(x) for x in axis]
