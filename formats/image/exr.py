"""OpenEXR (https://openexr.com/en/latest/OpenEXRFileLayout.html), through the official `OpenEXR` binding.

Linear radiance, written as float32. The image is read from any layer with RGB or luminance; further layers, such as
the standard error and the coverage, are returned separately.
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
"""Layers written as X, Y and Z, so that compositing tools do not treat them as a colour."""


@dataclass(frozen=True, eq=False)
class Layers:
    """An image, its further layers and its header texts.

    Attributes:
        image: the colour that `read_exr` returns, [H,W,3].
        layers: the other layers by name: [H,W,3] from channels R, G and B (`error`) or X, Y and Z (`normal`), [H,W]
            from Y (`coverage`). Any other channel is [H,W], under its full name.
        attributes: the texts in the header of the image's part, by name.
    """

    image: NDArray[np.float32]
    layers: Mapping[str, NDArray[np.float32]]
    attributes: Mapping[str, str]


def read_exr(path: str | os.PathLike[str]) -> NDArray[np.float32]:
    """Read an OpenEXR image as float32 [H,W,3] over its display window; pixels without data are 0.

    The colour is R, G, B, else that of the first layer by name that has them, else luminance Y repeated. Alpha is not
    returned.

    Raises:
        ImageError: the file is not OpenEXR, is truncated, or has no colour.
    """
    header, channels, names = _read_colour_part(path)
    return _to_display_window(_stack(channels, names), header)


def read_exr_layers(path: str | os.PathLike[str]) -> Layers:
    """Read an OpenEXR image with the further layers and texts of its part; raises as `read_exr`."""
    header, channels, names = _read_colour_part(path)
    rest = {name: pixels for name, pixels in channels.items() if name not in names}
    layers = {}
    for prefix in {name.rpartition(".")[0] for name in rest} - {""}:
        for letters in ("RGB", "XYZ"):
            triple = tuple(f"{prefix}.{letter}" for letter in letters)
            if prefix not in layers and all(name in rest for name in triple):
                layers[prefix] = _to_display_window(_stack(rest, triple), header)
                rest = {name: pixels for name, pixels in rest.items() if name not in triple}
    for name in rest:
        layers[name.removesuffix(".Y")] = _to_display_window(_stack(rest, (name,)), header)[..., 0]
    image = _to_display_window(_stack(channels, names), header)
    return Layers(image, layers, {name: text for name, text in header.items() if isinstance(text, str)})


def _read_colour_part(
    path: str | os.PathLike[str],
) -> tuple[dict[str, Any], dict[str, NDArray[Any]], tuple[str, str, str]]:
    """Return the header, the channels and the names of the colour channels of the first part that has colour."""
    import OpenEXR

    refuse_other_kinds(path)
    try:
        with silenced(), OpenEXR.File(os.fspath(path), separate_channels=True) as picture:
            parts = [
                (dict(picture.header(i)), {name: channel.pixels for name, channel in picture.channels(i).items()})
                for i in range(len(picture.parts))
            ]
    except (RuntimeError, ValueError, TypeError, OSError) as cause:
        raise ImageError(f"{path}: cannot be read as OpenEXR: it is truncated or damaged; copy it again") from cause
    if not parts:
        raise ImageError(f"{path}: the OpenEXR image has no parts: it is truncated or damaged; copy it again")
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
    """Write an image [H,W,3] as float32 scan lines with ZIP compression.

    Args:
        path: the file.
        image: becomes R, G, B.
        layers: arrays by name. [H,W,3] named `error` becomes error.R, error.G, error.B; `position` and `normal` get X,
            Y and Z. [H,W] named `coverage` becomes coverage.Y.
        attributes: texts for the header.
        alpha: [H,W], by which the image is premultiplied; becomes A.

    Raises:
        OSError: the disk is full or fails.
    """
    import OpenEXR

    # OpenEXR silently writes wrong pixels if an array is not contiguous, and changes the header that it is given.
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


def _stack(channels: Mapping[str, NDArray[Any]], names: tuple[str, ...]) -> NDArray[np.float32]:
    return np.stack([channels[name] for name in names], axis=2).astype(np.float32)


def refuse_other_kinds(path: str | os.PathLike[str]) -> None:
    """Raise ImageError for a file that does not begin with the magic number of OpenEXR."""
    with open(path, "rb") as file:
        if (found := file.read(4)) != b"\x76\x2f\x31\x01":
            start = found.hex(" ") or "nothing"
            raise ImageError(f"{path}: is not an OpenEXR image: expected the magic number 76 2f 31 01, found {start}")


def colour_names(channels: Collection[str]) -> tuple[str, str, str] | None:
    """Return the names of the red, green and blue channel, or None if there is no colour."""
    layers = sorted({name.rpartition(".")[0] for name in channels})
    prefixes = [f"{layer}." if layer else "" for layer in layers]
    for prefix in prefixes:
        red, green, blue = (prefix + letter for letter in "RGB")
        if red in channels and green in channels and blue in channels:
            return red, green, blue
    # Luminance together with RY and BY is the luminance/chroma encoding, not a grey image.
    grey = next((p + "Y" for p in prefixes if p + "Y" in channels and p + "RY" not in channels), None)
    return None if grey is None else (grey, grey, grey)


def _to_display_window(pixels: NDArray[np.float32], header: Mapping[str, Any]) -> NDArray[np.float32]:
    """Copy the stored pixels (data window) into the image (display window)."""
    (left, top), (right, bottom) = (tuple(int(c) for c in corner) for corner in header["displayWindow"])
    (x, y), _ = (tuple(int(c) for c in corner) for corner in header["dataWindow"])
    height, width = pixels.shape[:2]
    if (x, y) == (left, top) and (height, width) == (bottom - top + 1, right - left + 1):
        return pixels
    image = np.zeros((bottom - top + 1, right - left + 1, pixels.shape[2]), np.float32)
    rows = slice(max(y, top), min(y + height, bottom + 1))
    columns = slice(max(x, left), min(x + width, right + 1))
    image[rows.start - top : rows.stop - top, columns.start - left : columns.stop - left] = pixels[
        rows.start - y : rows.stop - y, columns.start - x : columns.stop - x
    ]
    return image


@contextlib.contextmanager
def silenced() -> Iterator[None]:
    """Suppress what the OpenEXR library prints to standard output and error."""
    sys.stdout.flush()
    sys.stderr.flush()
    # The binding prints through Python's streams, the library through the file descriptors.
    with open(os.devnull, "wb") as null, contextlib.redirect_stdout(io.StringIO()):
        saved = [os.dup(stream) for stream in (1, 2)]
        try:
            for stream in (1, 2):
                os.dup2(null.fileno(), stream)
            yield
        finally:
            for stream, copy in zip((1, 2), saved, strict=True):
                os.dup2(copy, stream)
                os.close(copy)
