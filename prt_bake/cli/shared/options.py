"""Options that several commands share, and how their text is read."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import typer

from formats.atomic import refuse_unwritable
from formats.errors import FormatError

IMAGE_SUFFIXES = (".png", ".exr", ".hdr")
ANIMATION_SUFFIXES = (".png", ".webp", ".gif")
USUAL_FOV = 30.0


@dataclass(frozen=True)
class Size:
    """Width and height of a picture in pixels, told as they are given: 640x480."""

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
    """The size that a text such as 640x480 stands for."""
    if isinstance(text, Size):  # the default passes through here too
        return text
    try:
        width, height = (int(part) for part in text.lower().split("x"))
    except ValueError:
        raise typer.BadParameter(f"{text!r} is not WIDTHxHEIGHT in pixels, such as 640x480") from None
    if not (1 <= width <= 16384 and 1 <= height <= 16384):
        raise typer.BadParameter(f"{text!r}: width and height are 1 to 16384 pixels")
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
    """A callback that refuses a number at `low` or below it, above `high`, and at `high` if that is finite."""

    def refuse_outside(value: float | None) -> float | None:
        if value is not None and not (low < value < high or value == high == math.inf):
            expected = f"above {low:g}" if high == math.inf else f"between {low:g} and {high:g}"
            raise typer.BadParameter(f"{value:g} is not {expected}")
        return value

    return refuse_outside


def output_option(metavar: str, *suffixes: str) -> Any:
    """Declare `--output`, refused at once, not after an hour's work, where no file of this kind can be written."""

    def refuse_unusable(path: Path | None) -> Path | None:
        if path is None:
            return None
        _refuse_other_suffixes(path, suffixes)
        refuse_unwritable(path)
        return path

    return typer.Option("--output", "-o", metavar=metavar, callback=refuse_unusable, help="File to write.")


def optional_output(names: str, metavar: str, words: str, *suffixes: str) -> Any:
    """Declare an option, by its `names` between blanks, of a further file to write: refused at once like `--output`."""

    def refuse_unusable(path: Path | None) -> Path | None:
        if path is not None:
            _refuse_other_suffixes(path, suffixes)
        return _read_report(path)

    return typer.Option(*names.split(), metavar=metavar, callback=refuse_unusable, help=words, show_default=False)


def _refuse_other_suffixes(path: Path, suffixes: tuple[str, ...]) -> None:
    if path.suffix.lower() not in suffixes:
        known = " or ".join(dict.fromkeys(suffixes))  # a suffix may be that of pictures and of animations
        raise FormatError(f"{path}: expected a name that ends in {known}, found {path.suffix!r}")


def refuse_unseen_exposure(exposure: float, *outputs: Path | None) -> None:
    """Wrong usage: an exposure where no output is shown by it, since .exr and .hdr keep radiance as it is."""
    suffixes = [output.suffix.lower() for output in outputs if output is not None]
    if exposure != 0.0 and all(suffix in (".exr", ".hdr") for suffix in suffixes):
        kinds = " and ".join(dict.fromkeys(suffixes))
        raise typer.BadParameter(f"--exposure: radiance is kept as it is in {kinds}; write .png, or leave it out")


def _read_report(path: Path | None) -> Path | None:
    if path is not None:
        refuse_unwritable(path)
    return path


Up = Annotated[
    Literal["y", "z"] | None,
    typer.Option(help="Up axis of the sky; by default what the asset or the scene says, else y.", show_default=False),
]
Rotate = Annotated[
    float,
    typer.Option(min=-36000, max=36000, metavar="DEG", help="Turn the light counter-clockwise, seen from above."),
]
PictureSize = Annotated[
    Size,
    typer.Option("--size", parser=read_size, metavar="WxH", help="Pixels of the picture."),
]
Eye = Annotated[
    Point | None,
    typer.Option(parser=_read_point, metavar="x,y,z", help="Camera position; by default the whole object is framed."),
]
LookAt = Annotated[
    Point | None,
    typer.Option(
        parser=_read_point,
        metavar="x,y,z",
        help="Where the camera looks; by default the middle of the object.",
        show_default=False,
    ),
]
Fov = Annotated[
    float,
    typer.Option(callback=within(0.0, 180.0), metavar="DEG", help="Vertical field of view of a perspective camera."),
]
Orthographic = Annotated[
    bool, typer.Option("--orthographic", help="Parallel rays; the object is framed, or what --extent says.")
]
Extent = Annotated[
    float | None,
    typer.Option(
        callback=within(0.0, math.inf),
        metavar="H",
        help="Scene units from the lower to the upper edge of an orthographic picture.",
        show_default=False,
    ),
]
OnlyEye = Annotated[
    Point | None,
    typer.Option(
        "--for-eye",
        parser=_read_point,
        metavar="x,y,z",
        help="The only point that the asset will be seen from.",
        show_default=False,
    ),
]
Exposure = Annotated[
    float,
    typer.Option(min=-64, max=64, metavar="EV", help="Multiply by 2^EV before the sRGB curve (PNG alone)."),
]
Mend = Annotated[
    bool,
    typer.Option("--mend", help="Replace NaN, infinite and negative pixels of the environment, and say how many."),
]
Suns = Annotated[
    Literal["split", "window", "plain"],
    typer.Option(
        help="How small strong lights are met: split from the sky, by a positive transport; window, with "
        "harmonics damped; plain, like all light, which rings."
    ),
]
Seed = Annotated[int, typer.Option(min=0, max=2**63 - 1, help="Seed of every random number.")]
Lights = Annotated[
    list[str],
    typer.Option(
        "--light",
        metavar="LIGHT",
        help="Lat-long sky (.exr, .hdr, .png), lights file (.toml), sun:x,y,z[:r,g,b][:degrees], a directional light "
        "(direction to it, irradiance, angular diameter), or sphere:x,y,z:radius[:r,g,b] (place, size, radiance); may "
        "be given several times.",
    ),
]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON.")]
Device = Annotated[Literal["cpu", "cuda"], typer.Option(help="Where the network runs.")]
ReportFile = Annotated[
    Path | None,
    typer.Option(
        metavar="R.json",
        callback=_read_report,
        help="Also write settings, errors and times.",
        show_default=False,
    ),
]
