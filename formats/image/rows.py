"""Reads images in blocks of rows, for images larger than memory; bit for bit as `formats.image.read_image`."""

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from formats.atomic import existing
from formats.errors import warn
from formats.image.exr import read_colour
from formats.image.exr_rows import open_exr_rows
from formats.image.files import read_linear
from formats.image.gamut import Primaries, converted_blocks, matrix_to_rec709
from formats.image.png import read_png_and_alpha
from formats.image.rgbe import open_rgbe_rows

Block = NDArray[np.floating[Any]]

_ROWS = 32


@dataclass(frozen=True)
class ImageRows:
    """An image that can be read any number of times in blocks of rows, from the top.

    Attributes:
        path: the file, or another name for messages.
        height, width: in pixels.
        open_blocks: starts a new pass, and returns an iterator over linear blocks [R,W,3] in float16 or float32. It
            raises ImageError when it reaches damage.
        cube: whether the file declares itself a cube map, which has six faces.
        layer: what the colours of an `.exr` are read from; empty for other formats.
        other_layers: its other layers of colour.
    """

    path: str | os.PathLike[str]
    height: int
    width: int
    open_blocks: Callable[[], Iterator[Block]]
    cube: bool = False
    layer: str = ""
    other_layers: tuple[str, ...] = ()

    def blocks(self) -> Iterator[tuple[int, Block]]:
        """Yield the blocks from the top, each with the number of its first row."""
        first = 0
        for block in self.open_blocks():
            yield first, block
            first += len(block)

    def read(self) -> NDArray[np.float32]:
        """Return the complete image, float32 [H,W,3]."""
        image = np.empty((self.height, self.width, 3), np.float32)
        for first, block in self.blocks():
            image[first : first + len(block)] = block
        return image


def open_image(path: str | os.PathLike[str], clip: bool = False) -> ImageRows:
    """Open an image of any format that `read_image` reads; layers, luminance, windows and curves are treated alike.

    `.exr` and `.hdr` are decoded block by block. Other formats are kept in memory, and so are an `.hdr` whose rows run
    upward and an `.exr` whose colour is subsampled or not in the first part. `clip`: as in `to_rec709`.

    Raises:
        ImageError, StorageError: as `read_image`; `blocks` raises ImageError if it reaches damage.
    """
    return to_rec709(*open_linear(path), clip)


def to_rec709(opened: ImageRows, primaries: Primaries | None, clip: bool = False) -> ImageRows:
    """`opened` with the colours of its blocks converted to Rec.709, with a warning.

    Colours outside Rec.709 have a negative channel. With `clip` it becomes 0, with another warning after the
    last block.
    """
    matrix = matrix_to_rec709(opened.path, primaries)
    if matrix is None:
        return opened
    return replace(opened, open_blocks=lambda: converted_blocks(opened.path, opened.open_blocks(), matrix, clip))


def open_linear(path: str | os.PathLike[str]) -> tuple[ImageRows, Primaries | None]:
    """Open an image with its own primaries, and return what it says about them; raises as `open_image`."""
    suffix = Path(path).suffix.lower()
    if suffix == ".exr":
        exr = open_exr_rows(existing(path))
        blocks = exr.blocks if exr.in_rows else rows_of(read_colour(exr.colour)).open_blocks
        colour = exr.colour
        return ImageRows(path, exr.height, exr.width, blocks, exr.cube, colour.label, colour.others), colour.primaries
    if suffix == ".hdr":
        hdr = open_rgbe_rows(existing(path))
        header = hdr.header
        blocks = rows_of(np.concatenate(list(hdr.blocks()))[::-1]).open_blocks if header.upward else hdr.blocks
        return ImageRows(path, header.height, header.width, blocks), header.primaries
    if suffix != ".png":
        image, primaries = read_linear(path)
        return rows_of(image, path), primaries
    image, primaries, alpha = read_png_and_alpha(existing(path))
    if alpha is not None:
        warn(f"{path}: {np.mean(alpha < 1.0):.0%} of the pixels are transparent; their colours are read as if opaque")
    return rows_of(image, path), primaries


def rows_of(image: NDArray[np.floating[Any]], name: str | os.PathLike[str] = "image", rows: int = _ROWS) -> ImageRows:
    """Return an image [H,W,3] in memory as `ImageRows`, in blocks of `rows` rows."""

    def blocks() -> Iterator[Block]:
        for first in range(0, len(image), rows):
            yield image[first : first + rows]

    return ImageRows(name, image.shape[0], image.shape[1], blocks)
