"""OpenEXR: linear radiance, written as float32; any layer that holds RGB or luminance is read, and layers
beside the picture (its standard error, its coverage) are kept apart from it.

Format: https://openexr.com/en/latest/OpenEXRFileLayout.html, through the official `OpenEXR` binding.
"""

import contextlib
import errno
import io
import os
import sys
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from formats.errors import ImageError

_VECTORS = ("position", "normal")
"""Layers that are places or directions: in X, Y and Z, which compositing tools do not take for a colour."""


@dataclass(frozen=True, eq=False)
class Layers:
    """A picture and what its file holds beside it.

    Attributes:
        image: the colour that `read_exr` reads, [H,W,3].
        layers: the other layers by name: [H,W,3] where R, G and B are there (`error`), or X, Y and Z (`normal`), [H,W]
            where Y is (`coverage`); any other channel under its whole name, [H,W].
        attributes: the header's texts by name, those of the picture's own part.
    """

    image: NDArray[np.float32]
    layers: Mapping[str, NDArray[np.float32]]
    attributes: Mapping[str, str]


def read_exr(path: str | os.PathLike[str]) -> NDArray[np.float32]:
    """Read an OpenEXR picture as float32 [H,W,3] over its display window; what the file leaves blank is 0.

    R, G, B are taken, else the first layer by name that has them, else luminance Y repeated; alpha is left out.

    Raises:
        ImageError: no OpenEXR, truncated, or without colour.
    """
    header, channels, names = _read_colour_part(path)
    return _framed(_stacked(channels, names), header)


def read_exr_layers(path: str | os.PathLike[str]) -> Layers:
    """Read an OpenEXR picture with the layers and texts that its part holds beside the colour; raises as
    `read_exr`.
    """
    header, channels, names = _read_colour_part(path)
    rest = {name: pixels for name, pixels in channels.items() if name not in names}
    layers = {}
    for prefix in {name.rpartition(".")[0] for name in rest} - {""}:
        for letters in ("RGB", "XYZ"):
            three = tuple(f"{prefix}.{letter}" for letter in letters)
            if prefix not in layers and all(name in rest for name in three):
                layers[prefix] = _framed(_stacked(rest, three), header)
                rest = {name: pixels for name, pixels in rest.items() if name not in three}
    for name in rest:
        layers[name.removesuffix(".Y")] = _framed(_stacked(rest, (name,)), header)[..., 0]
    image = _framed(_stacked(channels, names), header)
    return Layers(image, layers, {name: text for name, text in header.items() if isinstance(text, str)})


def _read_colour_part(
    path: str | os.PathLike[str],
) -> tuple[dict[str, Any], dict[str, NDArray[Any]], tuple[str, str, str]]:
    """Header, channels and names of the three colour channels of the first part that has colour."""
    import OpenEXR

    refuse_other_kinds(path)
    try:
        with silenced(), OpenEXR.File(os.fspath(path), separate_channels=True) as picture:
            parts = [
                (dict(picture.header(i)), {name: channel.pixels for name, channel in picture.channels(i).items()})
                for i in range(len(picture.parts))
            ]
    except (RuntimeError, ValueError, TypeError, OSError) as cause:
        raise ImageError(f"{path}: cannot be read as OpenEXR, the file is damaged") from cause
    if not parts:
        raise ImageError(f"{path}: the OpenEXR picture is truncated or damaged")
    for header, channels in parts:
        if names := colour_names(channels):
            return header, channels, names
    found = ", ".join(sorted(name for _, channels in parts for name in channels))
    raise ImageError(f"{path}: has no colour: expected channels R, G, B or Y, found {found or 'none'}")


def write_exr(
    path: str | os.PathLike[str],
    image: NDArray[np.floating],
    layers: Mapping[str, NDArray[np.floating]] | None = None,
    attributes: Mapping[str, str] | None = None,
    alpha: NDArray[np.floating] | None = None,
) -> None:
    """Write [H,W,3] as float32 scan lines, ZIP compressed; raises OSError if the disk does not take it.

    layers: beside R, G, B: an array [H,W,3] named `error` becomes error.R, error.G, error.B, one named `position` or
    `normal` X, Y and Z, an array [H,W] named `coverage` becomes coverage.Y. attributes: texts for the header. alpha
    [H,W]: what the image is weighted by, becomes A.
    """
    import OpenEXR

    # OpenEXR writes wrong pixels without a word if an array is not contiguous, and alters the header it is given.
    channels = {"RGB": np.ascontiguousarray(image, np.float32)}
    if alpha is not None:
        channels["A"] = np.ascontiguousarray(alpha, np.float32)
    for name, pixels in (layers or {}).items():
        if name in _VECTORS and np.ndim(pixels) == 3:
            for axis, letter in enumerate("XYZ"):
                channels[f"{name}.{letter}"] = np.ascontiguousarray(pixels[..., axis], np.float32)
        else:
            channels[name if np.ndim(pixels) == 3 else f"{name}.Y"] = np.ascontiguousarray(pixels, np.float32)
    header = {**(attributes or {}), "compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    try:
        with silenced():
            OpenEXR.File(header, channels).write(os.fspath(path))
    except RuntimeError as cause:
        code = errno.ENOSPC if "No space left" in str(cause) else errno.EIO
        raise OSError(code, str(cause)) from cause


def _stacked(channels: Mapping[str, NDArray[Any]], names: tuple[str, ...]) -> NDArray[np.float32]:
    return np.stack([channels[name] for name in names], axis=2).astype(np.float32)


def refuse_other_kinds(path: str | os.PathLike[str]) -> None:
    """Raise ImageError for a file that does not begin as OpenEXR does."""
    with open(path, "rb") as file:
        if file.read(4) != b"\x76\x2f\x31\x01":
            raise ImageError(f"{path}: is not an OpenEXR picture: it does not begin with the magic number 76 2f 31 01")


def colour_names(channels: Collection[str]) -> tuple[str, str, str] | None:
    """The names for red, green and blue among those of `channels`, None where there is no colour."""
    layers = sorted({name.rpartition(".")[0] for name in channels})
    prefixes = [f"{layer}." if layer else "" for layer in layers]
    for prefix in prefixes:
        red, green, blue = (prefix + letter for letter in "RGB")
        if red in channels and green in channels and blue in channels:
            return red, green, blue
    # Luminance beside RY and BY is half of another encoding, not a grey picture.
    grey = next((p + "Y" for p in prefixes if p + "Y" in channels and p + "RY" not in channels), None)
    return None if grey is None else (grey, grey, grey)


def _framed(pixels: NDArray[np.float32], header: Mapping[str, Any]) -> NDArray[np.float32]:
    """Place the stored rectangle (data window) in the picture (display window)."""
    (left, top), (right, bottom) = (tuple(int(c) for c in corner) for corner in header["displayWindow"])
    (x, y), _ = (tuple(int(c) for c in corner) for corner in header["dataWindow"])
    height, width = pixels.shape[:2]
    if (x, y) == (left, top) and (height, width) == (bottom - top + 1, right - left + 1):
        return pixels
    framed = np.zeros((bottom - top + 1, right - left + 1, pixels.shape[2]), np.float32)
    rows = slice(max(y, top), min(y + height, bottom + 1))
    columns = slice(max(x, left), min(x + width, right + 1))
    framed[rows.start - top : rows.stop - top, columns.start - left : columns.stop - left] = pixels[
        rows.start - y : rows.stop - y, columns.start - x : columns.stop - x
    ]
    return framed


@contextlib.contextmanager
def silenced() -> Iterator[None]:
    """Keep the OpenEXR library from writing to standard output and error; what it has to say is said by our errors."""
    sys.stdout.flush()
    sys.stderr.flush()
    # What the binding prints goes through Python's stream, what the library under it says through the descriptors.
    with open(os.devnull, "wb") as nowhere, contextlib.redirect_stdout(io.StringIO()):
        kept = [os.dup(stream) for stream in (1, 2)]
        try:
            for stream in (1, 2):
                os.dup2(nowhere.fileno(), stream)
            yield
        finally:
            for stream, copy in zip((1, 2), kept, strict=True):
                os.dup2(copy, stream)
                os.close(copy)
