"""`prtbake render`: renders a network or a scene by Monte Carlo, without a bake."""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from formats.errors import PrtbakeError
from prt_bake.cli.shared.ineffective import refuse_given
from prt_bake.cli.shared.kinds import LIGHT, SOURCE, refuse_other_kinds
from prt_bake.cli.shared.mesh_name import naming_mesh
from prt_bake.cli.shared.options import (
    FLAT_SHADED,
    IMAGE_SUFFIXES,
    USUAL_FOV,
    Device,
    Exposure,
    Extent,
    Eye,
    Fov,
    Lights,
    LookAt,
    Mend,
    Orthographic,
    PictureSize,
    ReflectionNormals,
    ReportFile,
    Rotate,
    Seed,
    Size,
    Up,
    View,
    optional_output,
    output_option,
    refuse_unseen_exposure,
)
from prt_bake.cli.shared.outputs import Paths, check_outputs
from prt_bake.cli.shared.progress import reporting, say, stopping
from prt_bake.network.file_names import importance_path

if TYPE_CHECKING:
    from prt_bake.rendering.loop import Rendering

_USUAL_SPP = {"scene": 64, "network": 256}


@naming_mesh
def render(
    context: typer.Context,
    source: Annotated[Path, typer.Argument(metavar="SOURCE", help="model.pt (a network) or scene.toml (path traced).")],
    light: Lights,
    output: Annotated[Path, output_option("IMAGE", *IMAGE_SUFFIXES)],
    mesh: Annotated[
        Path | None,
        typer.Argument(
            metavar="MESH",
            help="The object of the model or the scene; by default that of the source's scene.",
            show_default=False,
        ),
    ] = None,
    spp: Annotated[
        int | None,
        typer.Option(
            min=2,
            help="Samples per pixel: paths of a scene, light directions of a network. Without --spp, --minutes and "
            f"--error: {_USUAL_SPP['scene']} for a scene, {_USUAL_SPP['network']} for a network.",
            show_default=False,
        ),
    ] = None,
    sampling: Annotated[
        Literal["light", "lobe", "mis"] | None,
        typer.Option(
            help="Sampling of a network's light directions: light, by the light's radiance; lobe, by the network's own "
            "lobes, else its importance module; mis, light and lobe, weighted by a short pilot. By default mis if "
            "there are lobes or a module, else light.",
            show_default=False,
        ),
    ] = None,
    reflection: Annotated[
        bool,
        typer.Option(
            "--reflection/--no-reflection",
            help="Add the light reflected at the surface.",
        ),
    ] = False,
    normals: ReflectionNormals = None,
    unscattered: Annotated[
        bool,
        typer.Option(
            "--unscattered/--no-unscattered",
            help="Of a scene: include unscattered transmission, which networks and assets lack.",
        ),
    ] = True,
    minutes: Annotated[float | None, typer.Option(min=0, max=1e6, help="Time limit.", show_default=False)] = None,
    error: Annotated[
        float | None,
        typer.Option(
            min=1e-6,
            max=1,
            help="Stop when the standard error on the object, relative to its mean radiance, is this.",
            show_default=False,
        ),
    ] = None,
    resume: Annotated[
        bool,
        typer.Option(
            "--resume",
            help="Resume from IMAGE.render.npz beside the output; by default up to the limits of the earlier run.",
        ),
    ] = False,
    preview: Annotated[
        Path | None,
        optional_output("--preview", "IMAGE", "Write the unfinished picture here regularly.", *IMAGE_SUFFIXES),
    ] = None,
    every: Annotated[float, typer.Option(min=0, max=1e6, help="Seconds between previews.")] = 10.0,
    size: PictureSize = Size(640, 480),
    side: View = None,
    eye: Eye = None,
    look_at: LookAt = None,
    fov: Fov = USUAL_FOV,
    orthographic: Orthographic = False,
    extent: Extent = None,
    up: Up = None,
    rotate: Rotate = 0.0,
    exposure: Exposure = 0.0,
    mend: Mend = False,
    seed: Seed = 0,
    device: Device = "cpu",
    precision: Annotated[
        Literal["float32", "bfloat16"], typer.Option(help="Number type of a network's matrix products.")
    ] = "float32",
    workers: Annotated[
        int | None,
        typer.Option(min=1, max=1024, help="Threads of a network; by default one per core.", show_default=False),
    ] = None,
    report: ReportFile = None,
) -> None:
    """Render a network, or path trace a scene as the reference.

    The picture shows subsurface light with the sky behind the object; --reflection adds light reflected at the surface.
    Pictures of scenes also show unscattered transmission through index-matched or smooth objects. Networks lack it, so
    render their references with --no-unscattered. An .exr states what it shows (prtbake.shows) and has the standard
    error of every pixel (error.R, error.G, error.B) and the object's coverage (coverage.Y). A network's radiance may be
    slightly negative; it is not clamped, so that errors are not hidden. Ctrl-C writes the picture as rendered so far,
    and --resume continues it.
    """
    from prt_bake.rendering.state import checkpoint_path, stored_limits

    checkpoint = checkpoint_path(output)
    outputs = {"--output": output, "--preview": preview, "--report": report, "the checkpoint": checkpoint}
    inputs: dict[str, Paths] = {"SOURCE": source, "the importance module": importance_path(source)}
    refuse_other_kinds({"SOURCE": (source, SOURCE), "MESH": (mesh, ("mesh",)), "--light": (light, LIGHT)})
    from formats.mesh import read_mesh
    from prt_bake.baking.sources import own_mesh
    from prt_bake.cli.shared.viewing import camera_for
    from prt_bake.lights.lighting import read_lighting

    mesh = mesh or own_mesh(source)
    check_outputs(outputs, inputs | {"MESH": mesh, "--light": light})
    is_scene = source.suffix.lower() == ".toml"
    refuse_unseen_exposure(exposure, output, preview)
    if preview is None:
        refuse_given(context, ("every",), "without --preview")
    if normals is not None and not reflection:
        raise typer.BadParameter("--normals: applies to the reflection; add --reflection")
    if is_scene:
        _refuse_network_options(sampling, device, precision, workers)
    surface = read_mesh(mesh)
    opened = _open(source, surface, device)
    if is_scene:
        _refuse_other_object(opened, surface, mesh)
    axis = up or (opened.up if is_scene else opened.metadata.get("up", "y"))
    lighting = read_lighting(light, axis, rotate, mend=mend, say=say, mesh=surface)
    view = camera_for(surface, size, axis, side, eye, look_at, fov, orthographic, extent)
    if resume and spp is None and minutes is None and error is None:
        limits = stored_limits(checkpoint)
        spp, minutes, error = limits.get("spp"), limits.get("minutes"), limits.get("error")
    if spp is None and minutes is None and error is None:
        spp = _USUAL_SPP["scene" if is_scene else "network"]
    texts = {"prtbake.seed": str(seed), **_identity_texts(opened, is_scene)}
    with reporting("render") as show, stopping() as stop:
        options: dict[str, Any] = {
            "up": up,
            "reflection": reflection,
            "normals": normals,
            "error": error,
            "minutes": minutes,
            "checkpoint": checkpoint,
            "resume": resume,
            "stop": stop,
            "progress": lambda share: show(share, _limits(spp, minutes, error, is_scene)),
            "every": every,
        }
        if preview is not None:
            options["preview"] = lambda so_far: _write(preview, so_far, texts, exposure)
        if is_scene:
            from prt_bake.rendering.scene import render_scene

            options["shown"] = "all" if unscattered else "scattered"
            picture = render_scene(opened, lighting, view, spp, seed, **options)
        else:
            from prt_bake.rendering.network import render_network

            importance = _importance(source, opened, sampling, device)
            options |= {"sampling": sampling, "importance": importance, "precision": precision, "device": device}
            options["workers"] = workers or (1 if device == "cuda" else os.cpu_count() or 1)
            picture = render_network(opened, surface, lighting, view, spp, seed, **options)
        stopped = stop() and not picture.complete
    _write(output, picture, texts | {"prtbake.command": context.obj}, exposure)
    if picture.complete:
        checkpoint.unlink(missing_ok=True)
    if picture.negative > 0.001:
        say(f"{output}: {picture.negative:.1%} of the object's radiance is negative, as predicted by the network")
    if not picture.coverage.any():
        say(f"{output}: the camera sees nothing of the object; turn it to the object, or bring it nearer")
    if reflection and normals is None and surface.flat_shaded:
        say(f"{mesh}: {FLAT_SHADED}")
    if picture.black:
        say(f"{output}: the object is black; if it should receive light, render more {_unit(is_scene)}")
    if report is not None:
        _report(report, context.obj, seed, picture, view)
    print(_summary(output, picture, is_scene))
    if stopped:
        raise PrtbakeError(
            f"{output}: the rendering was stopped after {picture.spp} {_unit(is_scene)} per pixel; the picture is "
            "valid and states its noise; --resume continues it"
        )
    if not picture.complete:
        say(f"{output}: the time limit ended after {picture.spp} {_unit(is_scene)} per pixel; --resume continues")


def _refuse_network_options(sampling: str | None, device: str, precision: str, workers: int | None) -> None:
    """Raise typer.BadParameter for options of networks; scenes are always path traced on the CPU."""
    for name, given in (
        ("--sampling", sampling is not None),
        ("--device", device != "cpu"),
        ("--precision", precision != "float32"),
        ("--workers", workers is not None),
    ):
        if given:
            raise typer.BadParameter(f"{name} is for networks; omit it, since a scene (.toml) is path traced")


def _refuse_other_object(scene: Any, surface: Any, mesh: Path) -> None:
    """Raise QueryError if the mesh is not the scene's: it would be framed, and the scene's rendered."""
    from formats.errors import QueryError
    from prt_bake.geometry.same_shape import foreign_vertices

    if foreign := foreign_vertices(surface, scene.mesh) or foreign_vertices(scene.mesh, surface):
        raise QueryError(
            f"{mesh}: expected the object of {scene.path}, found another one: {foreign} vertices differ; a scene is "
            f"rendered with its own mesh, so give {scene.parts[0].mesh_path}"
        )


def _open(source: Path, surface: Any, device: str) -> Any:
    from formats.scene import read_scene
    from prt_bake.baking.sources import open_source

    return read_scene(source) if source.suffix.lower() == ".toml" else open_source(source, surface, device)


def _importance(source: Path, network: Any, sampling: str | None, device: str) -> Any:
    """Return the model's importance module; None for `light`, for a network with lobes of its own, which are better,
    and by default if the module does not exist.
    """
    from prt_bake.importance.module import load_importance
    from prt_bake.importance.own_lobes import own_lobes

    if sampling == "light" or own_lobes(network) is not None:
        return None
    if sampling is None and not importance_path(source).is_file():
        return None
    return load_importance(source, device)


def _unit(is_scene: bool) -> str:
    return "paths" if is_scene else "samples"


def _limits(spp: int | None, minutes: float | None, error: float | None, is_scene: bool) -> str:
    limits = [
        f"{spp} {_unit(is_scene)} per pixel" if spp is not None else "",
        f"{minutes:g} minutes" if minutes is not None else "",
        f"noise {error:.2%}" if error is not None else "",
    ]
    return " or ".join(limit for limit in limits if limit)


def _summary(output: Path, picture: "Rendering", is_scene: bool) -> str:
    method = ""
    if not is_scene:
        counts = picture.sampling
        lobe = sum(counts["lobe"]) / (sum(counts["light"]) + sum(counts["lobe"]))
        method = f", sampled by {counts['by']}" + (f" ({lobe:.0%} from lobes)" if counts["by"] == "mis" else "")
    return (
        f"{output}: {picture.walks:,} {'paths' if is_scene else 'evaluations'} in {picture.seconds:.1f} s, "
        f"{picture.speed:.3g} {_unit(is_scene)} per pixel and second{method}, "
        f"standard error {picture.relative_noise:.2%} of the object's radiance"
    )


def _report(path: Path, command: str, seed: int, picture: "Rendering", view: Any) -> None:
    from formats.json_report import write_report
    from prt_bake.rendering.report import rendering_report

    names = ("spp", "passes", "walks", "seconds", "complete", "shows", "sampling")
    cost = {name: getattr(picture, name) for name in names}
    parts = picture.image, picture.standard_error, picture.coverage, picture.history
    numbers = {"samples_a_pixel_a_second": picture.speed, "negative": picture.negative}
    write_report({"command": command, "seed": seed, **cost, **numbers, **rendering_report(view, *parts)}, path)


def _identity_texts(opened: Any, is_scene: bool) -> dict[str, str]:
    if is_scene:
        return {"prtbake.scene": opened.content_hash}
    from prt_bake.network.inference.pairs import content_hash

    return {"prtbake.model": content_hash(opened)}


def _write(output: Path, picture: "Rendering", texts: dict[str, str], exposure: float) -> None:
    import numpy as np

    from formats.image import write_image

    # A .hdr cannot store negative radiance, which a network may predict.
    image = np.maximum(picture.image, 0.0) if output.suffix.lower() == ".hdr" else picture.image
    write_image(
        output,
        image,
        exposure=exposure,
        layers={"error": picture.standard_error, "coverage": picture.coverage},
        attributes={
            **texts,
            "prtbake.spp": str(picture.spp),
            "prtbake.passes": str(picture.passes),
            "prtbake.walks": str(picture.walks),
            "prtbake.seconds": f"{picture.seconds:.3f}",
            "prtbake.shows": picture.shows,
            **({"prtbake.sampling": str(picture.sampling["by"])} if picture.sampling else {}),
            "prtbake.complete": "yes" if picture.complete else "no",
        },
    )
