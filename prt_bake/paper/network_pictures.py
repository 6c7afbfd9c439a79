"""Net: pictures of the network, rendered by Monte Carlo."""

import os
from collections.abc import Callable
from pathlib import Path

from formats.image import write_image
from formats.mesh import Mesh
from prt_bake.geometry.camera import Camera
from prt_bake.importance.module import load_importance
from prt_bake.lights.lighting import Lighting
from prt_bake.network.bssrdf import load_model
from prt_bake.paper.artefacts import Artefact, Facts, Stopped
from prt_bake.rendering.mixture import Sampling


def render_network_picture(
    path: Path,
    model: Artefact,
    importance_of: Path | None,
    mesh: Mesh,
    lighting: Lighting,
    view: Camera,
    spp: int,
    sampling: Sampling,
    seed: int,
    device: str,
    stop: Callable[[], bool],
    progress: Callable[[float], None],
) -> Facts:
    """Render the subsurface light alone into an .exr; return samples per pixel, seconds and relative noise.

    For "lobe" and "mis", `importance_of` is the model whose importance module is used. Raises Stopped if a stop was
    requested.
    """
    from prt_bake.rendering.network import render_network

    picture = render_network(
        load_model(model.path, device),
        mesh,
        lighting,
        view,
        spp,
        seed,
        sampling=sampling,
        importance=None if importance_of is None else load_importance(importance_of, device),
        background=False,
        device=device,
        workers=os.cpu_count() or 1,
        stop=stop,
        progress=progress,
    )
    if not picture.complete:
        raise Stopped(f"{path}: stopped after {picture.spp} samples per pixel; the same command renders it again")
    write_image(path, picture.image, layers={"error": picture.standard_error, "coverage": picture.coverage})
    facts = {"spp": picture.spp, "seconds": picture.seconds, "sampling": picture.sampling}
    return {**facts, "relative_noise": picture.relative_noise}
