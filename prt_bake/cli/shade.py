"""`prtbake shade`: a baked asset under a sky."""

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from prt_bake.cli.options import (
    IMAGE_SUFFIXES,
    Exposure,
    Eye,
    Lights,
    Mend,
    PictureSize,
    Rotate,
    Size,
    Up,
    output_option,
)
from prt_bake.cli.progress import say


def shade(
    asset: Annotated[Path, typer.Argument(metavar="ASSET", help="Asset that `prtbake bake` wrote.")],
    light: Lights,
    output: Annotated[Path, output_option("IMAGE", *IMAGE_SUFFIXES)],
    size: PictureSize = Size(640, 480),
    eye: Eye = None,
    up: Up = None,
    rotate: Rotate = 0.0,
    exposure: Exposure = 0.0,
    samples: Annotated[int, typer.Option(min=1, max=64, help="Rays along each side of a pixel.")] = 3,
    mend: Mend = False,
    suns: Annotated[
        Literal["split", "window", "plain"],
        typer.Option(
            help="How small strong lights are met: split from the sky, by a positive transport; window, with "
            "harmonics damped; plain, like all light, which rings."
        ),
    ] = "split",
) -> None:
    """Relight a baked asset and write the picture.

    It shows the light from under the surface, with the sky, and lights that have a size, behind the object. An .exr has
    the error that the bake has left (error.R, error.G, error.B, one sigma) and the object's coverage (coverage.Y).
    """
    from formats.asset import read_asset
    from formats.image import write_image
    from prt_bake import camera
    from prt_bake.lighting import read_lighting
    from prt_bake.shading import render_picture

    baked = read_asset(asset)
    axis = up or baked.up
    lighting = read_lighting(light, axis, rotate, mend=mend, say=say)
    view = camera.fit(baked.mesh, size.width, size.height, eye=eye, up=axis)
    picture = render_picture(baked, lighting, view, up=axis, samples=samples, suns=suns)
    layers = {"error": picture.error, "coverage": picture.coverage}
    write_image(output, picture.image, exposure=exposure, layers=layers)
    for remark in _shown_otherwise(baked, light, rotate, view.eye):
        say(f"{asset}: {remark}")
    if not baked.complete:
        say(f"{asset}: is a partial bake; {picture.unlit:.1%} of what is seen of the object was not baked and is black")
    print(
        f"{output}: {picture.shaded} vertices in {picture.seconds:.2f} s, negative radiance clamped "
        f"{abs(picture.clamped):.3%} of the energy, error of the projection {picture.relative_error:.2%} of "
        f"the object's radiance" + _suns_met(picture.suns, suns)
    )


def _suns_met(count: int, treatment: str) -> str:
    if not count:
        return ""
    deed = "split from the other light" if treatment == "split" else "damped by a window"
    return f", {count} {'sun' if count == 1 else 'suns'} {deed}"


def _shown_otherwise(baked: Any, lights: list[str], rotate: float, eye: Any) -> Iterator[str]:
    """What an asset made for one light or one eye alone cannot show of what was asked for."""
    reasons = {item["item"]: item["reason"] for item in baked.left_out}
    if "other lights" in reasons and (rotate % 360.0 or not _same_light(baked, lights)):
        turned = f" turned by {rotate:g} degrees" if rotate % 360.0 else ""
        names = " and ".join(Path(light).name for light in lights)
        yield f"{reasons['other lights']}: the object is shown under that, not under {names}{turned}"
    made_for = baked.provenance.get("settings", {}).get("for_eye")
    if made_for is not None and any(abs(a - b) > 1e-6 * (1.0 + abs(b)) for a, b in zip(eye, made_for, strict=True)):
        yield f"{reasons.get('other views', 'made for one eye')}: from elsewhere its colours are wrong"


def _same_light(baked: Any, lights: list[str]) -> bool:
    from formats.whole import sha256

    return len(lights) == 1 and Path(lights[0]).is_file() and baked.folded_in == f"light {sha256(Path(lights[0]))}"
