"""The headers of OpenEXR files, read with the official `OpenEXR` binding, and what it prints suppressed."""

import contextlib
import io
import os
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from formats.errors import ImageError
from formats.image import gamut
from formats.image.refusals import refuse_other_kinds, refuse_size
from formats.text import printable

Window = tuple[int, int, int, int]
"""Left, top, right and bottom, inclusive."""

_MOST_EMPTY = 4096
"""Largest ratio of the display window to the data window in an image of more than _SMALL pixels."""
_SMALL = 1 << 24
_INTEROP = {
    "lin_rec709_scene": gamut.REC709,
    "lin_rec2020_scene": gamut.REC2020,
    "lin_p3d65_scene": gamut.P3_D65,
    "lin_ap0_scene": gamut.ACES_AP0,
    "lin_ap1_scene": gamut.ACES_AP1,
    "lin_adobergb_scene": gamut.ADOBE_RGB,
}
"""The linear spaces of https://github.com/AcademySoftwareFoundation/ColorInterop."""
_OIIO = {"acescg": gamut.ACES_AP1, "lin_ap1": gamut.ACES_AP1, "aces2065-1": gamut.ACES_AP0, "lin_ap0": gamut.ACES_AP0}
"""Names of OpenColorIO's configurations, in lower case, that OpenImageIO writes."""
_OIIO_UNSAID = ("linear", "scene_linear", "lin_rec709", "lin_srgb", "raw", "data", "unknown", "")
"""Names that OpenImageIO gives to linear Rec.709, and to a file that says nothing."""


@dataclass(frozen=True, eq=False)
class Part:
    """A part of an OpenEXR file; most files have one.

    Attributes:
        number: from 0.
        name: empty if it has none.
        deep: whether its pixels have any number of samples.
        sampling: distances of the stored columns and rows, (1, 1) if all are stored, by channel.
        header: the attributes.
    """

    number: int
    name: str
    deep: bool
    sampling: Mapping[str, tuple[int, int]]
    header: Mapping[str, Any]

    @property
    def display(self) -> Window:
        """The display window: the image."""
        return _window(self.header["displayWindow"])

    @property
    def stored(self) -> Window:
        """The data window: the stored pixels."""
        return _window(self.header["dataWindow"])


def read_parts(path: str | os.PathLike[str]) -> list[Part]:
    """Read the headers of all parts. Raises ImageError if the file is not OpenEXR, or its header is damaged."""
    import OpenEXR

    refuse_other_kinds(path, "OpenEXR")
    deep = (OpenEXR.deepscanline, OpenEXR.deeptile)
    with reading(path), OpenEXR.File(os.fspath(path), separate_channels=True, header_only=True) as picture:
        parts = []
        for number in range(len(picture.parts)):
            header = dict(picture.header(number))
            sampling = {channel.name: (channel.xSampling, channel.ySampling) for channel in header["channels"]}
            parts.append(Part(number, str(header.get("name", "")), header["type"] in deep, sampling, header))
    if not parts:
        raise ImageError(f"{path}: the OpenEXR image has no parts: it is truncated or damaged; copy it again")
    return parts


def refuse_windows(path: str | os.PathLike[str], part: Part) -> None:
    """Raise ImageError if the image is too large, or almost all of a large image has no stored pixels."""
    (width, height), stored = _size(part.display), _size(part.stored)
    refuse_size(path, width, height)
    if width * height > max(_SMALL, _MOST_EMPTY * stored[0] * stored[1]):
        raise ImageError(
            f"{path}: is {width}x{height} pixels (display window), but only {stored[0]}x{stored[1]} are stored (data "
            "window); save it without the empty frame"
        )


def primaries_of(part: Part) -> gamut.Primaries | None:
    """What the header says about the primaries, or None."""
    if (stored := part.header.get("chromaticities")) is not None:
        # An attribute of another type than the standard's is no tuple.
        numbers = tuple(float(number) for number in stored) if isinstance(stored, tuple) else ()
        return gamut.Primaries("the attribute chromaticities", numbers)
    name = part.header.get("colorInteropID")
    if isinstance(name, str) and name not in ("unknown", "data"):
        return gamut.Primaries(f"the attribute colorInteropID = {printable(name)}", _INTEROP.get(name, ()))
    if part.header.get("acesImageContainerFlag") == 1:
        return gamut.Primaries("the attribute acesImageContainerFlag", gamut.ACES_AP0)
    name = part.header.get("oiio:ColorSpace")
    if isinstance(name, str) and name.lower() not in _OIIO_UNSAID:
        known = _INTEROP | _OIIO
        return gamut.Primaries(f"the attribute oiio:ColorSpace = {printable(name)}", known.get(name.lower(), ()))
    return None


@contextlib.contextmanager
def reading(path: str | os.PathLike[str], place: str = "") -> Iterator[None]:
    """Suppress what the library prints, and turn its exceptions into ImageError; `place` is where damage is."""
    try:
        with silenced():
            yield
    except (ImageError, MemoryError):
        raise
    except UnicodeDecodeError as cause:
        raise ImageError(
            f"{path}: a text or a name in the OpenEXR header is not UTF-8: {cause.object[:40]!r}; rename it, or remove "
            "it, for example with oiiotool --eraseattrib"
        ) from cause
    except Exception as cause:  # the binding raises many kinds for damaged files
        if "unsupported attribute type" in str(cause):
            raise ImageError(f"{path}: the OpenEXR header has an {cause}; save the picture without it") from cause
        if place:
            raise ImageError(f"{path}: the OpenEXR image is truncated or damaged in {place}; copy it again") from cause
        raise ImageError(f"{path}: cannot be read as OpenEXR: it is truncated or damaged; copy it again") from cause


@contextlib.contextmanager
def silenced() -> Iterator[None]:
    """Suppress what the OpenEXR library prints to standard output and error."""
    for stream in (sys.stdout, sys.stderr):
        if stream is not None:
            stream.flush()
    open_numbers = [number for number in (1, 2) if _is_open(number)]  # before another file takes a free number
    # The binding prints through Python's streams, the library through the file descriptors.
    with open(os.devnull, "wb") as null, contextlib.redirect_stdout(io.StringIO()):
        saved = [os.dup(number) for number in open_numbers]
        try:
            for number in open_numbers:
                os.dup2(null.fileno(), number)
            yield
        finally:
            for number, copy in zip(open_numbers, saved, strict=True):
                os.dup2(copy, number)
                os.close(copy)


def _is_open(descriptor: int) -> bool:
    try:
        os.fstat(descriptor)
    except OSError:
        return False
    return True


def _window(corners: Any) -> Window:
    (left, top), (right, bottom) = corners
    return int(left), int(top), int(right), int(bottom)


def _size(window: Window) -> tuple[int, int]:
    return window[2] - window[0] + 1, window[3] - window[1] + 1
