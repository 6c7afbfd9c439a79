"""What the values of a PNG or JPEG mean as colours: the curve and the primaries that its metadata names.

The order of PNG (third edition, https://www.w3.org/TR/png-3/#4Concepts.ColourSpacesAndInterpretation): cICP, a colour
profile, sRGB, and gAMA with cHRM. Without any of them the values are sRGB. Profiles are not applied: one that does not
leave sRGB as it is gets a warning, and the other chunks count, which such files have for readers without profiles.
"""

import io
import os
from typing import Any, NamedTuple

import numpy as np

from formats.errors import ImageError, warn
from formats.image import gamut
from formats.image.gamut import Primaries
from formats.image.stored import Stored
from formats.text import printable

_SRGB_GAMMA = 0.45455
"""The gAMA of files in sRGB, whose curve is meant then (https://www.w3.org/TR/png-3/#11sRGB)."""
_ADOBE_GAMMA = 256 / 563
"""Adobe RGB (1998) Color Image Encoding, version 2005-05, 4.3.4.2."""
_NEARLY = 0.01
_CICP_GAMMAS: dict[int, float | None] = {13: None, 8: 1.0, 4: 1 / 2.2, 5: 1 / 2.8}
"""By transfer characteristics (ITU-T H.273, table 3): sRGB, linear, gamma 2.2 and 2.8."""
_CICP_PRIMARIES = {1: gamut.REC709, 9: gamut.REC2020, 12: gamut.P3_D65}
"""By colour primaries (ITU-T H.273, table 2)."""
_UNSPECIFIED = b"\2\2"
"""Primaries and transfer characteristics of a cICP chunk that says nothing."""
_MOST_CODES = 3
"""Largest change of an 8-bit value by a profile that is nearly sRGB."""


class Encoding(NamedTuple):
    """A value v in [0,1] is v^(1/gamma) in linear RGB, or decoded from sRGB if gamma is None."""

    gamma: float | None
    primaries: Primaries | None


def encoding_of(path: str | os.PathLike[str], stored: Stored) -> Encoding:
    """Return what the values mean; everything but sRGB is a warning.

    Raises:
        ImageError: a curve that is not read, such as PQ and HLG.
    """
    if stored.cmyk:
        warn(f"{path}: stores CMYK; it is converted to RGB without a colour profile: save it in sRGB")
    if stored.gain_map:
        warn(f"{path}: its gain map for HDR displays is ignored, so that highlights end at white; save it as .exr")
    chunks = stored.chunks
    if chunks.exposure != "0 EV":
        warn(f"{path}: was written with an exposure of {chunks.exposure}; its values are read as displayed")
    if chunks.cicp is not None and chunks.cicp[:2] != _UNSPECIFIED:
        return _of_cicp(path, chunks.cicp)
    if (profile := chunks.profile) is not None and not stored.cmyk:
        if (name := _other_than_srgb(profile)) is None:
            return Encoding(None, None)
        warn(f"{path}: its colour profile ({name}) is not sRGB and is ignored; convert it to sRGB")
    elif stored.adobe_rgb and not stored.cmyk:
        return Encoding(_ADOBE_GAMMA, Primaries("its EXIF (R03)", gamut.ADOBE_RGB))
    if chunks.srgb:
        return Encoding(None, None)
    return Encoding(_gamma(path, chunks.gamma), _primaries(chunks.chromaticity))


def _of_cicp(path: str | os.PathLike[str], chunk: bytes) -> Encoding:
    colours, transfer, matrix, complete = chunk
    if colours not in _CICP_PRIMARIES or transfer not in _CICP_GAMMAS or matrix != 0 or complete != 1:
        raise ImageError(
            f"{path}: expected colours in sRGB or linear, found a cICP chunk with primaries {colours}, transfer "
            f"{transfer} (16 is PQ, 18 HLG), matrix {matrix} and range {complete}; save it as sRGB, or as .exr"
        )
    gamma = _CICP_GAMMAS[transfer]
    if gamma is not None:
        _warn_of_gamma(path, gamma, "cICP")
    return Encoding(gamma, Primaries("the cICP chunk", _CICP_PRIMARIES[colours]))


def _gamma(path: str | os.PathLike[str], gamma: float | None) -> float | None:
    if gamma is None or abs(gamma / _SRGB_GAMMA - 1.0) < _NEARLY:
        return None
    if gamma <= 0.0:
        warn(f"{path}: its gAMA chunk of {gamma:g} is ignored; the values are taken as sRGB")
        return None
    _warn_of_gamma(path, gamma, "gAMA")
    return gamma


def _warn_of_gamma(path: str | os.PathLike[str], gamma: float, chunk: str) -> None:
    curve = "linear" if gamma == 1.0 else f"encoded with a gamma of {1.0 / gamma:.4g}"
    warn(f"{path}: its {chunk} chunk says that the values are {curve}, and they are read so, not as sRGB")


def _primaries(chromaticity: tuple[float, ...] | None) -> Primaries | None:
    if chromaticity is None:
        return None
    return Primaries("the cHRM chunk", (*chromaticity[2:], *chromaticity[:2]))  # white is stored first


def _other_than_srgb(profile: bytes) -> str | None:
    """Return None if a profile leaves sRGB colours as they are to a few codes, else its name."""
    from PIL import Image, ImageCms

    try:
        opened = ImageCms.getOpenProfile(io.BytesIO(profile))
        name = printable(ImageCms.getProfileDescription(opened).strip()) or "without a name"
        space: Any = opened.profile
        mode = {"RGB ": "RGB", "GRAY": "L"}.get(space.xcolor_space)
        if mode is None:
            return name
        colours = Image.fromarray(_cube() if mode == "RGB" else np.arange(256, dtype=np.uint8)[None])
        transform = ImageCms.buildTransform(
            opened, ImageCms.createProfile("sRGB"), mode, "RGB", ImageCms.Intent.RELATIVE_COLORIMETRIC
        )
        converted = transform.apply(colours)
    except Exception:  # Pillow raises several kinds for damaged profiles, and where it has no colour management
        return "damaged"
    before, after = (np.asarray(picture.convert("RGB")).astype(int) for picture in (colours, converted))
    return None if np.abs(before - after).max() <= _MOST_CODES else name


def _cube() -> np.ndarray[Any, np.dtype[np.uint8]]:
    """All colours of 0, 51, …, 255 per channel [36,6,3]."""
    steps = np.arange(0, 256, 51, dtype=np.uint8)
    return np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(36, 6, 3)
