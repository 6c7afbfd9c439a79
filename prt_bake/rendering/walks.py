"""Passes of the path-traced reference: one walk from every visible point of a scene."""

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from formats.scene import Scene
from prt_bake.lights.emitters import Connections, plan_light
from prt_bake.lights.lighting import Lighting, radiance
from prt_bake.mathematics.random import hashed, uniforms
from prt_bake.rendering.object_points import ObjectPoints
from prt_bake.tracer.light_samples import sample_exits, sample_transport
from prt_bake.tracer.prepared import has_unscattered, interface_kind, is_unrefracted, smooth_part
from prt_bake.tracer.surface.interface import MATCHED

Array = NDArray[np.float64]
Shown = Literal["all", "scattered", "unscattered"]
"""The light from under the surface. "scattered" is described by Ŝ, by networks and by assets."""

_LIGHT_STREAM, _TRANSPORT_STREAM, _EXIT_STREAM = 0x9D, 0x9E, 0x9F


class WalkTracer:
    """The `ObjectTracer` of a path-traced scene under a lighting."""

    points = 2
    """More passes of fewer points give a better estimate of the error."""
    samples = 2
    cost = 1

    def __init__(self, scene: Scene, lighting: Lighting, shown: Shown = "all") -> None:
        """Split the light into emitters that walks connect to, and light that walks meet when they leave."""
        self._scene, self._lighting, self._shown = scene, lighting, shown
        self._shows_unscattered = has_unscattered(scene) and shown != "scattered"
        self._plan = plan_light(lighting, connections(scene))
        self._unrefracted = is_unrefracted(scene)

    def radiance(self, points: ObjectPoints, seed: int) -> tuple[Array, int]:
        """As `ObjectTracer.radiance`; samples are walks."""
        total, walks = np.zeros((len(points.faces), 3)), 0
        if len(points.faces) and self._plan.emitters and self._shown != "unscattered":
            total += self._from_emitters(points, seed)
            walks += len(points.faces)
        rows = self._rows_with_exits(points.outgoing)
        if len(rows):
            exits = sample_exits(self._scene, *points.subset(rows), 1, _kernel_seed(seed, _EXIT_STREAM))
            directions, unscattered = exits.directions[:, 0], exits.unscattered[:, 0]
            light = radiance(self._plan.skies, self._plan.suns, directions)
            if self._shown == "unscattered":
                light[~unscattered] = 0.0
            light[unscattered] = 0.0 if self._shown == "scattered" else self._lighting.radiance(directions[unscattered])
            total[rows] += exits.throughput[:, 0] * light
            walks += len(rows)
        return total, walks

    def _from_emitters(self, points: ObjectPoints, seed: int) -> Array:
        """Radiance of walks that connect to one direction of each emitter."""
        incident, weights = np.zeros((2, len(points.faces), len(self._plan.emitters), 3))
        for i, emitter in enumerate(self._plan.emitters):
            incident[:, i], weights[:, i] = emitter.draw(uniforms((_LIGHT_STREAM, seed, i, points.keys), 3))
        kernel_seed = _kernel_seed(seed, _TRANSPORT_STREAM)
        received = sample_transport(self._scene, *points, incident, 1, kernel_seed)
        return np.asarray((received * weights).sum(axis=1))

    def _rows_with_exits(self, outgoing: Array) -> NDArray[np.int64]:
        """Rows of views [N,3] whose walks can meet light when they leave.

        These are all rows if scattered walks can meet light. If only unrefracted, unscattered light is left, these are
        the rows whose straight continuation meets light.
        """
        met_by_scattering = self._shown != "unscattered" and bool(self._plan.skies or self._plan.suns)
        if met_by_scattering or (self._shows_unscattered and not self._unrefracted):
            return np.arange(len(outgoing))
        if not self._shows_unscattered:
            return np.zeros(0, np.int64)
        return np.flatnonzero(self._lighting.radiance(-outgoing).any(axis=1))


def connections(scene: Scene) -> Connections | None:
    """Efficiency of connections in a scene; None behind a smooth interface, which allows none (`smooth_part`).

    The figures are rough fits to measurements on a lumpy ball of 4 to 15 mean free paths, alpha 0.02 to 0.3.
    """
    if smooth_part(scene) is not None:
        return None
    if interface_kind(scene) == MATCHED:
        return Connections(variance=0.8, cost=1.5)
    alpha = float(np.mean(scene.roughness))
    return Connections(variance=0.6 + 0.03 / alpha**1.7, cost=4.0)


def _kernel_seed(seed: int, stream: int) -> int:
    return int(hashed(stream, seed) >> np.uint64(1))
