"""Pictures of a network by Monte Carlo: what the path tracer shows, as far as the network has learnt it.

A network knows light from under the surface alone: neither what crosses the object without scattering nor what the
surface reflects. Where it answers less than nothing it is taken at its word, so that a picture is the integral of the
network and its error is what it says; such pixels are told, and cut where a file cannot hold them.
"""

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from numpy.typing import ArrayLike

from bakers.transport import on_mesh, refuse_foreign
from formats.errors import QueryError
from formats.mesh import Mesh
from prt_bake.geometry.camera import Camera, Visibility, refuse_eye_in_object
from prt_bake.jit.limits import limited_threads
from prt_bake.lights.lighting import Lighting, as_lighting
from prt_bake.network.inference.pairs import content_hash, pair_transport
from prt_bake.rendering.lobes import LobeMaker, PixelLobes
from prt_bake.rendering.loop import SHOWS_REFLECTION, Ending, Rendering, Watching, accumulate, picture_identity
from prt_bake.rendering.mixture import Mixture, Sampling
from prt_bake.rendering.network_pass import NetworkTracer
from prt_bake.rendering.passes import PassTracer
from prt_bake.rendering.pilot import choose_mixture, plain_mixture
from prt_bake.rendering.state import begun_with
from prt_bake.rendering.surface_reflection import SurfaceReflection

SHOWS = "subsurface light of the network, unscattered light left out"
_METHOD = 2
"""Raised whenever a pass sees other numbers than it did."""


def render_network(
    network: Any,
    mesh: Mesh,
    light: ArrayLike | Lighting,
    camera: Camera,
    spp: int | None = 256,
    seed: int = 0,
    *,
    sampling: Sampling | None = None,
    importance: LobeMaker | None = None,
    up: str | None = None,
    rotate: float = 0.0,
    background: bool = True,
    reflection: bool = False,
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
        network: a `NeuralBSSRDF`, or anything with evaluate(incident[N,D,3], positions[N,3], outgoing[N,3]).
        mesh: the model's own object.
        light: as `prt_bake.render_scene` takes it; `up` overrides the network's up axis for a sky.
        spp: directions of incidence a pixel (None: no such limit).
        sampling: how they are drawn: "light" (where it is bright), "lobe" (where the importance module says that much
            comes through), or "mis", both, mixed as a short pilot finds best. By default "mis" where there is an
            `importance` module, else "light".
        importance: an `ImportanceModule` of the network.
        reflection: adds the light that the surface itself reflects, for the eta and the mean roughness that the
            network's metadata say.
        precision: "float32" or "bfloat16", of the network's matrix work; device: "cpu" or "cuda".
        workers: threads; no number depends on them.
        seed, background, rotate, error, minutes, checkpoint, resume, stop, progress, preview, every: as in
            `prt_bake.render_scene`.

    Returns:
        The picture, with its standard error; `sampling` says how it was sampled, `walks` counts evaluations.
        Directional lights without size are exact, narrow ones have a direction of their own at each point.

    Raises:
        QueryError: as `prt_bake.render_scene`; a mesh outside the network's box; "lobe" or "mis" without an importance
            module; a network without evaluate.
        FormatError: `resume` finds no state or another picture's.
    """
    ending = Ending(spp, error, minutes, stop)
    by = _way(sampling, importance)
    refuse_foreign(network, mesh)
    refuse_eye_in_object(mesh, camera.eye)
    metadata = dict(getattr(network, "metadata", None) or {})
    lighting = as_lighting(light, up or metadata.get("up", "y"), rotate)
    transport = pair_transport(on_mesh(network, mesh), precision, device)
    begun = time.perf_counter()
    with limited_threads(transport, 1):
        visibility = Visibility(mesh)
        tracer = NetworkTracer(transport, mesh, lighting, plain_mixture(spp, by), None)
        if by != "light" and importance is not None and tracer.spread:
            tracer.lobes = PixelLobes(importance, mesh, camera, visibility)
        surface = _surface(mesh, lighting, metadata, visibility) if reflection else None
        passes = PassTracer(mesh, lighting, camera, background, tracer, workers, visibility, surface)
        known = begun_with(checkpoint) if resume and checkpoint is not None else {}
        if "mixture" in known:
            tracer.mix(Mixture.from_json(known["mixture"]))
        elif by == "mis" and tracer.spread:
            tracer.mix(choose_mixture(passes, tracer, spp, seed))
        identity = picture_identity(
            lighting,
            camera,
            seed,
            background,
            reflection,
            method=f"network {_METHOD}",
            mesh=mesh.content_hash,
            network=content_hash(network),
            precision=precision,
            sampling=by,
            mixture=tracer.mixture.as_json(),
            importance=content_hash(importance) if tracer.lobes is not None else "",
        )
        watching = Watching(progress, preview, every)
        spent = time.perf_counter() - begun
        picture = accumulate(passes, camera, seed, ending, identity, checkpoint, resume, watching, spent)
    how = {"by": by, **tracer.mixture.as_json(), "seconds before the first pass": spent, "precision": precision}
    return replace(picture, shows=SHOWS + (SHOWS_REFLECTION if reflection else ""), sampling=how)


def _surface(mesh: Mesh, lighting: Lighting, metadata: dict[str, Any], visibility: Visibility) -> SurfaceReflection:
    if "eta" not in metadata or "roughness" not in metadata:
        raise QueryError("reflection: the model's metadata does not say eta and roughness; render without reflection")
    return SurfaceReflection(
        mesh, lighting, metadata["eta"], metadata["roughness"], metadata.get("normals") == "vertex", visibility
    )


def _way(sampling: Sampling | None, importance: LobeMaker | None) -> Sampling:
    by = sampling or ("light" if importance is None else "mis")
    if by not in ("light", "lobe", "mis"):
        raise QueryError(f'sampling: expected "light", "lobe" or "mis", found {by!r}')
    if by != "light" and importance is None:
        raise QueryError(
            f"sampling: {by!r} draws directions from an importance module, of which there is none; make it "
            '(prtbake importance MODEL.pt MESH) or sample by "light"'
        )
    return by
