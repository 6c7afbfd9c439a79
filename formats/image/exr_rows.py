"""OpenEXR pictures too large for memory: their colour in blocks of rows, by the conventions of `formats.image.exr`."""

import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from formats.errors import ImageError
from formats.image.exr import colour_names, refuse_other_kinds, silenced

_ROWS = 32
"""As many rows as most compressions pack together (`_PACKED` has the others): none is unpacked twice."""
_PACKED = {"DWAB_COMPRESSION": 256, "HTJ2K256_COMPRESSION": 256}
_TYPES = (np.dtype(np.uint32), np.dtype(np.float16), np.dtype(np.float32))
_DAMAGE = (RuntimeError, ValueError, TypeError, OSError)
"""What the binding raises for a file that is not whole."""


@dataclass(frozen=True, eq=False)
class ExrRows:
    """What is needed to read the colour of a picture in blocks of rows.

    Attributes:
        path: of the file.
        names: of its channels for red, green and blue.
        display: left, top, right and bottom of the picture; the last two belong to it.
        stored: the same of the rectangle that the file holds pixels of.
        rows: of a block.
        cube: whether the file says that it is the six faces of a cube.
    """

    path: str | os.PathLike[str]
    names: tuple[str, str, str]
    display: tuple[int, int, int, int]
    stored: tuple[int, int, int, int]
    rows: int
    cube: bool

    @property
    def height(self) -> int:
        """Rows of the picture."""
        return self.display[3] - self.display[1] + 1

    @property
    def width(self) -> int:
        """Columns of the picture."""
        return self.display[2] - self.display[0] + 1

    def blocks(self) -> Iterator[NDArray[Any]]:
        """The picture from its top in blocks [R,W,3] of the type that is stored; raises ImageError where it is
        damaged.
        """
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
                # Blocks end where what is packed together ends.
                end = min(last, row + self.rows - (row - self.stored[1]) % self.rows)
                try:
                    block = read(row, end)
                except _DAMAGE as cause:
                    place = f"row {row - self.display[1]} of {self.height}"
                    raise ImageError(f"{self.path}: the OpenEXR picture is truncated or damaged in {place}") from cause
                yield block
                row = end

    @contextmanager
    def _reader(self) -> Iterator[Callable[[int, int], NDArray[Any]]]:
        """What reads the block of rows from one number to before another."""
        import OpenEXR

        try:
            with silenced():
                picture = OpenEXR.InputFile(os.fspath(self.path))
                types = {name: _TYPES[channel.type.v] for name, channel in picture.header()["channels"].items()}
        except _DAMAGE as cause:
            raise ImageError(f"{self.path}: cannot be read as OpenEXR, the file is damaged") from cause
        with closing(picture):
            yield partial(self._decoded, picture, types)

    def _decoded(self, picture: Any, types: Mapping[str, np.dtype[Any]], row: int, end: int) -> NDArray[Any]:
        different = sorted(set(self.names))
        with silenced():
            planes = picture.channels(different, scanLine1=row, scanLine2=end - 1)
        shape = end - row, self.stored[2] - self.stored[0] + 1
        read = {
            name: np.frombuffer(plane, types[name]).reshape(shape)
            for name, plane in zip(different, planes, strict=True)
        }
        return self._framed([read[name] for name in self.names])

    def _framed(self, planes: list[NDArray[Any]]) -> NDArray[Any]:
        """Planes of the stored columns [R,w] as a block of the picture's [R,W,3]."""
        kind = np.result_type(*planes)
        kind = kind if kind.kind == "f" else np.dtype(np.float32)
        begin, end = self.stored[0] - self.display[0], self.stored[2] + 1 - self.display[0]
        whole = begin == 0 and end == self.width
        if whole and planes[0] is planes[1] is planes[2] and planes[0].dtype == kind:
            return np.broadcast_to(planes[0][..., None], (*planes[0].shape, 3))
        # A plane each: sums over one channel run along memory.
        block = (np.empty if whole else np.zeros)((3, len(planes[0]), self.width), kind)
        left, right = min(max(begin, 0), self.width), max(min(end, self.width), 0)
        for channel, plane in zip(block, planes, strict=True):
            channel[:, left:right] = plane[:, left - begin : max(right, left) - begin]
        return np.moveaxis(block, 0, 2)

    def _blank(self, rows: int) -> Iterator[NDArray[Any]]:
        for first in range(0, rows, self.rows):
            yield np.zeros((min(self.rows, rows - first), self.width, 3), np.float32)


def open_exr_rows(path: str | os.PathLike[str]) -> ExrRows | None:
    """What `read_exr` reads of a file, ready to be read in blocks of rows; None where the binding cannot do so: colour
    that is not in the first part, or at a fraction of the resolution.

    Raises ImageError as `read_exr`; damage beyond the header is found when it is come to.
    """
    import OpenEXR

    refuse_other_kinds(path)
    try:
        with silenced(), OpenEXR.File(os.fspath(path), separate_channels=True, header_only=True) as picture:
            headers = [dict(picture.header(i)) for i in range(len(picture.parts))]
    except _DAMAGE as cause:
        raise ImageError(f"{path}: cannot be read as OpenEXR, the file is damaged") from cause
    if not headers:
        raise ImageError(f"{path}: the OpenEXR picture is truncated or damaged")
    header = headers[0]
    names = colour_names([channel.name for channel in header["channels"]])
    coarse = any(channel.xSampling != 1 or channel.ySampling != 1 for channel in header["channels"])
    if names is None or coarse or header["type"] not in (OpenEXR.scanlineimage, OpenEXR.tiledimage):
        return None
    rows = int(header["tiles"].ySize) if "tiles" in header else _PACKED.get(header["compression"].name, _ROWS)
    cube = header.get("envmap") == OpenEXR.ENVMAP_CUBE
    return ExrRows(path, names, _window(header["displayWindow"]), _window(header["dataWindow"]), rows, cube)


def _window(corners: Any) -> tuple[int, int, int, int]:
    (left, top), (right, bottom) = corners
    return int(left), int(top), int(right), int(bottom)
