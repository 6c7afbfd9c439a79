"""Opening HDF5 files of unknown content, and describing what is wrong with them.

Format: https://support.hdfgroup.org/documentation/hdf5/latest/_f_m_t3.html, read with h5py.
"""

import os
import re
import reprlib
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from formats.atomic import existing
from formats.errors import FormatError

HDF5_ERRORS = (OSError, RuntimeError, KeyError, ValueError, TypeError, AttributeError)
"""What h5py raises on damaged files."""
_EXPECTED_SIZE = re.compile(r"stored_eof = (\d+)")
"""The size that HDF5 expects of a truncated file, in its message."""
_SIGNATURE = b"\x89HDF\r\n\x1a\n"
_HEAP = struct.Struct("<8sQ")
_HEAP_SIGNATURE = b"GCOL\x01\0\0\0"
_HEAP_OBJECT = struct.Struct("<HHIQ")
_REFERENCE = struct.Struct("<IQI")
_SEARCHED = 2**24
"""Bytes at the beginning and at the end of a file that are searched for heaps: prtbake writes its strings there."""


class DamagedDataError(OSError):
    """A part of a file that cannot be decompressed; the message names the part."""


def attribute(node: Any, name: str) -> Any:
    """The attribute `name` of an open file, group or dataset.

    An array of one value counts as the value, and bytes as UTF-8 text: other programs write both.
    """
    value = node.attrs[name]
    if isinstance(value, np.ndarray) and value.size == 1:
        value = value.item()
    return value.decode(errors="replace") if isinstance(value, bytes) else value


def as_float32(values: NDArray[np.floating]) -> NDArray[np.float32]:
    """The values in float32; those beyond its range become infinite, without a warning."""
    with np.errstate(over="ignore"):
        return values.astype(np.float32, copy=False)


def found(value: Any) -> str:
    """An attribute's value in words, for messages."""
    if isinstance(value, np.ndarray):
        return f"an array of shape {list(value.shape)}"
    return reprlib.repr(value.item() if isinstance(value, np.generic) else value)


def open_hdf5(path: str | os.PathLike[str], error: type[FormatError], is_not: str, remedy: str) -> Any:
    """Open an HDF5 file to read.

    Args:
        path: the file.
        error: the class of errors to raise.
        is_not: the message for a file of another kind, such as "is not an asset".
        remedy: the advice in messages, such as "bake it".

    Raises:
        FormatError: `error`, if the file is empty, truncated, damaged or of another kind.
        StorageError: the file is missing.
    """
    with open(existing(path), "rb") as file:
        signature = file.read(len(_SIGNATURE))
    if not signature:
        raise error(f"{path}: is empty; expected an HDF5 file; copy or {remedy} again")
    if signature != _SIGNATURE:
        raise error(f"{path}: {is_not}: expected an HDF5 file, found a file that begins with {signature!r}")
    if _has_damaged_strings(path):
        raise error(f"{path}: is damaged: a part of it cannot be read; copy or {remedy} again")
    try:
        return h5py.File(path, "r")
    except HDF5_ERRORS as cause:
        size = Path(path).stat().st_size
        expected = _EXPECTED_SIZE.search(str(cause))
        if expected is not None and int(expected[1]) > size:
            raise error(f"{path}: is truncated: has {size} bytes of {expected[1]}; copy or {remedy} again") from cause
        if isinstance(cause, OSError) and cause.errno is not None:
            raise error(f"{path}: {describe_damage(cause)}; copy or {remedy} again") from cause
        raise error(f"{path}: is damaged or truncated, {size} bytes long; copy or {remedy} again") from cause


def _has_damaged_strings(path: str | os.PathLike[str]) -> bool:
    """Return whether HDF5 2.0 would loop for ever or reserve gigabytes for a string.

    Strings lie in heaps: a signature, the heap's size, and objects: index, count, reserved, size, and the content in
    multiples of 8 bytes. The object of index 0 is the free rest, whose size includes its head. Attributes refer to
    strings by length, address of the heap, and index.
    """
    size = os.path.getsize(path)
    with open(path, "rb") as file:
        parts = [(0, file.read(_SEARCHED))]
        parts.append((file.seek(max(file.tell(), size - _SEARCHED)), file.read()))
    for offset, part in parts:
        for heap in _places(part, _HEAP_SIGNATURE):
            if _is_endless(part, heap) or _too_long(part, offset + heap, size):
                return True
    return False


def _places(content: bytes, pattern: bytes) -> Iterator[int]:
    place = content.find(pattern)
    while place >= 0:
        yield place
        place = content.find(pattern, place + 1)


def _is_endless(content: bytes, start: int) -> bool:
    """Return whether the heap at `start` has an object that occupies no byte; one that is too long ends it."""
    end = min(start + _HEAP.unpack_from(content, start)[1], len(content)) if start + _HEAP.size <= len(content) else 0
    at = start + _HEAP.size
    while at + _HEAP_OBJECT.size <= end:
        index, _, _, size = _HEAP_OBJECT.unpack_from(content, at)
        step = (_HEAP_OBJECT.size + (size + 7) // 8 * 8 if index else size) % 2**64
        if step == 0:
            return True
        at += step
    return False


def _too_long(content: bytes, address: int, size: int) -> bool:
    """Return whether a string in the heap at `address` is longer than the whole file, according to a reference."""
    for place in _places(content[:-4], address.to_bytes(8, "little")):
        length, _, index = _REFERENCE.unpack_from(content, max(0, place - 4))
        if length > size and 0 < index < 2**16:
            return True
    return False


def first_fault(faults: list[str], remedy: str) -> str:
    """Return the first of some faults, the number of the others, and the remedy if the fault names none."""
    more = f" (and {len(faults) - 1} more faults)" if len(faults) > 1 else ""
    return f"{faults[0]}{more}" if ";" in faults[0] else f"{faults[0]}{more}; {remedy}"


def describe_damage(cause: BaseException) -> str:
    """Return what is wrong with a file as the end of a sentence, without the wording of h5py."""
    if isinstance(cause, DamagedDataError):
        return f"is damaged: {cause}"
    if isinstance(cause, OSError) and cause.errno is not None:
        return f"cannot be read: {os.strerror(cause.errno)}"
    return "is damaged: a part of it cannot be read"
