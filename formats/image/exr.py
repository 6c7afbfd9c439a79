"""OpenEXR (https://openexr.com/en/latest/OpenEXRFileLayout.html), through the official `OpenEXR` binding.

Linear radiance, written as float32. The image is read from any layer with RGB or luminance; further layers, such as
the standard error and the coverage, are returned separately.
"""

import errno
import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from formats.errors import ImageError
from formats.image.exr_colour import ExrColour, open_colour
from formats.image.exr_header import Part, reading, silenced
from formats.image.gamut import Primaries, convert, matrix_to_rec709
from formats.summary import summary

_VECTORS = ("position", "normal")
"""Layers written as X, Y and Z, so that compositing tools do not treat them as a colour."""


@dataclass(frozen=True, eq=False)
class Layers:
    """An image, its further layers and its header texts.

    Attributes:
        image: the colour that `read_exr` returns, [H,W,3].
        layers: the other layers by name: [H,W,3] from channels R, G and B (`error`) or X, Y and Z (`normal`), [H,W]
            from Y (`coverage`), and `A`, the alpha of the colour's own layer. Any other channel is [H,W], under its
            full name.
        attributes: the texts in the header of the image's part, by name.
    """

    image: NDArray[np.float32]
    layers: Mapping[str, NDArray[np.float32]]
    attributes: Mapping[str, str]

    __repr__ = summary


def read_exr(path: str | os.PathLike[str]) -> tuple[NDArray[np.float32], Primaries | None]:
    """Read an OpenEXR image as float32 [H,W,3] over its display window, and what it says about its primaries.

    Pixels without data are 0. `formats.image.exr_colour` chooses the channels; luminance is repeated, alpha is not
    returned. A channel that is stored at every n-th pixel keeps its value over n pixels.

    Raises:
        ImageError: the file is not OpenEXR, is truncated, has no colour or several that are equally good.
    """
    colour = open_colour(path)
    return read_colour(colour), colour.primaries


def read_colour(colour: ExrColour) -> NDArray[np.float32]:
    """Read the chosen channels as float32 [H,W,3], as stored; raises ImageError if the file is damaged."""
    return _to_display_window(_stack(_read_channels(colour), colour.names), colour.part)


def read_exr_data(path: str | os.PathLike[str]) -> NDArray[np.float64]:
    """Read an OpenEXR image as data, float64 [H,W,3]: as `read_exr`, or its only channel, whatever its name."""
    return read_colour(open_colour(path, data=True)).astype(np.float64)


def read_exr_alpha(path: str | os.PathLike[str]) -> NDArray[np.float32] | None:
    """Read the alpha [H,W] of the colour that `read_exr_data` reads, as stored, or None; raises as `read_exr`."""
    colour = open_colour(path, data=True)
    channels = _read_channels(colour)
    if colour.alpha not in channels:
        return None
    return _to_display_window(_stack(channels, (colour.alpha,)), colour.part)[..., 0]


def read_exr_layers(path: str | os.PathLike[str]) -> Layers:
    """Read an OpenEXR image with the further layers and texts of its part; raises as `read_exr`.

    The image is converted to Rec.709. The layers are as stored.
    """
    colour = open_colour(path)
    part, channels = colour.part, _read_channels(colour)
    rest = {name: pixels for name, pixels in channels.items() if name not in colour.names}
    if colour.alpha in rest:
        rest["A"] = rest.pop(colour.alpha)
    layers = {}
    for prefix in {name.rpartition(".")[0] for name in rest} - {""}:
        for letters in ("RGB", "XYZ"):
            triple = tuple(f"{prefix}.{letter}" for letter in letters)
            if prefix not in layers and all(name in rest for name in triple):
                layers[prefix] = _to_display_window(_stack(rest, triple), part)
                rest = {name: pixels for name, pixels in rest.items() if name not in triple}
    for name in rest:
        layers[name.removesuffix(".Y")] = _to_display_window(_stack(rest, (name,)), part)[..., 0]
    image = convert(_to_display_window(_stack(channels, colour.names), part), matrix_to_rec709(path, colour.primaries))
    return Layers(image, layers, {name: text for name, text in part.header.items() if isinstance(text, str)})


def _read_channels(colour: ExrColour) -> dict[str, NDArray[Any]]:
    """Return the channels of the colour's part [h,w] over its data window."""
    import OpenEXR

    part = colour.part
    damaged = ImageError(f"{colour.path}: the OpenEXR image is truncated or damaged; copy it again")
    with reading(colour.path), OpenEXR.File(os.fspath(colour.path), separate_channels=True) as picture:
        # The binding leaves out parts that it cannot read, and numbers the others again.
        names = [str(picture.header(i).get("name", "")) for i in range(len(picture.parts))]
        if part.number >= len(names) or names[part.number] != part.name:
            raise damaged
        stored = {name: channel.pixels for name, channel in picture.channels(part.number).items()}
    if stored.keys() != part.sampling.keys():
        raise damaged
    left, top, right, bottom = part.stored
    channels = {}
    for name, pixels in stored.items():
        across, down = part.sampling[name]
        if (across, down) != (1, 1):
            pixels = np.repeat(np.repeat(pixels, down, axis=0), across, axis=1)
        if pixels.shape != (bottom - top + 1, right - left + 1):
            raise damaged
        channels[name] = pixels
    return channels


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
    _write(path, channels, attributes or {})


def write_exr_halves(path: str | os.PathLike[str], numbers: NDArray[np.float16]) -> None:
    """Write numbers [H,W,3], bit for bit, as the half floats R, G, B of scan lines with ZIP compression.

    Raises OSError if the disk is full or fails.
    """
    _write(path, {"RGB": np.ascontiguousarray(numbers, np.float16)}, {})


def _write(path: str | os.PathLike[str], channels: dict[str, NDArray[Any]], attributes: Mapping[str, str]) -> None:
    import OpenEXR

    header = {**attributes, "compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    try:
        with silenced():
            OpenEXR.File(header, channels).write(os.fspath(path))
    except RuntimeError as cause:
        code = errno.ENOSPC if "No space left" in str(cause) else errno.EIO
        raise OSError(code, str(cause)) from cause


def _stack(channels: Mapping[str, NDArray[Any]], names: tuple[str, ...]) -> NDArray[np.float32]:
    return np.stack([channels[name] for name in names], axis=2).astype(np.float32)


def _to_display_window(pixels: NDArray[np.float32], part: Part) -> NDArray[np.float32]:
    """Copy the stored pixels (data window) into the image (display window)."""
    if part.display == part.stored:
        return pixels
    left, top, right, bottom = part.display
    x, y = part.stored[:2]
    height, width = pixels.shape[:2]
    image = np.zeros((bottom - top + 1, right - left + 1, pixels.shape[2]), np.float32)
    first_row, last_row = max(y, top), min(y + height, bottom + 1)
    first_column, last_column = max(x, left), min(x + width, right + 1)
    if first_row < last_row and first_column < last_column:
        image[first_row - top : last_row - top, first_column - left : last_column - left] = pixels[
            first_row - y : last_row - y, first_column - x : last_column - x
        ]
    return image
