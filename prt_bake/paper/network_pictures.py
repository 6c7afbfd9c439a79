"""Net: the network rendered by Monte Carlo; all that is asked of the renderer is asked here."""

from collections.abc import Callable
from pathlib import Path

from formats.image import write_image
from formats.mesh import Mesh
from prt_bake.camera import Camera
from prt_bake.lighting import Lighting
from prt_bake.network import load_model
from prt_bake.paper.artefacts import Artefact, Facts
from prt_bake.paper.quadrature import quadrature_picture


def network_picture(
    path: Path,
    model: Artefact,
    mesh: Mesh,
    lighting: Lighting,
    view: Camera,
    spp: int,
    sampling: str,
    seed: int,
    stop: Callable[[], bool],
    progress: Callable[[float], None],
) -> Facts:
    """A picture of the light from under the surface alone as an .exr; samples a pixel and seconds of rendering."""
    image = quadrature_picture(load_model(model.path), mesh, lighting, view, cells=spp, points=1)
    write_image(path, image)
    return {"spp": spp}
