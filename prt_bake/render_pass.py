"""One pass of a path-traced picture: every pixel seen through a few points of it, a walk from each.

A pass is named by a seed of its own, a pixel's numbers by the pixel's place: what a pass sees does not depend on which
rows are traced together, on threads, or on what was traced before.
"""

from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from formats.scene import Scene
from prt_bake.camera import Camera, Visibility, directions
from prt_bake.emitters import plan_light
from prt_bake.lighting import Lighting, radiance
from prt_bake.randomness import hashed, uniforms
from prt_bake.trainer.lit import connections, sees_straight_through, walk_lit, walk_out

Array = NDArray[np.float64]

POINTS = 2
"""Points of a pixel in a pass. Passes are independent, so that more passes of fewer points tell the error better."""
_PIXEL_STREAM, _LIGHT_STREAM, _LIT_STREAM, _EXIT_STREAM = 0x9C, 0x9D, 0x9E, 0x9F
_RAYS_AT_ONCE = 1 << 17
_GOLDEN = np.array([0.7548776662466927, 0.5698402909980532])


class PassTracer:
    """A scene under a lighting as a camera sees it, ready to be traced pass by pass."""

    def __init__(self, scene: Scene, lighting: Lighting, camera: Camera, background: bool) -> None:
        """Build the camera's tree and split the light into what is connected to and what walks must find."""
        self._scene, self._lighting, self._camera, self._background = scene, lighting, camera, background
        self._visibility = Visibility(scene.mesh)
        self._plan = plan_light(lighting, connections(scene))
        self._straight = sees_straight_through(scene)

    def trace(self, seed: int, follow: Callable[[float], None]) -> Iterator[tuple[slice, Array, Array, int]]:
        """Rows of a pass, one batch after another: (rows, radiance [R,W,3], coverage [R,W], walks).

        `follow` is told the share of the pass that is done.
        """
        height, width = self._camera.height, self._camera.width
        step = max(1, _RAYS_AT_ONCE // (width * POINTS))
        for first in range(0, height, step):
            rows = slice(first, min(first + step, height))
            yield rows, *self._trace_rows(rows, seed)
            follow(rows.stop / height)

    def _trace_rows(self, rows: slice, seed: int) -> tuple[Array, Array, int]:
        pixels = np.arange(rows.start * self._camera.width, rows.stop * self._camera.width)
        rays = directions(self._camera, rows, _offsets(pixels.reshape(-1, self._camera.width), seed)).reshape(-1, 3)
        keys = (pixels[:, None] * POINTS + np.arange(POINTS)).ravel().astype(np.uint64)
        hits = self._visibility.first_hits(self._camera.eye, rays)
        met, missed = np.flatnonzero(hits.faces >= 0), np.flatnonzero(hits.faces < 0)
        seen = np.zeros((len(rays), 3))
        if self._background:
            seen[missed] = self._lighting.radiance(rays[missed])
        seen[met], walks = self._object(hits.faces[met], hits.barycentric[met], -rays[met], keys[met], seed)
        shape = (-1, self._camera.width, POINTS)
        return seen.reshape(*shape, 3).mean(axis=2), (hits.faces >= 0).reshape(shape).mean(axis=2), walks

    def _object(
        self, faces: NDArray[np.int64], barycentric: Array, outgoing: Array, keys: NDArray[np.uint64], seed: int
    ) -> tuple[Array, int]:
        """Radiance [N,3] that leaves the object at points towards the eye, and the walks it took."""
        total, walks = np.zeros((len(faces), 3)), 0
        if len(faces) and self._plan.emitters:
            total += self._connected(faces, barycentric, outgoing, keys, seed)
            walks += len(faces)
        leaving = np.arange(len(faces)) if self._plan.skies or self._plan.suns else self._lit_straight(outgoing)
        if len(leaving):
            where = faces[leaving], barycentric[leaving], outgoing[leaving], keys[leaving]
            exits = walk_out(self._scene, *where, 1, _kernel_seed(seed, _EXIT_STREAM))
            towards, unscattered = exits.directions[:, 0], exits.unscattered[:, 0]
            light = radiance(self._plan.skies, self._plan.suns, towards)
            light[unscattered] = self._lighting.radiance(towards[unscattered])
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
        received, _square = walk_lit(self._scene, faces, barycentric, outgoing, keys, incident, 1, lit_seed)
        return np.asarray((received * weights).sum(axis=1))

    def _lit_straight(self, outgoing: Array) -> NDArray[np.int64]:
        """Which views meet light straight through the object, where nothing else is left for walks to find."""
        if not self._straight:
            return np.zeros(0, np.int64)
        return np.flatnonzero(self._lighting.radiance(-outgoing).any(axis=1))


def pass_seed(seed: int, number: int) -> int:
    """The seed of one pass of a picture."""
    return int(hashed(_PIXEL_STREAM, seed, number) >> np.uint64(1))


def _kernel_seed(seed: int, stream: int) -> int:
    return int(hashed(stream, seed) >> np.uint64(1))


def _offsets(pixels: NDArray[np.int64], seed: int) -> Array:
    """Points of each pixel [R,W,S,2]: a rank-1 lattice of golden ratios (Roberts 2018), shifted at random."""
    shift = uniforms((_PIXEL_STREAM, seed, pixels), 2)
    return np.asarray((shift[:, :, None] + np.arange(POINTS)[:, None] * _GOLDEN) % 1.0)
