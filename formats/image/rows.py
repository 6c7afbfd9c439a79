"""Reads images in blocks of rows, for images larger than memory; bit for bit as `formats.image.read_image`."""

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from formats.atomic import existing
from formats.image.exr_rows import open_exr_rows
from formats.image.files import read_image
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
    """

    path: str | os.PathLike[str]
    height: int
    width: int
    open_blocks: Callable[[], Iterator[Block]]
    cube: bool = False

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


def open_image(path: str | os.PathLike[str]) -> ImageRows:
    """Open an image of any format that `read_image` reads; layers, luminance, windows and curves are treated alike.

    `.exr` and `.hdr` are decoded block by block. Other formats are kept in memory, and so are an `.hdr` whose rows run
    upward and an `.exr` whose colour is subsampled or not in the first part.

    Raises:
        ImageError, StorageError: as `read_image`; `blocks` raises ImageError if it reaches damage.
    """
    suffix = Path(path).suffix.lower()
    if suffix == ".exr" and (exr := open_exr_rows(existing(path))) is not None:
        return ImageRows(path, exr.height, exr.width, exr.blocks, exr.cube)
    if suffix == ".hdr" and not (hdr := open_rgbe_rows(existing(path))).upward:
        return ImageRows(path, hdr.height, hdr.width, hdr.blocks)
    return rows_of(read_image(path), path)


def rows_of(image: NDArray[np.floating[Any]], name: str | os.PathLike[str] = "image", rows: int = _ROWS) -> ImageRows:
    """Return an image [H,W,3] in memory as `ImageRows`, in blocks of `rows` rows."""

    def blocks() -> Iterator[Block]:
        for first in range(0, len(image), rows):
            yield image[first : first + rows]

    return ImageRows(name, image.shape[0], image.shape[1], blocks)
