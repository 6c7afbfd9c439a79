"""Strings in HDF5 files of unknown content, checked before HDF5 reads them.

HDF5 2.0 trusts what a file says of its strings: on damaged files it reserves gigabytes, loops for ever or crashes.

Strings lie in heaps: a signature, the heap's size, and objects: index, count, reserved, size, and the content in
multiples of 8 bytes. The object of index 0 is the free rest, whose size includes its head. Attributes and datasets
refer to a string by its length, the address of its heap, and its index. The names in a group lie in a heap of their
own: a signature, the size, the first free block and the address of the content; a free block begins with the place of
the next one.

Format: https://support.hdfgroup.org/documentation/hdf5/latest/_f_m_t3.html.
"""

import math
import os
import re
import struct
from typing import Any, BinaryIO

import h5py

_ATTRIBUTE = re.compile(
    rb"\x19[\x01\x11\x21][\0\x01]\0\x10\0\0\0(?:.{16}\x01\0\0.{5}|.{12}\x02\0\0\0)(?P<reference>.{16})", re.DOTALL
)
"""A string in an attribute: its type, the shape of a single value, and its reference; attributes have two layouts."""
_VALUES = (h5py.h5t.INTEGER, h5py.h5t.FLOAT, h5py.h5t.ENUM, h5py.h5t.STRING)
"""The classes of attributes that are read; some others crash h5py if they are damaged."""
_HEAP = struct.Struct("<8sQ")
_HEAP_SIGNATURE = b"GCOL\x01\0\0\0"
_HEAP_OBJECT = struct.Struct("<HHIQ")
_REFERENCE = struct.Struct("<IQI")
_NAMES = re.compile(rb"HEAP\0{4}.{8}(?P<free>.{16})", re.DOTALL)
_NO_MORE = 1
"""The place of the next free block in the last one."""
_SEARCHED = 2**24
"""Bytes at a file's beginning and end that are searched for heaps and attributes: prtbake writes them there."""


class DamagedDataError(OSError):
    """A part of a file that cannot be decompressed or read; the message names the part."""


def has_damaged_strings(path: str | os.PathLike[str]) -> bool:
    """Return whether an attribute refers to a string that is not there, or the free blocks among names never end."""
    with open(path, "rb") as file:
        parts = [file.read(_SEARCHED)]
        file.seek(max(file.tell(), os.path.getsize(path) - _SEARCHED))
        parts.append(file.read())
        references = [found["reference"] for part in parts for found in _ATTRIBUTE.finditer(part)]
        names = [found["free"] for part in parts for found in _NAMES.finditer(part)]
        return not (all(_is_whole(file, string) for string in references) and all(_ends(file, free) for free in names))


def is_readable(attribute: Any) -> bool:
    """Return whether a low-level attribute of h5py holds numbers or text, in references of the right size."""
    kind = attribute.get_type()
    if kind.get_class() != h5py.h5t.STRING or not kind.is_variable_str():
        return kind.get_class() in _VALUES
    return bool(attribute.get_storage_size() == _REFERENCE.size * math.prod(attribute.shape or ()))


def read_string(dataset: Any) -> Any:
    """Return the string that is the single value of an open dataset, in bytes.

    Raises:
        DamagedDataError: the dataset holds no string, or its string is not there.
    """
    offset = dataset.id.get_offset()
    with open(dataset.file.filename, "rb") as file:
        file.seek(offset or 0)
        whole = offset is None or _is_whole(file, file.read(_REFERENCE.size))
    if not whole or h5py.check_string_dtype(dataset.dtype) is None:
        raise DamagedDataError(f"{dataset.name}: the text cannot be read")
    return dataset[()]


def _is_whole(file: BinaryIO, reference: bytes) -> bool:
    """Return whether a reference gives the length of its string; an empty string needs none."""
    length, address, index = _REFERENCE.unpack(reference)
    return bool(length == 0 or _sizes(file, address).get(index) == length)


def _ends(file: BinaryIO, free: bytes) -> bool:
    """Return whether the list of free blocks among names, whose head is `free`, ends."""
    place, address = struct.unpack("<QQ", free)
    seen: set[int] = set()
    while place != _NO_MORE and place not in seen:
        seen.add(place)
        file.seek(min(address + place, os.fstat(file.fileno()).st_size))
        next_place = file.read(8)
        if len(next_place) < 8:
            return True
        (place,) = struct.unpack("<Q", next_place)
    return bool(place == _NO_MORE)


def _sizes(file: BinaryIO, address: int) -> dict[int, int]:
    """Return the sizes of the strings in the heap at `address` by their indices; none if it is damaged or no heap."""
    file.seek(min(address, os.fstat(file.fileno()).st_size))
    head = file.read(_HEAP.size)
    if not head.startswith(_HEAP_SIGNATURE) or len(head) < _HEAP.size:
        return {}
    content = file.read(min(max(0, _HEAP.unpack(head)[1] - _HEAP.size), _SEARCHED))
    sizes: dict[int, int] = {}
    at = 0
    while at + _HEAP_OBJECT.size <= len(content):
        index, _, _, size = _HEAP_OBJECT.unpack_from(content, at)
        step = _HEAP_OBJECT.size + (size + 7) // 8 * 8 if index else size
        if step == 0 or at + step > len(content):
            return {}
        sizes[index] = size
        at += step
    return sizes
