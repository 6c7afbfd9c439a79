"""Images by their suffix: `.exr`, `.hdr`, `.png` and `.jpg`, always linear, Rec.709 primaries, RGB, row 0 on top."""

import os
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from formats.atomic import existing, replacing
from formats.errors import ImageError
from formats.image.exr import Layers, read_exr, read_exr_layers, write_exr
from formats.image.png import read_jpeg, read_png, read_png_alpha, read_png_levels, write_png
from formats.image.rgbe import read_rgbe, write_rgbe

_READERS: dict[str, Callable[[Path], NDArray[np.float32]]] = {
    **{".exr": read_exr, ".hdr": read_rgbe, ".png": read_png},
    **{".jpg": read_jpeg, ".jpeg": read_jpeg},
}
READABLE = tuple(_READERS)
"""Suffixes of what `read_image` reads."""
_WRITTEN = (".exr", ".hdr", ".png")


def read_image(path: str | os.PathLike[str]) -> NDArray[np.float32]:
    """Read an image as linear float32 [H,W,3].

    PNG and JPEG are decoded from sRGB. NaN, infinite and negative pixels of an `.exr` come back as they are: whether
    they matter depends on what the image is for.

    Raises:
        ImageError: another suffix, another kind of file than the suffix says, truncated, or without colour.
        StorageError: the file is missing or cannot be opened.
    """
    suffix = _suffix(path, "read", READABLE)
    return _READERS[suffix](existing(path))


def read_layers(path: str | os.PathLike[str]) -> Layers:
    """Read an image with the layers beside it and the texts of its header.

    A picture of `prtbake render` (.exr) has the layers `error` [H,W,3], one sigma, and `coverage` [H,W], the object's
    share of the pixel. The alpha of `.exr` and `.png` is the layer `A` [H,W]; the colour is as `read_image` has it.
    Raises as `read_image`.
    """
    suffix = _suffix(path, "read", READABLE)
    if suffix == ".exr":
        return read_exr_layers(existing(path))
    alpha = read_png_alpha(existing(path)) if suffix == ".png" else None
    return Layers(read_image(path), {} if alpha is None else {"A": alpha}, {})


def read_levels(path: str | os.PathLike[str]) -> NDArray[np.float64]:
    """Read the first channel of an image as plain numbers, float64 [H,W], row 0 on top.

    A PNG's values are taken as they are stored, from 0 to 1, without the sRGB curve.

    Raises:
        ImageError, StorageError: as `read_image`.
    """
    if Path(path).suffix.lower() == ".png":
        return read_png_levels(existing(path))
    return read_image(path)[..., 0].astype(np.float64)


def write_image(
    path: str | os.PathLike[str],
    image: NDArray[np.floating],
    *,
    exposure: float = 0.0,
    layers: Mapping[str, NDArray[np.floating]] | None = None,
    attributes: Mapping[str, str] | None = None,
    alpha: NDArray[np.floating] | None = None,
) -> None:
    """Write a linear image [H,W,3], whole or not at all.

    `.exr` (float32) and `.hdr` (RGBE) keep radiance and ignore `exposure`; `.png` is multiplied by 2^exposure, clipped
    to [0,1] and encoded as sRGB. layers ([H,W,3] or [H,W] by name) and attributes (texts) go beside the colour of an
    `.exr`, where `read_layers` finds them; other kinds of file have no place for them and leave them out. alpha [H,W]:
    what the image is weighted by, written as the alpha channel of `.exr` and `.png`.

    Raises:
        ImageError: another suffix, another shape, a layer of another size, pixels that the kind of file cannot hold
            (NaN in `.png` and `.hdr`), alpha for `.hdr`.
        StorageError: the disk is full or not writable.
    """
    suffix = _suffix(path, "written", _WRITTEN)
    shape = np.shape(image)
    if len(shape) != 3 or shape[2] != 3 or 0 in shape:
        raise ImageError(f"{path}: expected an image of shape [H,W,3], found {list(shape)}")
    for name, pixels in (layers or {}).items():
        if np.shape(pixels) not in (shape, shape[:2]):
            expected = f"{list(shape)} or {list(shape[:2])}"
            raise ImageError(f"{path}: layer {name}: expected {expected}, found {list(np.shape(pixels))}")
    if alpha is not None and (suffix == ".hdr" or np.shape(alpha) != shape[:2]):
        raise ImageError(
            f"{path}: alpha of shape {list(np.shape(alpha))}; expected {list(shape[:2])}, in an .exr or .png"
        )
    if suffix == ".png" and np.isnan(image).any():
        row, column = np.argwhere(np.isnan(image).any(axis=2))[0]
        raise ImageError(f"{path}: pixels are NaN, the first in row {row}, column {column}; write .exr to look at them")
    with replacing(path) as part:
        if suffix == ".exr":
            write_exr(part, image, layers, attributes, alpha)
        elif suffix == ".hdr":
            write_rgbe(part, image)
        else:
            write_png(part, image, exposure, alpha)


def _suffix(path: str | os.PathLike[str], verb: str, known: tuple[str, ...]) -> str:
    suffix = Path(path).suffix.lower()
    if suffix not in known:
        kinds = f"{', '.join(known[:-1])} or {known[-1]}"
        raise ImageError(f"{path}: images of this kind cannot be {verb}; expected {kinds}, found '{suffix}'")
    return suffix
