"""What walks tell of a scene in a picture: the reference, one walk from every point that is seen."""

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from formats.scene import Scene
from prt_bake.lights.emitters import plan_light
from prt_bake.lights.lighting import Lighting, radiance
from prt_bake.mathematics.random import hashed, uniforms
from prt_bake.tracer.light_samples import connections, sample_exits, sample_transport
from prt_bake.tracer.prepared import has_unscattered, is_unrefracted

Array = NDArray[np.float64]
Shown = Literal["all", "scattered", "unscattered"]
"""Of the light from under the surface: what has scattered is what Ŝ describes, networks know and assets hold."""

_LIGHT_STREAM, _LIT_STREAM, _EXIT_STREAM = 0x9D, 0x9E, 0x9F


class WalkTracer:
    """A scene under a lighting, path traced: an `ObjectTracer`."""

    points = 2
    """Passes are independent, so that more passes of fewer points tell the error better."""
    samples = 2
    cost = 1

    def __init__(self, scene: Scene, lighting: Lighting, shown: Shown = "all") -> None:
        """Split the light into what is connected to and what walks must find."""
        self._scene, self._lighting, self._shown = scene, lighting, shown
        self._crossed = has_unscattered(scene) and shown != "scattered"
        self._plan = plan_light(lighting, connections(scene))
        self._straight = is_unrefracted(scene)

    def radiance(
        self, faces: NDArray[np.int64], barycentric: Array, outgoing: Array, keys: NDArray[np.uint64], seed: int
    ) -> tuple[Array, int]:
        """As `ObjectTracer.radiance`; samples are walks."""
        total, walks = np.zeros((len(faces), 3)), 0
        if len(faces) and self._plan.emitters and self._shown != "unscattered":
            total += self._connected(faces, barycentric, outgoing, keys, seed)
            walks += len(faces)
        leaving = self._leaving(outgoing)
        if len(leaving):
            where = faces[leaving], barycentric[leaving], outgoing[leaving], keys[leaving]
            exits = sample_exits(self._scene, *where, 1, _kernel_seed(seed, _EXIT_STREAM))
            towards, unscattered = exits.directions[:, 0], exits.unscattered[:, 0]
            light = radiance(self._plan.skies, self._plan.suns, towards)
            if self._shown == "unscattered":
                light[~unscattered] = 0.0
            light[unscattered] = 0.0 if self._shown == "scattered" else self._lighting.radiance(towards[unscattered])
            total[leaving] += exits.throughput[:, 0] * light
            walks += len(leaving)
        return total, walks

    def _connected(
        self, faces: NDArray[np.int64], barycentric: Array, outgoing: Array, keys: NDArray[np.uint64], seed: int
    ) -> Array:
        """What walks receive from the emitters, one direction of each a walk."""
        incident, weights = np.zeros((2, len(faces), len(self._plan.emitters), 3))
        for i, emitter in enumerate(self._plan.emitters):
            incident[:, i], weights[:, i] = emitter.draw(uniforms((_LIGHT_STREAM, seed, i, keys), 3))
        lit_seed = _kernel_seed(seed, _LIT_STREAM)
        received, _square = sample_transport(self._scene, faces, barycentric, outgoing, keys, incident, 1, lit_seed)
        return np.asarray((received * weights).sum(axis=1))

    def _leaving(self, outgoing: Array) -> NDArray[np.int64]:
        """The views [N,3] from which walks must find light: all of them, those that meet some straight through the
        object where nothing else is left to find, or none.
        """
        found_by_scattering = self._shown != "unscattered" and bool(self._plan.skies or self._plan.suns)
        if found_by_scattering or (self._crossed and not self._straight):
            return np.arange(len(outgoing))
        if not self._crossed:
            return np.zeros(0, np.int64)
        return np.flatnonzero(self._lighting.radiance(-outgoing).any(axis=1))


def _kernel_seed(seed: int, stream: int) -> int:
    return int(hashed(stream, seed) >> np.uint64(1))
