"""`prtbake shade`: relights a baked asset and writes the picture."""

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from formats.extras import require
from prt_bake.cli.shared.fixed import fixed_light
from prt_bake.cli.shared.kinds import LIGHT, refuse_other_kinds
from prt_bake.cli.shared.next_step import say_next, say_next_of_asset, unused
from prt_bake.cli.shared.options import (
    ANIMATION_SUFFIXES,
    FLAT_SHADED,
    IMAGE_SUFFIXES,
    USUAL_FOV,
    Exposure,
    Extent,
    Eye,
    Fov,
    Lights,
    LookAt,
    Mend,
    Orthographic,
    PictureSize,
    Reflection,
    ReflectionNormals,
    Rotate,
    Size,
    Suns,
    ToneMap,
    Up,
    View,
    optional_output,
    output_option,
    refuse_unseen_exposure,
    within,
)
from prt_bake.cli.shared.outputs import check_outputs
from prt_bake.cli.shared.progress import Report, reporting, say

_FRAMES, _SECONDS = 36, 3.0
_LAYERS = "position, normal, vertex, radiance, subsurface, reflection"


def shade(
    context: typer.Context,
    asset: Annotated[Path, typer.Argument(metavar="ASSET", help="Asset that `prtbake bake` wrote.")],
    light: Lights,
    output: Annotated[Path, output_option("IMAGE", *IMAGE_SUFFIXES, *ANIMATION_SUFFIXES)],
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
    tone_map: ToneMap = "none",
    reflection: Reflection = False,
    roughness: Annotated[
        str | None,
        typer.Option(
            metavar="ALPHA",
            help="GGX alpha of the reflection, from 0 to 1, or a texture of it; by default the asset's mean.",
            show_default=False,
        ),
    ] = None,
    normals: ReflectionNormals = None,
    transparent: Annotated[
        bool, typer.Option("--transparent", help="Write an alpha channel instead of the background (.exr, .png).")
    ] = False,
    layers: Annotated[
        str,
        typer.Option(
            metavar="NAMES",
            help=f"Further layers of an .exr, separated by commas: {_LAYERS}; or all.",
            show_default=False,
        ),
    ] = "",
    error_picture: Annotated[
        Path | None,
        optional_output(
            "--error-picture", "E.png", "Also write the error of each pixel in false colours, of the same size.", ".png"
        ),
    ] = None,
    turntable: Annotated[
        Literal["eye", "light"] | None,
        typer.Option(
            help="Move the camera or the light once around the object: an animation (.webp, .mp4, .gif, .png), or "
            "numbered pictures if the name has a number in it (turn_%03d.png).",
            show_default=False,
        ),
    ] = None,
    frames: Annotated[int, typer.Option(min=1, max=3600, help="Frames of a turntable.")] = _FRAMES,
    seconds: Annotated[float, typer.Option(callback=within(0.0, 3600.0), help="Duration of a turntable.")] = _SECONDS,
    samples: Annotated[int, typer.Option(min=1, max=64, help="Camera rays along each side of a pixel.")] = 3,
    mend: Mend = False,
    suns: Suns = "split",
) -> None:
    """Relight a baked asset and write the picture, or a turntable.

    The picture shows subsurface light, with the sky and lights of finite size behind the object; --reflection adds
    light reflected at the surface. An .exr has the standard error of the bake (error.R, error.G, error.B) and the
    object's coverage (coverage.Y).
    """
    _refuse_ineffective(output, transparent, layers, turntable, error_picture, reflection, roughness, normals)
    refuse_unseen_exposure(exposure, output)
    stores_radiance = output.suffix.lower() in (".exr", ".hdr")
    if tone_map != "none" and stores_radiance:
        raise typer.BadParameter(
            f"--tone-map: has no effect on {output.suffix.lower()}, which stores radiance; omit it"
        )
    clips = tone_map == "none" and not stores_radiance
    if turntable is None and (frames, seconds) != (_FRAMES, _SECONDS):
        raise typer.BadParameter("--frames and --seconds apply to turntables; add --turntable eye")
    check_outputs(
        {"--output": _files(output, frames), "--error-picture": error_picture},
        {"ASSET": asset, "--light": light, "--roughness": roughness},
    )
    refuse_other_kinds({"ASSET": (asset, ("asset",)), "--light": (light, LIGHT)})
    if error_picture is not None:
        require("--error-picture", "matplotlib")
    from formats.asset import read_asset
    from formats.image.animation import refuse_unavailable
    from prt_bake.cli.shared.exposure import exposure_remark
    from prt_bake.cli.shared.viewing import camera_for
    from prt_bake.lights.lighting import read_lighting
    from prt_bake.lights.skies.downsampled import rows_shown
    from prt_bake.shading.selftest import warn_of_failed_selftest

    refuse_unavailable(output, size.width, size.height)
    baked = read_asset(asset)
    warn_of_failed_selftest(baked, asset)
    axis = up or baked.up
    turns = frames if turntable == "eye" else 1
    view = camera_for(baked.mesh, size, axis, side, eye, look_at, fov, orthographic, extent, turns)
    rows = rows_shown(view.height, view.fov)
    lighting = read_lighting(
        light, axis, rotate, mend=mend, say=say, mesh=baked.mesh, most_rows=rows, degree=baked.degree
    )
    options: dict[str, Any] = {
        "up": axis,
        "samples": samples,
        "background": not transparent,
        "reflection": reflection,
        "roughness": None if roughness is None else _read_roughness(roughness),
        "normals": normals,
        "layers": _names(layers, error_picture is not None),
        "suns": suns,
    }
    if turntable is None:
        picture = _write_picture(output, baked, lighting, view, options, exposure, tone_map, context.obj)
    else:
        turn = turntable, frames, seconds
        picture = _write_turntable(output, baked, lighting, view, options, exposure, tone_map, turn)
    if error_picture is not None:
        from prt_bake.shading.error_picture import write_error_picture

        largest = write_error_picture(error_picture, picture)
    for remark in _remarks(baked, light, rotate, picture, reflection):
        say(f"{asset}: {remark}")
    if clips and (badly := exposure_remark(picture.image, picture.coverage, exposure)) is not None:
        say(f"{output}: {badly}")
    if picture.reflects and normals is None and baked.mesh.flat_shaded:
        say(f"{asset}: {FLAT_SHADED}")
    print(f"{output}: error {picture.errors}")
    if error_picture is not None:
        print(
            f"{error_picture}: standard error of the bake and the noise at each pixel, from 0 (dark blue) to "
            f"{largest:.1%} of its radiance (yellow)"
        )
    print(
        f"{output}: {picture.shaded} vertices in {picture.seconds:.2f} s, clamped negative radiance "
        f"{abs(picture.clamped):.3%} of the energy" + _light_figures(baked, picture.suns, suns, bool(lighting.skies))
    )
    kept = [*(["--view", side] if side else []), *(["--up", up] if up else [])]
    for name, place in (("--eye", eye), ("--look-at", look_at)):
        kept += [name, ",".join(map(str, place))] if place else []
    for name, value, usual in (("--fov", fov, USUAL_FOV), ("--rotate", rotate, 0.0), ("--exposure", exposure, 0.0)):
        kept += [name, f"{value:g}"] if value != usual else []
    kept += [*(["--tone-map", tone_map] if tone_map != "none" else []), *(["--reflection"] if reflection else [])]
    if turntable is not None:
        say_next_of_asset(asset, *kept, lights=light)
        return
    lit = [word for each in light for word in ("--light", each)]
    turning = "light" if baked.quantity == "transfer" else "eye"
    animation = unused(output.with_suffix(".webp"))
    say_next("prtbake", "shade", asset, *lit, *kept, "--size", size, "--turntable", turning, "-o", animation)


def _files(output: Path, frames: int) -> list[Path]:
    """Return the files of the output, several if its name has a number in it."""
    if "%" not in output.name:
        return [output]
    from formats.image.animation import numbered

    return [numbered(output, number) for number in range(frames)]


def _light_figures(baked: Any, count: int, treatment: str, beside_a_sky: bool) -> str:
    lobes = ""
    if baked.lobes is not None:
        lobes = ", lobes shown" if treatment == "split" else f", no lobes with --suns {treatment}"
    if not count:
        return lobes
    action = " damped by a window" if treatment == "window" else " split off" if beside_a_sky else ""
    return f", {count} {'sun' if count == 1 else 'suns'}{action}{lobes}"


def _write_picture(
    output: Path,
    baked: Any,
    lighting: Any,
    view: Any,
    options: dict[str, Any],
    exposure: float,
    tone_map: str,
    command: str,
) -> Any:
    from formats.image import write_image
    from formats.json_report import as_line
    from prt_bake.shading.picture import render_picture
    from prt_bake.shading.tone_map import agx

    picture = render_picture(baked, lighting, view, **options)
    alpha = None if options["background"] else picture.coverage
    mapped = tone_map == "agx"
    write_image(
        output,
        agx(picture.image, exposure, alpha) if mapped else picture.image,
        exposure=0.0 if mapped else exposure,
        layers={"error": picture.error, "coverage": picture.coverage, **picture.layers},
        attributes={
            "prtbake.command": command,
            "prtbake.shows": _shows(picture),
            "prtbake.error": "projection",
            "prtbake.picture_error": as_line(picture.errors and picture.errors.as_json()),
        },
        alpha=alpha,
    )
    return picture


def _write_turntable(
    output: Path,
    baked: Any,
    lighting: Any,
    view: Any,
    options: dict[str, Any],
    exposure: float,
    tone_map: str,
    turn: tuple[Literal["eye", "light"], int, float],
) -> Any:
    """Write a turntable, `turn` being what turns, the frames and the seconds, and return its last picture."""
    from formats.image.animation import write_animation, write_sequence
    from prt_bake.shading.tone_map import agx
    from prt_bake.shading.turntable import turntable

    last: list[Any] = []
    turning, frames, seconds = turn
    stops = 0.0 if tone_map == "agx" else exposure

    def images(show: Report) -> Iterator[Any]:
        for number, picture in enumerate(turntable(baked, lighting, view, frames, turning, **options), start=1):
            last[:] = [picture]
            show(number / frames, f"{number} of {frames} pictures")
            yield agx(picture.image, exposure) if tone_map == "agx" else picture.image

    with reporting("turn") as show:
        if "%" in output.name:
            write_sequence(output, images(show), exposure=stops)
        else:
            write_animation(output, images(show), exposure=stops, seconds_a_frame=seconds / frames)
    return last[0]


def _refuse_ineffective(
    output: Path,
    transparent: bool,
    layers: str,
    turntable: str | None,
    error_picture: Path | None,
    reflection: bool,
    roughness: str | None,
    normals: str | None,
) -> None:
    """Raise typer.BadParameter for options that need others, or that the output's format cannot store."""
    suffix = output.suffix.lower()
    if turntable is None and suffix not in IMAGE_SUFFIXES:
        raise typer.BadParameter(f"--output: {suffix} is for turntables; add --turntable eye, or write .png or .exr")
    if turntable is not None and "%" not in output.name and suffix not in ANIMATION_SUFFIXES:
        raise typer.BadParameter(
            f"--output: a single {suffix} cannot store a turntable; write .webp, .mp4, .gif, .png, or numbered "
            "pictures (turn_%03d.exr)"
        )
    if turntable is None and "%" in output.name:
        raise typer.BadParameter(f"--output: {output.name} names numbered pictures; add --turntable eye")
    for name, value in (("--roughness", roughness), ("--normals", normals)):
        if value is not None and not reflection:
            raise typer.BadParameter(f"{name}: applies to the reflection; add --reflection")
    if turntable is not None and (transparent or layers or error_picture is not None):
        raise typer.BadParameter("--turntable: cannot be combined with --transparent, --layers or --error-picture")
    if transparent and suffix not in (".exr", ".png"):
        raise typer.BadParameter(f"--transparent: {suffix} has no alpha channel; write .exr or .png")
    if layers and suffix != ".exr":
        raise typer.BadParameter(f"--layers: {suffix} has no layers; write .exr")


def _read_roughness(text: str) -> Any:
    """Return the number, or the levels of the image that `text` names."""
    from formats.image.texture import read_roughness

    try:
        alpha = float(text)
    except ValueError:
        return read_roughness(text)
    if not 0.0 <= alpha <= 1.0:
        raise typer.BadParameter(f"--roughness: expected a GGX alpha from 0 to 1 or an image, found {alpha:g}")
    return alpha


def _names(layers: str, with_error_picture: bool) -> tuple[str, ...]:
    from prt_bake.shading.layers import LAYERS

    names = tuple(LAYERS) if layers == "all" else tuple(name.strip() for name in layers.split(",") if name.strip())
    return names if not with_error_picture or "radiance" in names else (*names, "radiance")


def _shows(picture: Any) -> str:
    """Describe the light as `prtbake render` does; `prtbake compare` reads it."""
    reflected = ", light reflected at the surface" if picture.reflects else ""
    return f"subsurface light, unscattered light left out{reflected}"


def _remarks(baked: Any, lights: list[str], rotate: float, picture: Any, reflection: bool) -> Iterator[str]:
    from prt_bake.shading.surface_reflection import reflects

    yield from fixed_light(baked, lights, rotate)
    if not baked.complete:
        yield f"is a partial bake; {picture.unlit:.1%} of the visible object was not baked and is black"
    if reflection and not picture.reflects:
        yield "its index of refraction is 1, so its surface reflects nothing"
    if not reflection and reflects(baked):
        yield f"light reflected at its surface (index {baked.eta:g}) is not shown; --reflection adds it"
