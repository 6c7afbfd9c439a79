"""`prtbake render`: a picture by Monte Carlo, without any bake."""

from pathlib import Path
from typing import Annotated

import typer

from formats.errors import PrtbakeError
from prt_bake.cli.options import (
    IMAGE_SUFFIXES,
    Exposure,
    Eye,
    Light,
    Mend,
    PictureSize,
    ReportFile,
    Rotate,
    Seed,
    Size,
    Up,
    output_option,
)
from prt_bake.cli.progress import reporting, say


def render(
    context: typer.Context,
    source: Annotated[Path, typer.Argument(metavar="SOURCE", help="scene.toml (path traced).")],
    mesh: Annotated[Path, typer.Argument(metavar="MESH", help="What the camera is set up for, as in `prtbake shade`.")],
    light: Light,
    output: Annotated[Path, output_option("IMAGE", *IMAGE_SUFFIXES)],
    spp: Annotated[int, typer.Option(min=2, help="Walks a pixel.")] = 64,
    size: PictureSize = Size(640, 480),
    eye: Eye = None,
    up: Up = None,
    rotate: Rotate = 0.0,
    exposure: Exposure = 0.0,
    mend: Mend = False,
    seed: Seed = 0,
    report: ReportFile = None,
) -> None:
    """Render a scene directly: the reference for baked pictures.

    Like them it shows the light from under the surface, with the sky behind the object.
    """
    from formats.image import write_image
    from formats.mesh import read_mesh
    from formats.scene import read_scene
    from prt_bake import camera
    from prt_bake.environment import read_environment
    from prt_bake.rendering import render_scene
    from prt_bake.report import rendering_report, write_report

    if source.suffix.lower() != ".toml":
        raise PrtbakeError(f"{source}: rendering a network directly is not supported yet; give its scene (.toml)")
    scene, sky = read_scene(source), read_environment(light, mend, say)
    view = camera.fit(read_mesh(mesh), *size, eye=eye, up=up or scene.up)
    with reporting("render") as show:
        picture = render_scene(
            scene,
            sky,
            view,
            spp,
            seed,
            up=up,
            rotate=rotate,
            progress=lambda share: show(share, f"{spp} walks a pixel"),
        )
    write_image(output, picture.image, exposure=exposure)
    noise = rendering_report(view, picture.image, picture.standard_error, picture.coverage)
    if report is not None:
        cost = {"command": context.obj, "spp": spp, "seed": seed, "walks": picture.walks, "seconds": picture.seconds}
        write_report(cost | noise, report)
    print(
        f"{output}: {picture.walks:,} walks in {picture.seconds:.1f} s, "
        f"standard error {noise['relative_noise']:.2%} of the object's radiance"
    )
