"""Monte Carlo pictures of a network, comparable with those of the path tracer.

A network describes scattered light from under the surface, without unscattered light and without surface reflection.
Negative values of the network are not clamped, so that a picture is an unbiased estimate of the network's integral.
Negative pixels are reported, and clamped if a file format cannot store them.
"""

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from numpy.typing import ArrayLike

from bakers.plain_function import as_transport
from bakers.transport import on_mesh, refuse_foreign
from formats.errors import QueryError
from formats.mesh import Mesh
from prt_bake.geometry.camera import Camera, Visibility, refuse_eye_in_object
from prt_bake.importance.own_lobes import own_lobes
from prt_bake.jit.limits import limited_threads
from prt_bake.lights.lighting import Lighting, as_lighting
from prt_bake.network.inference.pairs import content_hash, pair_transport
from prt_bake.reflection.finish import Normals
from prt_bake.rendering.lobes import LobeModule, PixelLobes
from prt_bake.rendering.loop import (
    SHOWS_REFLECTION,
    Observers,
    Rendering,
    StopCriteria,
    accumulate,
    picture_identity,
    required_checkpoint,
)
from prt_bake.rendering.mixture import Mixture, Sampling
from prt_bake.rendering.network_pass import NetworkTracer
from prt_bake.rendering.passes import PassTracer
from prt_bake.rendering.pilot import choose_mixture, default_mixture
from prt_bake.rendering.state import stored_identity
from prt_bake.rendering.surface_reflection import SurfaceReflection, reflection_identity

SHOWS = "subsurface light of the network, unscattered light left out"
_METHOD = 2
"""Version of the numbers of a pass; older checkpoints cannot be resumed."""


def render_network(
    network: Any,
    mesh: Mesh,
    light: ArrayLike | Lighting,
    camera: Camera,
    spp: int | None = 256,
    seed: int = 0,
    *,
    sampling: Sampling | None = None,
    importance: LobeModule | None = None,
    up: str | None = None,
    rotate: float = 0.0,
    background: bool = True,
    reflection: bool = False,
    normals: Normals | None = None,
    precision: str = "float32",
    device: str = "cpu",
    workers: int = 1,
    error: float | None = None,
    minutes: float | None = None,
    checkpoint: Path | None = None,
    resume: bool = False,
    stop: Callable[[], bool] | None = None,
    progress: Callable[[float], None] | None = None,
    preview: Callable[[Rendering], None] | None = None,
    every: float = 10.0,
) -> Rendering:
    """Render `network` on its mesh under lights, a lat-long sky [H,W,3] or a `Lighting`, in passes.

    Args:
        network: a `NeuralBSSRDF`, or any object with evaluate(incident[N,D,3], positions[N,3], outgoing[N,3]), or a
            function of these.
        mesh: the object of the model.
        light: as in `prt_bake.render_scene`; `up` overrides the network's up axis for a sky.
        camera: the view.
        spp: directions of incidence per pixel (None: no limit).
        sampling: "light" samples the light, "lobe" the lobe of the importance module, "mis" a mixture of both that a
            short pilot optimises. The default is "mis" with an `importance` module or lobes, else "light".
        importance: an `ImportanceModule` of the network; without one, the lobes that the network may have itself.
        reflection: adds the light reflected at the surface, with eta and mean roughness of the network's metadata.
        normals: those of the reflection, as in `prt_bake.render_picture`.
        precision: "float32" or "bfloat16" for the matrix products of the network. device: "cpu" or "cuda".
        workers: threads; the result does not depend on their number.
        seed, background, rotate, error, minutes, checkpoint, resume, stop, progress, preview, every: as in
            `prt_bake.render_scene`.

    Returns:
        The picture with its standard error. `sampling` describes the mixture, `walks` counts evaluations. Directional
        lights without size are exact, and narrow ones get a separate direction at each point.

    Raises:
        QueryError: as `prt_bake.render_scene`; a mesh outside the network's box; "lobe" or "mis" without an importance
            module; a network without evaluate.
        FormatError: there is no such file to resume, or it belongs to another picture.

    >>> import prt_bake as prt
    >>> model, mesh = prt.load_model("spot.pt"), prt.read_mesh("spot.obj")
    >>> camera = prt.fit_camera(mesh, 32, 24)
    >>> picture = prt.render_network(model, mesh, prt.read_lighting("sky.hdr"), camera, spp=4)
    >>> picture.image.shape
    (24, 32, 3)
    """
    criteria = StopCriteria(spp, error, minutes, stop)
    if resume:
        required_checkpoint(checkpoint)
    network = as_transport(network)
    refuse_foreign(network, mesh)
    bound = on_mesh(network, mesh)
    importance = importance or own_lobes(bound)
    by = _sampling_method(sampling, importance)
    refuse_eye_in_object(mesh, camera.eye)
    metadata = dict(getattr(network, "metadata", None) or {})
    lighting = as_lighting(light, up or metadata.get("up", "y"), rotate)
    transport = pair_transport(bound, precision, device)
    start = time.perf_counter()
    with limited_threads(transport, 1):
        visibility = Visibility(mesh)
        tracer = NetworkTracer(transport, mesh, lighting, default_mixture(spp, by), None)
        if by != "light" and importance is not None and tracer.has_wide_lights:
            tracer.lobes = PixelLobes(importance, mesh, camera, visibility)
        surface = _surface(mesh, lighting, metadata, normals, visibility) if reflection else None
        passes = PassTracer(mesh, lighting, camera, background, tracer, workers, visibility, surface)
        stored = stored_identity(checkpoint) if resume and checkpoint is not None else {}
        if "mixture" in stored:
            tracer.set_mixture(Mixture.from_json(stored["mixture"]))
        elif by == "mis" and tracer.has_wide_lights:
            tracer.set_mixture(choose_mixture(passes, tracer, spp, seed))
        identity = picture_identity(
            lighting,
            camera,
            seed,
            background,
            reflection,
            **reflection_identity(surface),
            method=f"network {_METHOD}",
            mesh=mesh.content_hash,
            network=content_hash(network),
            precision=precision,
            sampling=by,
            mixture=tracer.mixture.as_json(),
            importance=content_hash(importance) if tracer.lobes is not None else "",
        )
        observers = Observers(progress, preview, every)
        spent = time.perf_counter() - start
        picture = accumulate(passes, camera, seed, criteria, identity, checkpoint, resume, observers, spent)
    description = {"by": by, **tracer.mixture.as_json(), "seconds before the first pass": spent, "precision": precision}
    return replace(picture, shows=SHOWS + (SHOWS_REFLECTION if reflection else ""), sampling=description)


def _surface(
    mesh: Mesh, lighting: Lighting, metadata: dict[str, Any], normals: Normals | None, visibility: Visibility
) -> SurfaceReflection:
    if "eta" not in metadata or "roughness" not in metadata:
        raise QueryError("reflection: the model's metadata lacks eta or roughness; render without reflection")
    return SurfaceReflection(mesh, lighting, metadata["eta"], metadata["roughness"], normals, visibility)


def _sampling_method(sampling: Sampling | None, importance: LobeModule | None) -> Sampling:
    by = sampling or ("light" if importance is None else "mis")
    if by not in ("light", "lobe", "mis"):
        raise QueryError(f'sampling: expected "light", "lobe" or "mis", found {by!r}')
    if by != "light" and importance is None:
        raise QueryError(
            f"sampling: {by!r} needs an importance module, and there is none; make one "
            '(prtbake importance MODEL.pt MESH) or sample by "light"'
        )
    return by
