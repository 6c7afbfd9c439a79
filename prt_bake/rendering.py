"""Pictures by path tracing a scene under lights: the reference that baked pictures are measured against.

What is shown is what Ŝ describes, light from under the surface, with the sky behind it; light that crosses the object
without scattering is in the picture too. Light reflected at the surface itself is not.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from formats.errors import QueryError
from formats.scene import Scene
from prt_bake.camera import Camera, refuse_eye_in_object
from prt_bake.lighting import Lighting, as_lighting
from prt_bake.render_pass import POINTS, PassTracer, pass_seed
from prt_bake.render_state import Sums, read_checkpoint, relative_noise, write_checkpoint
from prt_bake.trainer.prepared import smooth_part

Array = NDArray[np.float64]

_METHOD = 1
"""Raised whenever a pass sees other numbers than it did: what was begun before cannot be resumed then."""
_LEAST_PASSES = 2
_PASSES_TO_TRUST = 8
"""Before so many passes their spread says too little for a picture to be called done."""
_CHECKPOINT_SECONDS = 10.0
_CHECKPOINT_SHARE = 0.05
"""Of the run time, at most, goes into writing checkpoints."""


@dataclass(frozen=True)
class Rendering:
    """A picture [H,W,3] in linear radiance, its standard error [H,W,3], the object's coverage [H,W], its cost.

    Attributes:
        standard_error: one sigma of each pixel, where in the pixel the rays fell included; infinite after one pass. It
            is measured from `passes` passes: the ratio of error to sigma follows Student's t of passes − 1 degrees.
        walks: in all; those that are connected to lights and those that leave towards a sky are counted apart.
        spp: walks of either kind a pixel.
        seconds: of computing, earlier runs that were resumed included.
        complete: whether `spp` or `error` as asked was reached (or the time, where neither was asked).
        history: rows (seconds, walks, relative noise) [rows,3].
    """

    image: NDArray[np.float32]
    standard_error: NDArray[np.float32]
    coverage: NDArray[np.float32]
    walks: int
    seconds: float
    spp: int
    passes: int
    complete: bool
    history: Array

    @property
    def relative_noise(self) -> float:
        """Root mean square of the standard error over the mean radiance, on the object."""
        return relative_noise(self.image, self.standard_error, self.coverage)


def render_scene(
    scene: Scene,
    light: ArrayLike | Lighting,
    camera: Camera,
    spp: int | None = 64,
    seed: int = 0,
    *,
    up: str | None = None,
    rotate: float = 0.0,
    background: bool = True,
    error: float | None = None,
    minutes: float | None = None,
    checkpoint: Path | None = None,
    resume: bool = False,
    stop: Callable[[], bool] | None = None,
    progress: Callable[[float], None] | None = None,
) -> Rendering:
    """Path trace `scene` under lights, a lat-long sky [H,W,3] or a `Lighting`, in passes of a few walks a pixel.

    It ends with the pass that reaches `spp` walks a pixel (None: no such limit), a relative noise of `error` (the root
    mean square of the standard error over the mean radiance, on the object), or `minutes`, or in which `stop` comes
    true. After the same number of passes the numbers are the same whatever ended them, and depend on the seed alone.

    `up` overrides the scene's up axis for the sky, `rotate` turns the light (degrees, counter-clockwise seen from
    above). The sums are kept in the file `checkpoint` now and then and when the work ends early; with `resume` they are
    taken from there; when the work is complete the file is removed.

    Raises QueryError below 2 walks a pixel, which have no error, for an eye inside the object, and for a directional
    light without size behind a smooth interface; FormatError where `resume` finds no state or another picture's.
    """
    _refuse_endless(spp, error, minutes, stop)
    refuse_eye_in_object(scene.mesh, camera.eye)
    lighting = as_lighting(light, up or scene.up, rotate)
    _refuse_unseen(scene, lighting)
    tracer = PassTracer(scene, lighting, camera, background)
    identity = _identity(scene, lighting, camera, seed, background)
    sums = Sums.empty(camera.height, camera.width)
    if resume and checkpoint is not None:
        sums = read_checkpoint(checkpoint, identity)
    goal = _Goal(spp, error, minutes, sums.seconds)
    keeper = _Keeper(checkpoint, identity)
    while not goal.ended(sums, stop):
        _add_pass(tracer, sums, seed, lambda share: None if progress is None else progress(goal.share(sums, share)))
        keeper.keep(sums)
    sums.note()
    complete = goal.reached(sums) or (goal.only_time and goal.out_of_time(sums))
    keeper.close(sums, complete)
    return Rendering(
        sums.mean().astype(np.float32),
        sums.standard_error().astype(np.float32),
        sums.covered().astype(np.float32),
        sums.walks,
        sums.seconds,
        sums.passes * POINTS,
        sums.passes,
        complete,
        np.array(sums.history).reshape(-1, 3),
    )


def _add_pass(tracer: PassTracer, sums: Sums, seed: int, follow: Callable[[float], None]) -> None:
    begun = time.perf_counter()
    for rows, radiance, coverage, walks in tracer.trace(pass_seed(seed, sums.passes), follow):
        sums.add(rows, radiance, coverage)
        sums.walks += walks
    sums.passes += 1
    sums.seconds += time.perf_counter() - begun
    if sums.passes >= _LEAST_PASSES and sums.passes & (sums.passes - 1) == 0:
        sums.note()


class _Goal:
    """When a picture is done: enough walks, little enough noise, or no time left."""

    def __init__(self, spp: int | None, error: float | None, minutes: float | None, seconds_before: float) -> None:
        self._passes = math.inf if spp is None else max(_LEAST_PASSES, -(-spp // POINTS))
        self._error = error
        self._seconds = math.inf if minutes is None else 60.0 * minutes
        self._before = seconds_before
        self.only_time = spp is None and error is None

    def ended(self, sums: Sums, stop: Callable[[], bool] | None) -> bool:
        if sums.passes == 0:
            return False
        if stop is not None and stop():
            return True
        return sums.passes >= _LEAST_PASSES and (self.out_of_time(sums) or self.reached(sums))

    def out_of_time(self, sums: Sums) -> bool:
        return sums.seconds - self._before >= self._seconds

    def reached(self, sums: Sums) -> bool:
        if sums.passes >= self._passes:
            return True
        trusted = sums.passes >= _PASSES_TO_TRUST
        return self._error is not None and trusted and sums.relative_noise() <= self._error

    def share(self, sums: Sums, share_of_pass: float) -> float:
        """How much is done [0, 1], as far as it can be told."""
        passes = (sums.passes + share_of_pass) / self._passes
        clock = (sums.seconds - self._before) / self._seconds if self._seconds > 0.0 else 0.0
        noise = 0.0
        if self._error is not None and sums.history and sums.passes >= _LEAST_PASSES and sums.walks:
            _seconds, walks, last = sums.history[-1]
            noise = sums.walks / walks * (self._error / last) ** 2 if last > 0.0 else 1.0
        return min(1.0, max(passes, clock, noise))


class _Keeper:
    """Writes the checkpoint now and then, and removes it when there is nothing left to resume."""

    def __init__(self, path: Path | None, identity: dict[str, Any]) -> None:
        self._path, self._identity = path, identity
        self._due = time.monotonic() + _CHECKPOINT_SECONDS

    def keep(self, sums: Sums) -> None:
        if self._path is None or time.monotonic() < self._due:
            return
        begun = time.monotonic()
        write_checkpoint(self._path, sums, self._identity)
        now = time.monotonic()
        self._due = now + max(_CHECKPOINT_SECONDS, (now - begun) / _CHECKPOINT_SHARE)

    def close(self, sums: Sums, complete: bool) -> None:
        if self._path is None:
            return
        if complete:
            self._path.unlink(missing_ok=True)
        else:
            write_checkpoint(self._path, sums, self._identity)


def _refuse_endless(
    spp: int | None, error: float | None, minutes: float | None, stop: Callable[[], bool] | None
) -> None:
    if spp is not None and spp < 2:
        raise QueryError(f"spp: {spp} walks a pixel where at least 2 are expected")
    if error is not None and not error > 0.0:
        raise QueryError(f"error: {error:g} where a relative noise above 0 is expected")
    if minutes is not None and not minutes >= 0.0:
        raise QueryError(f"minutes: {minutes:g} where 0 or more is expected")
    if spp is None and error is None and minutes is None and stop is None:
        raise QueryError("spp, error, minutes: all are None where at least one is expected, to end the work")


def _refuse_unseen(scene: Scene, lighting: Lighting) -> None:
    smooth = smooth_part(scene)
    if smooth is not None and any(sun.angular_diameter == 0.0 for sun in lighting.suns):
        raise QueryError(
            f"{scene.path}: behind the smooth interface of '{smooth.name}' no walk meets a directional light without "
            "size; give the light an angular diameter (the sun's is 0.53 degrees), or make the interface rough"
        )


def _identity(scene: Scene, lighting: Lighting, camera: Camera, seed: int, background: bool) -> dict[str, Any]:
    """All that decides what a pass sees."""
    view = [camera.eye.tolist(), camera.target.tolist(), camera.up.tolist(), camera.fov]
    return {
        "method": _METHOD,
        "scene": scene.content_hash,
        "light": lighting.content_hash(),
        "size": [camera.width, camera.height],
        "camera": view,
        "seed": seed,
        "background": background,
        "points a pass": POINTS,
    }
