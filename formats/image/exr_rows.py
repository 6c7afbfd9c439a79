"""Reads the colour of an OpenEXR image in blocks of rows, by the conventions of `formats.image.exr`."""

import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from formats.image.exr_colour import ExrColour, open_colour
from formats.image.exr_header import Window, reading

_ROWS = 32
"""Rows that most compressions pack together, so that no row is unpacked twice."""
_PACKED = {"DWAB_COMPRESSION": 256, "HTJ2K256_COMPRESSION": 256}
"""Rows that the other compressions pack together."""
_TYPES = (np.dtype(np.uint32), np.dtype(np.float16), np.dtype(np.float32))


@dataclass(frozen=True, eq=False)
class ExrRows:
    """An OpenEXR image, read in blocks of rows.

    Attributes:
        path: the file.
        colour: its channels for red, green and blue.
        rows: rows of a block.
        cube: whether the file declares itself a cube map.
    """

    path: str | os.PathLike[str]
    colour: ExrColour
    rows: int
    cube: bool

    @property
    def in_rows(self) -> bool:
        """Whether rows of it are read: the colour is in the first part, and all its pixels are stored.

        The binding's reader of rows crashes on files with a preview.
        """
        part = self.colour.part
        return part.number == 0 and not self.colour.subsampled and "preview" not in part.header

    @property
    def display(self) -> Window:
        """The display window."""
        return self.colour.part.display

    @property
    def stored(self) -> Window:
        """The data window."""
        return self.colour.part.stored

    @property
    def height(self) -> int:
        """Number of rows of the display window."""
        return self.display[3] - self.display[1] + 1

    @property
    def width(self) -> int:
        """Number of columns of the display window."""
        return self.display[2] - self.display[0] + 1

    def blocks(self) -> Iterator[NDArray[Any]]:
        """Yield blocks [R,W,3] of the stored type, from the top; raises ImageError if it reaches damage."""
        top, bottom = self.display[1], self.display[3] + 1
        first = min(max(self.stored[1], top), bottom)
        last = max(min(self.stored[3] + 1, bottom), first)
        yield from self._blank(first - top)
        if last > first:
            yield from self._read(first, last)
        yield from self._blank(bottom - last)

    def _read(self, first: int, last: int) -> Iterator[NDArray[Any]]:
        row = first
        with self._reader() as read:
            while row < last:
                # Blocks end where a packed group of rows ends.
                end = min(last, row + self.rows - (row - self.stored[1]) % self.rows)
                with reading(self.path, f"row {row - self.display[1]} of {self.height}"):
                    block = read(row, end)
                yield block
                row = end

    @contextmanager
    def _reader(self) -> Iterator[Callable[[int, int], NDArray[Any]]]:
        """Yield a function (first row, last row + 1) → block."""
        import OpenEXR

        with reading(self.path):
            picture = OpenEXR.InputFile(os.fspath(self.path))
            types = {name: _TYPES[channel.type.v] for name, channel in picture.header()["channels"].items()}
        with closing(picture):
            yield partial(self._decoded, picture, types)

    def _decoded(self, picture: Any, types: Mapping[str, np.dtype[Any]], row: int, end: int) -> NDArray[Any]:
        different = sorted(set(self.colour.names))
        planes = picture.channels(different, scanLine1=row, scanLine2=end - 1)
        shape = end - row, self.stored[2] - self.stored[0] + 1
        read = {
            name: np.frombuffer(plane, types[name]).reshape(shape)
            for name, plane in zip(different, planes, strict=True)
        }
        return self._framed([read[name] for name in self.colour.names])

    def _framed(self, planes: list[NDArray[Any]]) -> NDArray[Any]:
        """Copy three planes of the data window's columns [R,w] into a block of the display window's [R,W,3]."""
        kind = np.result_type(*planes)
        kind = kind if kind.kind == "f" else np.dtype(np.float32)
        begin, end = self.stored[0] - self.display[0], self.stored[2] + 1 - self.display[0]
        complete = begin == 0 and end == self.width
        if complete and planes[0] is planes[1] is planes[2] and planes[0].dtype == kind:
            return np.broadcast_to(planes[0][..., None], (*planes[0].shape, 3))
        # One plane per channel, so that sums over a channel read contiguous memory.
        block = (np.empty if complete else np.zeros)((3, len(planes[0]), self.width), kind)
        left, right = min(max(begin, 0), self.width), max(min(end, self.width), 0)
        for channel, plane in zip(block, planes, strict=True):
            channel[:, left:right] = plane[:, left - begin : max(right, left) - begin]
        return np.moveaxis(block, 0, 2)

    def _blank(self, rows: int) -> Iterator[NDArray[Any]]:
        for first in range(0, rows, self.rows):
            yield np.zeros((min(self.rows, rows - first), self.width, 3), np.float32)


def open_exr_rows(path: str | os.PathLike[str]) -> ExrRows:
    """Open an OpenEXR image for reading in blocks of rows.

    Raises ImageError as `read_exr`; damage beyond the header is detected when it is read.
    """
    import OpenEXR

    colour = open_colour(path)
    header = colour.part.header
    with reading(path):
        rows = int(header["tiles"].ySize) if "tiles" in header else _PACKED.get(header["compression"].name, _ROWS)
    return ExrRows(path, colour, rows, header.get("envmap") == OpenEXR.ENVMAP_CUBE)
