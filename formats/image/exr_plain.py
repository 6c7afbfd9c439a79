"""Uncompressed OpenEXR scan lines, read as they lie in the file: there is nothing to decode and nothing is copied.

A picture that is not compressed keeps each row by itself: its number and its length in bytes (int32 each), then every
channel's pixels, by the channels' names. https://openexr.com/en/latest/OpenEXRFileLayout.html
"""

import os
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from io import FileIO
from typing import Any

import numpy as np
from numpy.typing import NDArray

_HEAD = 8
_PAGE = 4096
_LONGEST_HEADER = 1 << 20
_MANY_PARTS_OR_DEEP = 0x1A00
"""Flags of a file's version: tiles, deep pixels, several parts."""


@dataclass(frozen=True)
class PlainRows:
    """Where the colour of a picture lies.

    Attributes:
        start: of the first row, in bytes from the beginning of the file.
        size: of a row with its head, in bytes.
        number: of the first row.
        width: pixels of a row.
        kind: of a pixel's channel.
        red: bytes from the beginning of a row to its first red pixel.
        step: bytes from red to green, and from green to blue.
    """

    start: int
    size: int
    number: int
    width: int
    kind: np.dtype[Any]
    red: int
    step: int

    def read(self, file: FileIO, first: int, end: int) -> NDArray[Any]:
        """Rows from number `first` to before `end`, [R,W,3].

        Raises ValueError where the file ends before them or other rows are found.
        """
        count = end - first
        place, length = self.start + (first - self.number) * self.size, count * self.size
        store = np.empty(length + 2 * _PAGE, np.uint8)
        shift = _shift(store.ctypes.data, place, self.kind.itemsize)
        rows = store.data[shift : shift + length]
        file.seek(place)
        there = 0
        while there < length:
            got = file.readinto(rows[there:])
            if not got:
                raise ValueError("the file ends before its rows do")
            there += got
        heads = np.ndarray((count, 2), "<i4", rows, 0, (self.size, 4))
        if (heads[:, 0] != np.arange(first, first + count)).any() or (heads[:, 1] != self.size - _HEAD).any():
            raise ValueError("rows do not begin where the file says")
        return np.ndarray((count, self.width, 3), self.kind, rows, self.red, (self.size, self.kind.itemsize, self.step))


def find_plain_rows(
    path: str | os.PathLike[str],
    window: tuple[int, int, int, int],
    kinds: Mapping[str, np.dtype[Any]],
    names: tuple[str, str, str],
) -> PlainRows | None:
    """Where the channels `names` of an uncompressed picture lie; None where they are of several types or at uneven
    distances, and where the file holds more than one part, rows in another order, or less than all of them.

    window: left, top, right and bottom of the stored rectangle; kinds: of each of the file's channels.
    """
    left, top, right, bottom = window
    width, height = right - left + 1, bottom - top + 1
    places, size = dict[str, int](), _HEAD
    for name in sorted(kinds):
        places[name] = size
        size += width * kinds[name].itemsize
    kind, (red, green, blue) = kinds[names[0]], (places[name] for name in names)
    alike = all(kinds[name] == kind for name in names) and kind.kind == "f" and sys.byteorder == "little"
    if not alike or green - red != blue - green or size % kind.itemsize or red % kind.itemsize:
        return None
    start = _start(path, height, size)
    return None if start is None else PlainRows(start, size, top, width, kind, red, green - red)


def _start(path: str | os.PathLike[str], height: int, size: int) -> int | None:
    """Where the first of `height` rows of `size` bytes lies, if the others follow it and the file holds them all."""
    with open(path, "rb") as file:
        table = _after_header(file.read(_LONGEST_HEADER))
        if table is None:
            return None
        first = table + 8 * height
        if file.seek(0, os.SEEK_END) < first + height * size:
            return None
        file.seek(table)
        offsets = np.frombuffer(file.read(8 * height), "<u8")
    return first if np.array_equal(offsets, first + size * np.arange(height, dtype=np.uint64)) else None


def _after_header(content: bytes) -> int | None:
    """Where the header of a file of one part with scan lines ends."""
    if len(content) < _HEAD or int.from_bytes(content[4:8], "little") & _MANY_PARTS_OR_DEEP:
        return None
    place = _HEAD
    # Attributes: a name, a type, both ended by 0, a length and as many bytes; no name ends them.
    while place < len(content) and content[place]:
        length = content.find(b"\0", content.find(b"\0", place) + 1) + 1
        place = length + 4 + int.from_bytes(content[length : length + 4], "little")
        if length <= _HEAD:
            return None
    return place + 1 if place < len(content) else None


def _shift(address: int, place: int, itemsize: int) -> int:
    """Bytes into a store at `address` where what lies at `place` in the file is put: half a page away from where it
    lies in its own page, and pixels on addresses that they divide.

    Copies between places just after one another, pages aside, take processors up to four times as long.
    """
    shift = (place - address + _PAGE // 2) % _PAGE
    return shift + -(address + shift + _HEAD) % itemsize
