"""How a picture grows pass by pass: until it is good enough, out of time or stopped, kept so that it can go on."""

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from formats.errors import QueryError
from prt_bake.geometry.camera import Camera
from prt_bake.lights.lighting import Lighting
from prt_bake.rendering.passes import pass_seed
from prt_bake.rendering.state import Sums, is_black, read_checkpoint, relative_noise, write_checkpoint

Array = NDArray[np.float64]

SHOWS_REFLECTION = ", light reflected at the surface"
_LEAST_PASSES = 2
_PASSES_TO_TRUST = 8
_PASSES_TO_STAY_BLACK = 256
"""An object on which no light was met is without noise. So many passes are asked for before it is taken to be black."""
"""Before so many passes their spread says too little for a picture to be called done."""
_CHECKPOINT_SECONDS = 10.0
_CHECKPOINT_SHARE = 0.05
"""Of the run time, at most, goes into writing checkpoints, and as much into previews."""


@dataclass(frozen=True)
class Rendering:
    """A picture [H,W,3] in linear radiance, its standard error [H,W,3], the object's coverage [H,W], its cost.

    Attributes:
        standard_error: one sigma of each pixel, where in the pixel the rays fell included; infinite after one pass. It
            is measured from `passes` passes: the ratio of error to sigma follows Student's t of passes − 1 degrees.
        walks: in all; those that are connected to lights and those that leave towards a sky are counted apart. Of a
            network: its evaluations.
        spp: walks of either kind a pixel, or directions of incidence.
        seconds: of computing, earlier runs that were resumed included.
        complete: whether `spp` or `error` as asked was reached (or the time, where neither was asked).
        history: rows (seconds, walks, relative noise) [rows,3].
        shows: what light the picture holds, in words.
        sampling: how directions of incidence were drawn, plain JSON; empty where walks were.
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
    shows: str = ""
    sampling: dict[str, Any] = field(default_factory=dict)

    @property
    def negative(self) -> float:
        """How much of the object's radiance is negative: the sum of what is below 0 over that of what is above."""
        seen = self.image[self.coverage > 0.0].astype(np.float64)
        above = float(np.maximum(seen, 0.0).sum())
        return float(-np.minimum(seen, 0.0).sum()) / above if above > 0.0 else 0.0

    @property
    def black(self) -> bool:
        """Whether the object is seen, and no light at all on it."""
        return is_black(self.image, self.coverage)

    @property
    def speed(self) -> float:
        """Samples a pixel a second."""
        return self.spp / self.seconds if self.seconds > 0.0 else math.inf

    @property
    def relative_noise(self) -> float:
        """Root mean square of the standard error over the mean radiance, on the object."""
        return relative_noise(self.image, self.standard_error, self.coverage)


class Tracer(Protocol):
    """Traces passes that are independent and alike."""

    @property
    def samples(self) -> int:
        """Of the light, a pixel and pass."""

    def trace(self, seed: int, follow: Callable[[float], None]) -> Iterator[tuple[slice, Array, Array, int]]:
        """Rows of a pass, one batch after another: (rows, radiance [R,W,3], coverage [R,W], walks)."""


@dataclass(frozen=True)
class Ending:
    """What ends the work: samples a pixel, a relative noise, minutes (None: no such limit), or `stop` coming true.

    Raises QueryError where nothing would, and for limits out of their domain.
    """

    spp: int | None
    error: float | None = None
    minutes: float | None = None
    stop: Callable[[], bool] | None = None

    def __post_init__(self) -> None:
        if self.spp is not None and self.spp < 2:
            raise QueryError(f"spp: {self.spp} samples a pixel where at least 2 are expected")
        if self.error is not None and not self.error > 0.0:
            raise QueryError(f"error: {self.error:g} where a relative noise above 0 is expected")
        if self.minutes is not None and not self.minutes >= 0.0:
            raise QueryError(f"minutes: {self.minutes:g} where 0 or more is expected")
        if self.spp is None and self.error is None and self.minutes is None and self.stop is None:
            raise QueryError("spp, error, minutes: all are None where at least one is expected, to end the work")


@dataclass(frozen=True)
class Watching:
    """Who looks on: `progress` is told the share done, `preview` shown the picture so far every `every` seconds."""

    progress: Callable[[float], None] | None = None
    preview: Callable[[Rendering], None] | None = None
    every: float = 10.0


def picture_identity(
    lighting: Lighting, camera: Camera, seed: int, background: bool, reflection: bool, **further: Any
) -> dict[str, Any]:
    """What decides the numbers of every pass: the view, the light, the seed, and what else is given."""
    view: list[Any] = [camera.eye.tolist(), camera.target.tolist(), camera.up.tolist(), camera.fov]
    view += [] if camera.extent is None else [camera.extent]
    return {
        "light": lighting.content_hash(),
        "size": [camera.width, camera.height],
        "camera": view,
        "seed": seed,
        "background": background,
        "reflection": reflection,
        **further,
    }


def accumulate(
    tracer: Tracer,
    camera: Camera,
    seed: int,
    ending: Ending,
    identity: dict[str, Any],
    checkpoint: Path | None,
    resume: bool,
    watching: Watching,
    spent: float = 0.0,
) -> Rendering:
    """Add passes until `ending`; the sums are kept in the file `checkpoint`, and with `resume` taken from there.

    That file stays: only who has the picture safe knows that there is nothing left to resume.

    `spent` are seconds of preparation that count as the picture's. Raises FormatError where there is no state to
    resume, or that of another picture: `identity` differs.
    """
    sums = Sums.empty(camera.height, camera.width)
    if resume and checkpoint is not None:
        sums = read_checkpoint(checkpoint, identity)
    goal = _Goal(ending, tracer.samples, sums.seconds)
    sums.seconds += spent
    keeper, progress = _Keeper(checkpoint, identity, ending), watching.progress
    shown = _Now(watching.every)
    while not goal.ended(sums):
        _add_pass(tracer, sums, seed, lambda share: None if progress is None else progress(goal.share(sums, share)))
        keeper.keep(sums)
        if watching.preview is not None and shown.due():
            watching.preview(_picture(sums, tracer, complete=False))
            shown.done()
    sums.note()
    complete = goal.reached(sums) or (goal.only_time and goal.out_of_time(sums))
    if not complete:
        keeper.write(sums)
    return _picture(sums, tracer, complete)


def _picture(sums: Sums, tracer: Tracer, complete: bool) -> Rendering:
    return Rendering(
        sums.mean().astype(np.float32),
        sums.standard_error().astype(np.float32),
        sums.covered().astype(np.float32),
        sums.walks,
        sums.seconds,
        sums.passes * tracer.samples,
        sums.passes,
        complete,
        np.array(sums.history).reshape(-1, 3),
    )


def _add_pass(tracer: Tracer, sums: Sums, seed: int, follow: Callable[[float], None]) -> None:
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

    def __init__(self, ending: Ending, samples: int, seconds_before: float) -> None:
        self._passes = math.inf if ending.spp is None else max(_LEAST_PASSES, -(-ending.spp // samples))
        self._error, self._stop = ending.error, ending.stop
        self._seconds = math.inf if ending.minutes is None else 60.0 * ending.minutes
        self._before = seconds_before
        self.only_time = ending.spp is None and ending.error is None

    def ended(self, sums: Sums) -> bool:
        if sums.passes == 0:
            return False
        if self._stop is not None and self._stop():
            return True
        return sums.passes >= _LEAST_PASSES and (self.out_of_time(sums) or self.reached(sums))

    def out_of_time(self, sums: Sums) -> bool:
        return sums.seconds - self._before >= self._seconds

    def reached(self, sums: Sums) -> bool:
        if sums.passes >= self._passes:
            return True
        if self._error is None or sums.passes < _PASSES_TO_TRUST:
            return False
        return sums.relative_noise() <= self._error and (not sums.is_black() or sums.passes >= _PASSES_TO_STAY_BLACK)

    def share(self, sums: Sums, share_of_pass: float) -> float:
        """How much is done [0, 1], as far as it can be told."""
        passes = (sums.passes + share_of_pass) / self._passes
        clock = (sums.seconds - self._before) / self._seconds if self._seconds > 0.0 else 0.0
        noise = 0.0
        if self._error is not None and sums.history and sums.passes >= _LEAST_PASSES and sums.walks:
            _seconds, walks, last = sums.history[-1]
            noise = sums.walks / walks * (self._error / last) ** 2 if last > 0.0 else 1.0
        return min(1.0, max(passes, clock, noise))


class _Now:
    """When something is due: after so many seconds, and never for more than a small share of the time."""

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds
        self._due = time.monotonic() + seconds
        self._begun = 0.0

    def due(self) -> bool:
        self._begun = time.monotonic()
        return self._begun >= self._due

    def done(self) -> None:
        now = time.monotonic()
        self._due = now + max(self._seconds, (now - self._begun) / _CHECKPOINT_SHARE)


class _Keeper:
    """Writes the checkpoint now and then."""

    def __init__(self, path: Path | None, identity: dict[str, Any], ending: Ending) -> None:
        self._path, self._identity = path, identity
        self._asked = {"spp": ending.spp, "error": ending.error, "minutes": ending.minutes}
        self._now = _Now(_CHECKPOINT_SECONDS)

    def keep(self, sums: Sums) -> None:
        if self._now.due():
            self.write(sums)
            self._now.done()

    def write(self, sums: Sums) -> None:
        if self._path is not None:
            write_checkpoint(self._path, sums, self._identity, self._asked)
