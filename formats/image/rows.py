"""Images in blocks of rows, for pictures larger than memory: what `formats.image.read_image` reads, bit by bit."""

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
    """A picture to be read from its top in blocks of rows, as often as one likes.

    Attributes:
        path: of the file, or another name to call it by.
        height, width: in pixels.
        open_blocks: begins at the top and gives block after block, linear float16 or float32 [R,W,3], R at least 1,
            that make up the picture. What is only found when it is come to raises ImageError then.
        cube: whether the file says that it is the six faces of a cube.
    """

    path: str | os.PathLike[str]
    height: int
    width: int
    open_blocks: Callable[[], Iterator[Block]]
    cube: bool = False

    def blocks(self) -> Iterator[tuple[int, Block]]:
        """Blocks of rows from the top, each with the number of its first row."""
        first = 0
        for block in self.open_blocks():
            yield first, block
            first += len(block)

    def whole(self) -> NDArray[np.float32]:
        """The picture, float32 [H,W,3]."""
        image = np.empty((self.height, self.width, 3), np.float32)
        for first, block in self.blocks():
            image[first : first + len(block)] = block
        return image


def open_image(path: str | os.PathLike[str]) -> ImageRows:
    """Open a picture of any kind that `read_image` reads, with what it says of layers, luminance, windows and curves.

    `.exr` and `.hdr` are decoded as their blocks are asked for. The other kinds, `.hdr` whose rows run upward, and
    `.exr` whose colour lies in a part after the first or has fewer pixels than the picture are held whole.

    Raises:
        ImageError, StorageError: as `read_image`; `blocks` raises ImageError too, where the file is damaged.
    """
    suffix = Path(path).suffix.lower()
    if suffix == ".exr" and (exr := open_exr_rows(existing(path))) is not None:
        return ImageRows(path, exr.height, exr.width, exr.blocks, exr.cube)
    if suffix == ".hdr" and not (hdr := open_rgbe_rows(existing(path))).upward:
        return ImageRows(path, hdr.height, hdr.width, hdr.blocks)
    return rows_of(read_image(path), path)


def rows_of(image: NDArray[np.floating[Any]], name: str | os.PathLike[str] = "image", rows: int = _ROWS) -> ImageRows:
    """An image [H,W,3] in memory as if it were read from a file, `rows` at a time."""

    def blocks() -> Iterator[Block]:
        for first in range(0, len(image), rows):
            yield image[first : first + rows]

    return ImageRows(name, image.shape[0], image.shape[1], blocks)
