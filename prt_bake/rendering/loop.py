"""Progressive rendering: passes are added until a picture is converged, out of time or stopped, with checkpoints."""

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from formats.errors import QueryError
from formats.image.single import single_precision
from formats.summary import summary
from prt_bake.geometry.camera import Camera
from prt_bake.lights.lighting import Lighting
from prt_bake.rendering.passes import pass_seed
from prt_bake.rendering.state import Sums, is_black, read_checkpoint, relative_noise, write_checkpoint

Array = NDArray[np.float64]

SHOWS_REFLECTION = ", light reflected at the surface"
_MIN_PASSES = 2
_MIN_PASSES_FOR_NOISE = 8
"""With fewer passes their variance is too uncertain to end the work."""
_MIN_PASSES_BLACK = 256
"""A picture without any light has no noise. After this many passes the object counts as black."""
_CHECKPOINT_SECONDS = 10.0
_CHECKPOINT_SHARE = 0.05
"""Largest share of the run time for checkpoints, and the same again for previews."""


@dataclass(frozen=True)
class Rendering:
    """A picture [H,W,3] in linear radiance, its standard error [H,W,3], the object's coverage [H,W], its cost.

    Attributes:
        standard_error: of each pixel, including the position of rays within the pixel; infinite after one pass. It is
            estimated from `passes` passes: error over standard error follows Student's t with passes − 1 degrees of
            freedom.
        walks: number of all walks; walks connected to lights and walks that leave towards a sky count separately. For a
            network: its evaluations.
        spp: walks of either kind per pixel, or directions of incidence.
        seconds: computing time, including earlier runs that were resumed.
        complete: whether the requested `spp` or `error` was reached (or the time, if neither was requested).
        history: rows (seconds, walks, relative noise) [rows,3].
        shows: the kinds of light in the picture, as text.
        sampling: how directions of incidence were sampled, plain JSON; empty for walks.
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

    __repr__ = summary

    @property
    def negative(self) -> float:
        """The negative radiance of the object over its positive radiance."""
        values = self.image[self.coverage > 0.0].astype(np.float64)
        positive = float(np.maximum(values, 0.0).sum())
        return float(-np.minimum(values, 0.0).sum()) / positive if positive > 0.0 else 0.0

    @property
    def black(self) -> bool:
        """Whether the object is visible and completely black."""
        return is_black(self.image, self.coverage)

    @property
    def speed(self) -> float:
        """Samples per pixel and second."""
        return self.spp / self.seconds if self.seconds > 0.0 else math.inf

    @property
    def relative_noise(self) -> float:
        """Root mean square of the standard error over the mean radiance, on the object."""
        return relative_noise(self.image, self.standard_error, self.coverage)


class Tracer(Protocol):
    """Traces independent passes of equal distribution."""

    @property
    def samples(self) -> int:
        """Samples of the light per pixel and pass."""

    def trace(self, seed: int, follow: Callable[[float], None]) -> Iterator[tuple[slice, Array, Array, int]]:
        """Yield the rows of a pass in batches: (rows, radiance [R,W,3], coverage [R,W], walks)."""


@dataclass(frozen=True)
class StopCriteria:
    """Limits of the work: samples per pixel, relative noise, minutes (None: no limit), or `stop` returning True.

    Raises QueryError if there is no limit, and for limits out of their domain.
    """

    spp: int | None
    error: float | None = None
    minutes: float | None = None
    stop: Callable[[], bool] | None = None

    def __post_init__(self) -> None:
        if self.spp is not None and self.spp < 2:
            raise QueryError(f"spp: expected at least 2 samples per pixel, found {self.spp}")
        if self.error is not None and not self.error > 0.0:
            raise QueryError(f"error: expected a relative noise above 0, found {self.error:g}")
        if self.minutes is not None and not self.minutes >= 0.0:
            raise QueryError(f"minutes: expected 0 or more, found {self.minutes:g}")
        if self.spp is None and self.error is None and self.minutes is None and self.stop is None:
            raise QueryError("spp, error, minutes: expected at least one of them to end the work, all are None")


@dataclass(frozen=True)
class Observers:
    """`progress` is called with the finished share, `preview` with the current picture every `every` seconds."""

    progress: Callable[[float], None] | None = None
    preview: Callable[[Rendering], None] | None = None
    every: float = 10.0


def picture_identity(
    lighting: Lighting, camera: Camera, seed: int, background: bool, reflection: bool, **further: Any
) -> dict[str, Any]:
    """Everything that determines the numbers of a pass: view, light, seed and further entries."""
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
    criteria: StopCriteria,
    identity: dict[str, Any],
    checkpoint: Path | None,
    resume: bool,
    observers: Observers,
    spent: float = 0.0,
) -> Rendering:
    """Add passes until a criterion holds. The file `checkpoint` keeps the sums, and `resume` continues from it.

    The file stays: the caller removes it when the picture is safe. `spent` are seconds of preparation that count as the
    picture's. Raises QueryError to resume without `checkpoint`, and FormatError if there is no such file, or if it has
    another `identity`.
    """
    sums = Sums.empty(camera.height, camera.width)
    if resume:
        sums = read_checkpoint(required_checkpoint(checkpoint), identity)
    goal = _Goal(criteria, tracer.samples, sums.seconds)
    sums.seconds += spent
    writer, progress = _CheckpointWriter(checkpoint, identity, criteria), observers.progress
    preview_timer = _Timer(observers.every)
    while not goal.ended(sums):
        _add_pass(tracer, sums, seed, lambda share: None if progress is None else progress(goal.share(sums, share)))
        writer.update(sums)
        if observers.preview is not None and preview_timer.due():
            observers.preview(_picture(sums, tracer, complete=False))
            preview_timer.restart()
    sums.add_to_history()
    complete = goal.reached(sums) or (goal.only_time and goal.out_of_time(sums))
    if not complete:
        writer.write(sums)
    return _picture(sums, tracer, complete)


def required_checkpoint(checkpoint: Path | None) -> Path:
    """The file to resume from. Raises QueryError if none is given."""
    if checkpoint is None:
        raise QueryError("resume: expected checkpoint, the file of the stopped picture, found none; give checkpoint")
    return checkpoint


def _picture(sums: Sums, tracer: Tracer, complete: bool) -> Rendering:
    return Rendering(
        single_precision(sums.mean(), "picture"),
        sums.standard_error().astype(np.float32),
        sums.mean_coverage().astype(np.float32),
        sums.walks,
        sums.seconds,
        sums.passes * tracer.samples,
        sums.passes,
        complete,
        np.array(sums.history).reshape(-1, 3),
    )


def _add_pass(tracer: Tracer, sums: Sums, seed: int, follow: Callable[[float], None]) -> None:
    start = time.perf_counter()
    for rows, radiance, coverage, walks in tracer.trace(pass_seed(seed, sums.passes), follow):
        sums.add(rows, radiance, coverage)
        sums.walks += walks
    sums.passes += 1
    sums.seconds += time.perf_counter() - start
    if sums.passes >= _MIN_PASSES and sums.passes & (sums.passes - 1) == 0:
        sums.add_to_history()


class _Goal:
    """Whether a picture is finished: enough walks, low enough noise, or no time left."""

    def __init__(self, criteria: StopCriteria, samples: int, seconds_before: float) -> None:
        self._passes = math.inf if criteria.spp is None else max(_MIN_PASSES, -(-criteria.spp // samples))
        self._error, self._stop = criteria.error, criteria.stop
        self._seconds = math.inf if criteria.minutes is None else 60.0 * criteria.minutes
        self._before = seconds_before
        self.only_time = criteria.spp is None and criteria.error is None

    def ended(self, sums: Sums) -> bool:
        if sums.passes == 0:
            return False
        if self._stop is not None and self._stop():
            return True
        return sums.passes >= _MIN_PASSES and (self.out_of_time(sums) or self.reached(sums))

    def out_of_time(self, sums: Sums) -> bool:
        return sums.seconds - self._before >= self._seconds

    def reached(self, sums: Sums) -> bool:
        if sums.passes >= self._passes:
            return True
        if self._error is None or sums.passes < _MIN_PASSES_FOR_NOISE:
            return False
        return sums.relative_noise() <= self._error and (not sums.is_black() or sums.passes >= _MIN_PASSES_BLACK)

    def share(self, sums: Sums, share_of_pass: float) -> float:
        """The estimated finished share, in [0, 1]."""
        passes = (sums.passes + share_of_pass) / self._passes
        clock = (sums.seconds - self._before) / self._seconds if self._seconds > 0.0 else 0.0
        noise = 0.0
        if self._error is not None and sums.history and sums.passes >= _MIN_PASSES and sums.walks:
            _seconds, walks, last = sums.history[-1]
            noise = sums.walks / walks * (self._error / last) ** 2 if last > 0.0 else 1.0
        return min(1.0, max(passes, clock, noise))


class _Timer:
    """Paces an action: at most every `seconds`, and for at most a small share of the run time."""

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds
        self._due = time.monotonic() + seconds
        self._started = 0.0

    def due(self) -> bool:
        self._started = time.monotonic()
        return self._started >= self._due

    def restart(self) -> None:
        now = time.monotonic()
        self._due = now + max(self._seconds, (now - self._started) / _CHECKPOINT_SHARE)


class _CheckpointWriter:
    def __init__(self, path: Path | None, identity: dict[str, Any], criteria: StopCriteria) -> None:
        self._path, self._identity = path, identity
        self._limits = {"spp": criteria.spp, "error": criteria.error, "minutes": criteria.minutes}
        self._timer = _Timer(_CHECKPOINT_SECONDS)

    def update(self, sums: Sums) -> None:
        if self._timer.due():
            self.write(sums)
            self._timer.restart()

    def write(self, sums: Sums) -> None:
        if self._path is not None:
            write_checkpoint(self._path, sums, self._identity, self._limits)
