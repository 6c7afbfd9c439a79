"""`prtbake render`: a picture by Monte Carlo, without any bake."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from formats.errors import PrtbakeError
from prt_bake.cli.options import (
    IMAGE_SUFFIXES,
    Exposure,
    Eye,
    Mend,
    PictureSize,
    ReportFile,
    Rotate,
    Seed,
    Size,
    Up,
    output_option,
)
from prt_bake.cli.progress import reporting, say, stopping

if TYPE_CHECKING:
    from formats.scene import Scene
    from prt_bake.rendering import Rendering

_USUAL_SPP = 64


def render(
    context: typer.Context,
    source: Annotated[Path, typer.Argument(metavar="SOURCE", help="scene.toml (path traced).")],
    mesh: Annotated[Path, typer.Argument(metavar="MESH", help="What the camera is set up for, as in `prtbake shade`.")],
    light: Annotated[
        list[str],
        typer.Option(
            metavar="LIGHT",
            help="Lat-long sky (.exr, .hdr, .png), lights file (.toml), or sun:x,y,z[:r,g,b][:degrees], a directional "
            "light (direction to it, irradiance, angular diameter); may be given several times.",
        ),
    ],
    output: Annotated[Path, output_option("IMAGE", *IMAGE_SUFFIXES)],
    spp: Annotated[
        int | None,
        typer.Option(
            min=2, help=f"Walks a pixel; {_USUAL_SPP} where neither --minutes nor --error is given.", show_default=False
        ),
    ] = None,
    minutes: Annotated[float | None, typer.Option(min=0, max=1e6, help="Stop on time.", show_default=False)] = None,
    error: Annotated[
        float | None,
        typer.Option(
            min=1e-6,
            max=1,
            help="Stop when the noise on the object, over its mean radiance, is this.",
            show_default=False,
        ),
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on from IMAGE.render.npz beside the output.")] = False,
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

    Like them it shows the light from under the surface, with the sky behind the object. An .exr also holds the standard
    error of every pixel (error.R, error.G, error.B) and the object's coverage (coverage.Y). Ctrl-C ends the work early:
    the picture so far is written, and --resume goes on from it.
    """
    from formats.mesh import read_mesh
    from formats.scene import read_scene
    from prt_bake import camera
    from prt_bake.lighting import read_lighting
    from prt_bake.render_state import checkpoint_path
    from prt_bake.rendering import render_scene
    from prt_bake.report import rendering_report, write_report

    if source.suffix.lower() != ".toml":
        raise PrtbakeError(f"{source}: rendering a network directly is not supported yet; give its scene (.toml)")
    scene = read_scene(source)
    lighting = read_lighting(light, up or scene.up, rotate, mend=mend, say=say)
    view = camera.fit(read_mesh(mesh), *size, eye=eye, up=up or scene.up)
    if spp is None and minutes is None and error is None:
        spp = _USUAL_SPP
    with reporting("render") as show, stopping() as stop:
        picture = render_scene(
            scene,
            lighting,
            view,
            spp,
            seed,
            up=up,
            error=error,
            minutes=minutes,
            checkpoint=checkpoint_path(output),
            resume=resume,
            stop=stop,
            progress=lambda share: show(share, _aim(spp, minutes, error)),
        )
        stopped = stop() and not picture.complete
    _write(output, picture, scene, seed, exposure)
    if report is not None:
        cost = {name: getattr(picture, name) for name in ("spp", "passes", "walks", "seconds", "complete")}
        parts = picture.image, picture.standard_error, picture.coverage, picture.history
        write_report({"command": context.obj, "seed": seed, **cost, **rendering_report(view, *parts)}, report)
    print(
        f"{output}: {picture.walks:,} walks in {picture.seconds:.1f} s, "
        f"standard error {picture.relative_noise:.2%} of the object's radiance"
    )
    if stopped:
        raise PrtbakeError(
            f"{output}: the rendering was stopped after {picture.spp} walks a pixel; the picture is valid and says how "
            "noisy it is, --resume goes on"
        )
    if not picture.complete:
        say(f"{output}: the time was up after {picture.spp} walks a pixel; --resume goes on")


def _aim(spp: int | None, minutes: float | None, error: float | None) -> str:
    aims = [
        f"{spp} walks a pixel" if spp is not None else "",
        f"{minutes:g} minutes" if minutes is not None else "",
        f"noise {error:.2%}" if error is not None else "",
    ]
    return " or ".join(aim for aim in aims if aim)


def _write(output: Path, picture: "Rendering", scene: "Scene", seed: int, exposure: float) -> None:
    from formats.image import write_image

    write_image(
        output,
        picture.image,
        exposure=exposure,
        layers={"error": picture.standard_error, "coverage": picture.coverage},
        attributes={
            "prtbake.spp": str(picture.spp),
            "prtbake.passes": str(picture.passes),
            "prtbake.walks": str(picture.walks),
            "prtbake.seed": str(seed),
            "prtbake.seconds": f"{picture.seconds:.3f}",
            "prtbake.scene": scene.content_hash,
            "prtbake.complete": "yes" if picture.complete else "no",
        },
    )
