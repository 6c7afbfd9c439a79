"""Images by suffix: `.exr`, `.hdr`, `.png` and `.jpg`. In memory they are linear Rec.709 RGB, row 0 on top."""

import os
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from formats.arguments import described
from formats.atomic import existing, replacing
from formats.errors import ImageError
from formats.image.exr import Layers, read_exr, read_exr_alpha, read_exr_data, read_exr_layers, write_exr
from formats.image.exr_header import read_parts
from formats.image.gamut import Primaries, convert, matrix_to_rec709
from formats.image.png import (
    COMMAND,
    read_jpeg,
    read_jpeg_data,
    read_png,
    read_png_alpha,
    read_png_and_alpha,
    read_png_data,
    write_png,
)
from formats.image.png_chunks import read_chunks
from formats.image.rgbe import read_rgbe, refuse_unstorable, write_rgbe
from formats.text import printable

_READERS: dict[str, Callable[[Path], tuple[NDArray[np.float32], Primaries | None]]] = {
    **{".exr": read_exr, ".hdr": read_rgbe, ".png": read_png},
    **{".jpg": read_jpeg, ".jpeg": read_jpeg},
}
_DATA_READERS = {".exr": read_exr_data, ".png": read_png_data, ".jpg": read_jpeg_data, ".jpeg": read_jpeg_data}
READABLE = tuple(_READERS)
"""The suffixes that `read_image` reads."""
_WRITABLE = (".exr", ".hdr", ".png")
_CHANNELS = {"R", "G", "B", "RGB", "RGBA"}
_HEADER = {
    *("channels", "compression", "dataWindow", "displayWindow", "lineOrder", "pixelAspectRatio", "screenWindowCenter"),
    *("screenWindowWidth", "type", "name", "version", "view", "chunkCount", "tiles", "chromaticities"),
}
"""Attributes that an `.exr` has by its format."""
_LONGEST_COMMAND = 10_000
"""Characters that are shown."""


def read_image(path: str | os.PathLike[str]) -> NDArray[np.float32]:
    """Read an image as linear float32 [H,W,3], Rec.709.

    PNG and JPEG are decoded from sRGB, unless their metadata names another curve. Colours with other primaries are
    converted to Rec.709. Both are warnings, as is everything else that can be read in more than one way. NaN,
    infinite and negative pixels of an `.exr` are returned unchanged; colours outside Rec.709 have a negative channel.

    Raises:
        ImageError: an unknown suffix, content of another format, a truncated file, no colour, several layers of colour
            that are equally good.
        StorageError: the file is missing or cannot be opened.

    >>> import numpy as np
    >>> import prt_bake as prt
    >>> prt.write_image("grey.exr", np.full((2, 4, 3), 0.5))
    >>> image = prt.read_image("grey.exr")
    >>> image.shape, image.dtype, float(image.mean())
    ((2, 4, 3), dtype('float32'), 0.5)
    """
    image, primaries = read_linear(path)
    return convert(image, matrix_to_rec709(path, primaries))


def read_linear(path: str | os.PathLike[str]) -> tuple[NDArray[np.float32], Primaries | None]:
    """Read an image as linear float32 [H,W,3] with its own primaries, and what it says about them.

    Raises as `read_image`.
    """
    suffix = _suffix(path, "read", READABLE)
    return _READERS[suffix](existing(path))


def read_layers(path: str | os.PathLike[str]) -> Layers:
    """Read an image with its further layers and the texts of its header; raises as `read_image`.

    An `.exr` of `prtbake render` has the layers `error` [H,W,3], one sigma, and `coverage` [H,W], the fraction of the
    pixel that the object covers. The alpha of `.exr` and `.png` is the layer `A` [H,W].

    >>> import prt_bake as prt
    >>> read = prt.read_layers(prt.example("reference.exr"))
    >>> read.image.shape, read.attributes["prtbake.spp"]
    ((256, 256, 3), '2048')
    >>> {name: layer.shape for name, layer in read.layers.items()}
    {'error': (256, 256, 3), 'coverage': (256, 256)}
    """
    suffix = _suffix(path, "read", READABLE)
    if suffix == ".exr":
        return read_exr_layers(existing(path))
    if suffix != ".png":
        return Layers(read_image(path), {}, {})
    image, primaries, alpha = read_png_and_alpha(existing(path))
    return Layers(convert(image, matrix_to_rec709(path, primaries)), {} if alpha is None else {"A": alpha}, {})


def read_alpha(path: str | os.PathLike[str]) -> NDArray[np.float32] | None:
    """Read the alpha of an image as stored, float32 [H,W], or None if it has none; raises as `read_image`.

    What the file says about its colours has no effect.
    """
    suffix = _suffix(path, "read", READABLE)
    if suffix == ".exr":
        return read_exr_alpha(existing(path))
    return read_png_alpha(existing(path)) if suffix == ".png" else None


def read_data(path: str | os.PathLike[str]) -> NDArray[np.float64]:
    """Read an image as data, float64 [H,W,3], row 0 on top: a roughness or a mask, for example.

    Data is no colour: no curve and no conversion of primaries applies. A PNG or JPEG has values from 0 to 1. Of an
    `.exr` without colour the only channel is read.

    Raises:
        ImageError, StorageError: as `read_image`.
    """
    reader = _DATA_READERS.get(Path(path).suffix.lower())
    return read_linear(path)[0].astype(np.float64) if reader is None else reader(existing(path))


def write_image(
    path: str | os.PathLike[str],
    image: NDArray[np.floating],
    *,
    exposure: float = 0.0,
    layers: Mapping[str, NDArray[np.floating]] | None = None,
    attributes: Mapping[str, str] | None = None,
    alpha: NDArray[np.floating] | None = None,
) -> None:
    """Write a linear image atomically.

    Args:
        path: the file: `.exr` (float32), `.hdr` (RGBE) or `.png` (8-bit sRGB).
        image: linear radiance [H,W,3], row 0 on top.
        exposure: in stops. `.png` is multiplied by 2^exposure and clipped to [0,1]; other formats ignore it.
        layers: further layers [H,W,3] or [H,W] of an `.exr`, by name; other formats ignore them.
        attributes: texts in the header of an `.exr`, by name; a `.png` keeps "prtbake.command" alone, an `.hdr` none.
        alpha: [H,W] from 0 to 1, by which the image is premultiplied; the alpha channel of `.exr` and `.png`.

    Raises:
        ImageError: an unknown suffix, a wrong shape, a name that `.exr` has another use for, pixels that the format
            cannot store (NaN in `.png` and `.hdr`), alpha for `.hdr`.
        StorageError: the disk is full or read-only.

    >>> import numpy as np
    >>> import prt_bake as prt
    >>> image = np.full((2, 2, 3), 0.5)
    >>> prt.write_image("picture.exr", image, layers={"error": 0.1 * image}, attributes={"camera": "front"})
    >>> prt.write_image("picture.png", 2.0 * image)
    >>> float(prt.read_image("picture.png").max())
    1.0
    """
    suffix = _suffix(path, "written", _WRITABLE)
    shape = np.shape(image)
    if len(shape) != 3 or shape[2] != 3 or 0 in shape:
        raise ImageError(f"{path}: image: expected shape [H,W,3], found {list(shape)}")
    _refuse_names(path, layers or {}, attributes or {}, alpha is not None)
    for name, pixels in (layers or {}).items():
        if np.shape(pixels) not in (shape, shape[:2]):
            expected = f"{list(shape)} or {list(shape[:2])}"
            raise ImageError(f"{path}: layer {name}: expected shape {expected}, found {list(np.shape(pixels))}")
        if (kind := np.asarray(pixels).dtype).kind not in "fiub":
            raise ImageError(f"{path}: layer {name}: expected real numbers, found {kind} values")
    if alpha is not None and suffix == ".hdr":
        raise ImageError(f"{path}: alpha: an .hdr cannot store it; write .exr or .png, or leave it out")
    if alpha is not None and np.shape(alpha) != shape[:2]:
        raise ImageError(f"{path}: alpha: expected shape {list(shape[:2])}, found {list(np.shape(alpha))}")
    if suffix == ".png" and np.isnan(image).any():
        row, column = np.argwhere(np.isnan(image).any(axis=2))[0]
        raise ImageError(f"{path}: pixels are NaN, the first in row {row}, column {column}; write .exr to keep them")
    if suffix == ".hdr":
        refuse_unstorable(path, image)
    with replacing(path) as part:
        if suffix == ".exr":
            write_exr(part, image, layers, attributes, alpha)
        elif suffix == ".hdr":
            write_rgbe(part, image)
        else:
            write_png(part, image, exposure, alpha, (attributes or {}).get(COMMAND, ""))


def read_command(path: str | os.PathLike[str]) -> str:
    """Read the command by which prtbake wrote an `.exr` or a `.png`; empty if there is none."""
    texts: list[object] = []
    if (suffix := Path(path).suffix.lower()) == ".png":
        texts = [read_chunks(path).command]
    elif suffix == ".exr":
        texts = [part.header.get(COMMAND) for part in read_parts(path)]
    return next((printable(text, _LONGEST_COMMAND) for text in texts if isinstance(text, str)), "")


def _refuse_names(
    path: str | os.PathLike[str], layers: Mapping[str, object], attributes: Mapping[str, object], alpha: bool
) -> None:
    """Raise ImageError for names of layers and attributes that an `.exr` cannot have, or that mean something else."""
    channels = _CHANNELS | ({"A"} if alpha else set())
    for what, names, taken in (("layer", layers, channels), ("attribute", attributes, _HEADER)):
        for name in names:
            if not isinstance(name, str) or not name.isprintable() or name.strip(" .") != name or not name:
                raise ImageError(f"{path}: {what}: expected a name of printable characters, found {name!r}")
            if name in taken:
                raise ImageError(f"{path}: {what} {name}: is the name of a part of the picture; choose another")
    for name, value in attributes.items():
        if not isinstance(value, str):
            raise ImageError(f"{path}: attribute {name}: expected a text, found {described(value)}")


def _suffix(path: str | os.PathLike[str], verb: str, known: tuple[str, ...]) -> str:
    suffix = Path(path).suffix.lower()
    if suffix not in known:
        kinds = f"{', '.join(known[:-1])} or {known[-1]}"
        found = "a folder" if Path(path).is_dir() else f"'{suffix}'"
        raise ImageError(f"{path}: the image cannot be {verb}; expected {kinds}, found {found}")
    return suffix
