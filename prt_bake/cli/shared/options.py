"""Options that several commands share, and their parsers."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import typer

from formats.errors import FormatError

IMAGE_SUFFIXES = (".png", ".exr", ".hdr")
ANIMATION_SUFFIXES = (".png", ".webp", ".gif", ".mp4")
USUAL_FOV = 30.0
FLAT_SHADED = "its mesh file is flat shaded, so that reflections show its faces; --normals vertex smooths them"
"""The remark of commands that draw reflections."""


@dataclass(frozen=True)
class Size:
    """Width and height of a picture in pixels, printed as 640x480."""

    width: int
    height: int

    def __str__(self) -> str:
        return f"{self.width}x{self.height}"


class Point(NamedTuple):
    """A position in object space, in scene units."""

    x: float
    y: float
    z: float


def read_size(text: str | Size) -> Size:
    """Parse a size such as 640x480."""
    if isinstance(text, Size):  # typer parses the default too
        return text
    try:
        width, height = (int(part) for part in text.lower().split("x"))
    except ValueError:
        raise typer.BadParameter(f"{text!r} is not WIDTHxHEIGHT in pixels, such as 640x480") from None
    if not (1 <= width <= 16384 and 1 <= height <= 16384):
        raise typer.BadParameter(f"{text!r}: width and height must be 1 to 16384 pixels")
    return Size(width, height)


def _read_point(text: str | Point) -> Point:
    if isinstance(text, Point):
        return text
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError:
        raise typer.BadParameter(f"{text!r} is not x,y,z in scene units, such as 0,1.5,3") from None
    return Point(x, y, z)


def within(low: float, high: float) -> Callable[[float | None], float | None]:
    """Return a callback that refuses numbers outside the open interval (low, high); an infinite `high` is allowed."""

    def refuse_outside(value: float | None) -> float | None:
        if value is not None and not (low < value < high or value == high == math.inf):
            expected = f"above {low:g}" if high == math.inf else f"between {low:g} and {high:g}"
            raise typer.BadParameter(f"{value:g} is not {expected}")
        return value

    return refuse_outside


def output_option(metavar: str, *suffixes: str) -> Any:
    """Declare `--output`, which refuses other suffixes; `check_outputs` refuses paths that cannot be written."""
    return typer.Option("--output", "-o", metavar=metavar, callback=_with_suffix(suffixes), help="File to write.")


def optional_output(names: str, metavar: str, text: str, *suffixes: str) -> Any:
    """Declare an optional further output with help `text`; `names` are separated by blanks. Refuses as `--output`."""
    check = _with_suffix(suffixes)
    return typer.Option(*names.split(), metavar=metavar, callback=check, help=text, show_default=False)


def _with_suffix(suffixes: tuple[str, ...]) -> Callable[[Path | None], Path | None]:
    def refuse_other_suffixes(path: Path | None) -> Path | None:
        if path is not None and path.suffix.lower() not in suffixes:
            known = " or ".join(dict.fromkeys(suffixes))  # .png is both a picture and an animation
            raise FormatError(f"{path}: expected a name that ends in {known}, found {path.suffix!r}")
        return path

    return refuse_other_suffixes


def refuse_unseen_exposure(exposure: float, *outputs: Path | None) -> None:
    """Raise typer.BadParameter if an exposure has no effect: .exr and .hdr store unscaled radiance."""
    suffixes = [output.suffix.lower() for output in outputs if output is not None]
    if exposure != 0.0 and all(suffix in (".exr", ".hdr") for suffix in suffixes):
        kinds = " and ".join(dict.fromkeys(suffixes))
        raise typer.BadParameter(f"--exposure: has no effect on {kinds}, which store radiance; write .png or omit it")


Up = Annotated[
    Literal["y", "z"] | None,
    typer.Option(help="Up axis of the sky; by default that of the asset or scene.", show_default=False),
]
Rotate = Annotated[
    float,
    typer.Option(
        min=-36000, max=36000, metavar="DEG", help="Rotate the light about the up axis, counter-clockwise from above."
    ),
]
PictureSize = Annotated[
    Size,
    typer.Option("--size", parser=read_size, metavar="WxH", help="Picture size in pixels."),
]
Eye = Annotated[
    Point | None,
    typer.Option(parser=_read_point, metavar="x,y,z", help="Camera position, in place of --view.", show_default=False),
]
View = Annotated[
    Literal["front", "back", "left", "right", "three-quarter", "three-quarter-back"] | None,
    typer.Option(
        "--view",
        help="Side that the camera stands on: front is +z (with z up -y), right is +x; by default three-quarter, from "
        "the front, the right and above.",
        show_default=False,
    ),
]
LookAt = Annotated[
    Point | None,
    typer.Option(
        parser=_read_point,
        metavar="x,y,z",
        help="Point that the camera looks at; by default the object's centre.",
        show_default=False,
    ),
]
Fov = Annotated[
    float,
    typer.Option(callback=within(0.0, 180.0), metavar="DEG", help="Vertical field of view of a perspective camera."),
]
Orthographic = Annotated[
    bool, typer.Option("--orthographic", help="Orthographic camera, framing the object or of --extent.")
]
Extent = Annotated[
    float | None,
    typer.Option(
        callback=within(0.0, math.inf),
        metavar="H",
        help="Height of an orthographic picture in scene units.",
        show_default=False,
    ),
]
OnlyEye = Annotated[
    Point | None,
    typer.Option(
        "--for-eye",
        parser=_read_point,
        metavar="x,y,z",
        help="Bake for this camera position alone.",
        show_default=False,
    ),
]
Exposure = Annotated[
    float,
    typer.Option(min=-64, max=64, metavar="EV", help="Make pictures 2^EV times as bright; not .exr and .hdr."),
]
ToneMap = Annotated[
    Literal["none", "agx"],
    typer.Option(help="none clips bright light; agx, as in Blender, turns it white; not in .exr and .hdr."),
]
Reflection = Annotated[
    bool,
    typer.Option(
        "--reflection/--no-reflection",
        help="Add light reflected at the surface: GGX with the asset's index of refraction and roughness.",
    ),
]
ReflectionNormals = Annotated[
    Literal["vertex", "face"] | None,
    typer.Option(
        "--normals",
        help="Normals of the reflection: vertex, interpolated except across sharp edges, or face; by default vertex, "
        "unless the mesh file is flat shaded.",
        show_default=False,
    ),
]
Mend = Annotated[
    bool,
    typer.Option("--mend", help="Repair NaN, infinite and negative pixels of the environment, and print how many."),
]
Suns = Annotated[
    Literal["split", "window", "plain"],
    typer.Option(
        help="Small strong lights: split removes them from the sky and shades them by the asset's lobes, or without "
        "lobes by a maximum-entropy reconstruction of the transfer; window damps their harmonics; plain leaves them in "
        "the harmonics, which ring. window and plain show no lobes."
    ),
]
Seed = Annotated[int, typer.Option(min=0, max=2**63 - 1, help="Seed of the random numbers.")]
Lights = Annotated[
    list[str],
    typer.Option(
        "--light",
        metavar="LIGHT",
        help="Lat-long sky (.exr, .hdr, .png), lights file (.toml), directional light sun:x,y,z[:r,g,b][:degrees] "
        "(direction to it, irradiance, angular diameter) or sphere light sphere:x,y,z:radius[:r,g,b] (centre, radius, "
        "radiance). Can be repeated.",
    ),
]
Force = Annotated[bool, typer.Option("--force", help="Replace files that exist.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON.")]
Device = Annotated[Literal["cpu", "cuda"], typer.Option(help="Device that runs the network.")]
ReportFile = Annotated[
    Path | None,
    optional_output("--report", "R.json", "Also write settings, errors and times as JSON.", ".json"),
]
