"""The header of Radiance images (https://radsite.lbl.gov/radiance/refer/filefmts.pdf, "Picture File Format").

Lines end in LF, CR LF or CR; an empty line and the resolution follow. EXPOSURE and COLORCORR are factors that the
values were multiplied with; several lines multiply. Indented lines are those of pictures that this one was made of, and
do not apply.

Without PRIMARIES the colours are Rec.709, as all writers of environment maps mean them. The manual assumes Radiance's
own primaries then (green at x = 0.29, equal-energy white). A line that states those is therefore the same as none, and
so are the zeros that Photoshop writes.
"""

import math
import os
import re
from dataclasses import dataclass

from formats.errors import ImageError, warn
from formats.image.gamut import Primaries, are_equal
from formats.image.refusals import refuse_other_kinds
from formats.text import printable

_LINE = re.compile(rb"([^\r\n]*)(?:\r\n|\n|\r)")
_RESOLUTION = re.compile(rb"([+-])Y +(\d{1,18}) +([+-])X +(\d{1,18})")
_LONGEST_HEADER = 1 << 20
_SMALLEST = 1e-30
"""The least product of EXPOSURE lines."""
_UNSAID = ((0.0,) * 8, (0.640, 0.330, 0.290, 0.600, 0.150, 0.060, 0.333, 0.333))

Rgb = tuple[float, float, float]


@dataclass(frozen=True)
class RgbeHeader:
    """The header of a Radiance image.

    Attributes:
        height, width: in pixels.
        upward: whether the last row is on top.
        leftward: whether rows run from right to left.
        divisors: of the stored values, for red, green and blue.
        primaries: what the file says about them, or None.
        end: offset of the pixels in the file.
    """

    height: int
    width: int
    upward: bool
    leftward: bool
    divisors: Rgb
    primaries: Primaries | None
    end: int


def read_header(path: str | os.PathLike[str]) -> RgbeHeader:
    """Read the header; division by EXPOSURE or COLORCORR, and ignored lines, are warnings.

    Raises:
        ImageError: the file is not a Radiance image, is in XYZ colours, is stored by columns, or its header is damaged.
    """
    with open(path, "rb") as file:
        content = file.read(_LONGEST_HEADER)
    refuse_other_kinds(path, "Radiance")
    lines, at = list[str](), 0
    while (match := _LINE.match(content, at)) is not None and match[1]:
        lines.append(_as_specified(match[1].decode("latin-1")))
        at = match.end()
    resolution = _LINE.match(content, match.end()) if match else None
    if resolution is None:
        raise ImageError(f"{path}: the Radiance header has no end: the file is truncated or damaged; copy it again")
    _refuse_other_formats(path, lines)
    upward, height, leftward, width = _resolution(path, resolution[1].strip())
    return RgbeHeader(
        height, width, upward, leftward, _divisors(path, lines), _primaries(path, lines), resolution.end()
    )


def _as_specified(line: str) -> str:
    """Return a line with its key in capitals and without spaces before the equals sign, as some writers leave them."""
    key, equals, value = line.partition("=")
    return f"{key.rstrip().upper()}{equals}{value}" if equals else line


def _refuse_other_formats(path: str | os.PathLike[str], lines: list[str]) -> None:
    for line in lines:
        if line.startswith("FORMAT=") and line[7:].strip() != "32-bit_rle_rgbe":
            raise ImageError(
                f"{path}: expected FORMAT=32-bit_rle_rgbe, found {printable(line)}; convert the image to RGB"
            )


def _resolution(path: str | os.PathLike[str], line: bytes) -> tuple[bool, int, bool, int]:
    """Return whether rows run upward, the height, whether columns run leftward, and the width."""
    match = _RESOLUTION.fullmatch(line)
    if match is None:
        found = printable(line.decode("latin-1"))
        raise ImageError(
            f"{path}: expected a resolution such as '-Y 512 +X 1024', found '{found}'; rows must come first"
        )
    height, width = int(match[2]), int(match[4])
    if height == 0 or width == 0:
        raise ImageError(f"{path}: the image is empty: {width}x{height} pixels")
    return match[1] == b"+", height, match[3] == b"-", width


def _divisors(path: str | os.PathLike[str], lines: list[str]) -> Rgb:
    red = green = blue = 1.0
    for line in lines:
        if line.startswith("GAMMA=") and _numbers(line) != [1.0]:
            warn(f"{path}: {printable(line)} is ignored: the values are taken as linear")
        if not line.startswith(("EXPOSURE=", "COLORCORR=")):
            continue
        factors = _numbers(line)
        factors = 3 * factors if line.startswith("EXPOSURE=") and len(factors) == 1 else factors
        if len(factors) != 3 or not all(0.0 < factor < math.inf for factor in factors):
            warn(f"{path}: {printable(line)} is ignored: expected positive numbers")
            continue
        red, green, blue = red * factors[0], green * factors[1], blue * factors[2]
    if not all(_SMALLEST < divisor < 1.0 / _SMALLEST for divisor in (red, green, blue)):
        raise ImageError(
            f"{path}: the EXPOSURE and COLORCORR of the header multiply to {red:g}, {green:g}, {blue:g}; expected "
            f"{_SMALLEST:g} to {1.0 / _SMALLEST:g}; correct the header"
        )
    if (red, green, blue) != (1.0, 1.0, 1.0):
        shown = f"{red:g}" if red == green == blue else f"{red:g}, {green:g}, {blue:g}"
        warn(f"{path}: the values are divided by {shown}, the EXPOSURE and COLORCORR of the header")
    return red, green, blue


def _primaries(path: str | os.PathLike[str], lines: list[str]) -> Primaries | None:
    stated = [line for line in lines if line.startswith("PRIMARIES=")]
    if not stated:
        return None
    numbers = tuple(_numbers(stated[-1]))
    return None if any(are_equal(numbers, unsaid) for unsaid in _UNSAID) else Primaries("PRIMARIES", numbers)


def _numbers(line: str) -> list[float]:
    """The numbers after the equals sign; an empty list if there is anything else."""
    try:
        return [float(word) for word in line.partition("=")[2].split()]
    except ValueError:
        return []
