"""A path-traced reference that can be extended: a sum of many short renderings, saved after each of them.

The renderings are summed in two half buffers, which estimate the effect of the reference's noise on any figure
(`prt_bake.rendering.half_buffers`).
"""

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from formats.atomic import replacing
from formats.image import read_layers, write_image
from formats.json_report import as_line
from formats.npz import read_arrays
from formats.scene import Scene
from prt_bake.comparison.object_figures import TracedPicture
from prt_bake.geometry.camera import Camera
from prt_bake.lights.lighting import Lighting
from prt_bake.mathematics.random import hashed
from prt_bake.paper.artefacts import Artefact, Artefacts, Facts, Stopped
from prt_bake.rendering.half_buffers import HalfBuffers
from prt_bake.rendering.scene import Rendering, render_scene

Trace = Callable[[int, int, Path], Rendering]
"""trace(paths per pixel, seed, checkpoint): an independent picture; incomplete if it was stopped."""

_METHOD = 1
"""Version of the results; raised when the same settings give other numbers, which discards earlier references."""
_WALKS_AT_ONCE = 16
_LEAST_WALKS = 4
"""Fewest paths per pixel for which a picture has a standard error."""
_CHUNK_STREAM = 0x5EED


@dataclass(frozen=True)
class Reference(TracedPicture):
    """A reference with its file and its cost."""

    artefact: Artefact


def reference(
    artefacts: Artefacts,
    name: str,
    inputs: Facts,
    size: int,
    trace: Trace,
    spp: int | None,
    minutes: float | None,
) -> Reference:
    """Return the reference in the file `name` (.exr), extended until it has `spp` paths per pixel or took `minutes`.

    `inputs` identify the picture and contain neither spp nor minutes: a larger goal extends the saved sums, and a
    better reference than requested is used as it is. Raises Stopped; all finished renderings are kept.
    """
    inputs = {**inputs, "method": _METHOD}
    identity = hashlib.sha256(json.dumps(inputs, sort_keys=True, allow_nan=False).encode()).hexdigest()
    path = artefacts.folder / name
    sums_path = path.with_suffix(".sums.npz")
    halves = _read(sums_path, identity) or HalfBuffers.empty(size)
    if not _enough(halves, spp, minutes):
        artefacts.check()
        path.parent.mkdir(parents=True, exist_ok=True)
        artefacts.say(f"{name}: {_goal(spp, minutes)}, {halves.spp} paths per pixel exist")
    while not _enough(halves, spp, minutes):
        seed = int(hashed(_CHUNK_STREAM, inputs["seed"], halves.pictures) >> np.uint64(1))
        checkpoint = path.with_name(f"{path.stem}.{identity[:8]}.{halves.pictures}.render.npz")
        picture = trace(_walks(halves, spp), seed, checkpoint)
        if not picture.complete:
            raise Stopped(f"{name}: stopped after {halves.spp} paths per pixel; the same command resumes it")
        halves.add(picture)
        _write(sums_path, halves, identity)
        checkpoint.unlink(missing_ok=True)
        artefacts.say(f"{name}: {halves.spp} paths per pixel in {halves.seconds:.0f} s")
    artefact = artefacts.make(name, {**inputs, "pictures": halves.pictures, "walks": halves.walks}, _exr(halves))
    return _read_reference(artefact)


def trace_scene(
    scene: Scene, lighting: Lighting, view: Camera, stop: Callable[[], bool], progress: Callable[[float], None]
) -> Trace:
    """Return a path tracer of subsurface light alone: no reflection, no background, no unscattered transmission."""

    def trace(spp: int, seed: int, checkpoint: Path) -> Rendering:
        return render_scene(
            scene,
            lighting,
            view,
            spp,
            seed,
            background=False,
            shown="scattered",
            checkpoint=checkpoint,
            resume=checkpoint.is_file(),
            stop=stop,
            progress=progress,
        )

    return trace


def _enough(halves: HalfBuffers, spp: int | None, minutes: float | None) -> bool:
    if min(halves.passes) == 0:
        return False
    return (spp is None or halves.spp >= spp) and (minutes is None or halves.seconds >= 60.0 * minutes)


def _walks(halves: HalfBuffers, spp: int | None) -> int:
    """Return the paths per pixel of the next rendering, few enough that both half buffers get some."""
    return _WALKS_AT_ONCE if spp is None else max(_LEAST_WALKS, min(_WALKS_AT_ONCE, spp // 2))


def _goal(spp: int | None, minutes: float | None) -> str:
    goals = [f"{spp} paths per pixel" if spp is not None else "", f"{minutes:g} minutes" if minutes is not None else ""]
    return "path tracing " + " and ".join(goal for goal in goals if goal)


def _exr(halves: HalfBuffers) -> Callable[[Path], Facts]:
    def write(path: Path) -> Facts:
        layers = {
            "error": halves.standard_error,
            "noise": halves.noise,
            "coverage": halves.coverage / sum(halves.passes),
        }
        write_image(path, halves.image, layers=layers, attributes={"prtbake.spp": str(halves.spp)})
        return {"spp": halves.spp, "walks": halves.walks, "seconds": halves.seconds}

    return write


def _read_reference(artefact: Artefact) -> Reference:
    found = read_layers(artefact.path)
    error, noise, coverage = (found.layers[name] for name in ("error", "noise", "coverage"))
    return Reference(found.image, error, noise, coverage, artefact)


def _write(path: Path, halves: HalfBuffers, identity: str) -> None:
    numbers = {name: getattr(halves, name) for name in ("passes", "pictures", "spp", "walks", "seconds")}
    with replacing(path) as part, open(part, "wb") as file:
        np.savez(
            file,
            head=np.array(as_line({"identity": identity, "numbers": numbers})),
            radiance=halves.radiance,
            variance=halves.variance,
            coverage=halves.coverage,
        )


def _read(path: Path, identity: str) -> HalfBuffers | None:
    """Return the saved sums of the same picture; None if there are none or they cannot be read."""
    try:
        arrays = read_arrays(path)
        head = json.loads(str(arrays["head"]))
        if head["identity"] != identity:
            return None
        return HalfBuffers(arrays["radiance"], arrays["variance"], arrays["coverage"], **head["numbers"])
    except (ValueError, KeyError, TypeError):
        return None
