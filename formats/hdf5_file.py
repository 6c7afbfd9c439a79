"""Opening HDF5 files of unknown content, and describing what is wrong with them.

Format: https://support.hdfgroup.org/documentation/hdf5/latest/_f_m_t3.html, read with h5py.
"""

import os
import re
import struct
from pathlib import Path
from typing import Any

import h5py

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
_SEARCHED = 2**26
"""Bytes at the beginning and at the end of a file that are searched for heaps: prtbake writes its strings there."""


class DamagedDataError(OSError):
    """A part of a file that cannot be decompressed; the message names the part."""


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
    if _has_endless_heap(path):
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


def _has_endless_heap(path: str | os.PathLike[str]) -> bool:
    """Return whether a heap of strings holds an object that occupies no byte, since HDF5 2.0 loops for ever there.

    A heap is a signature, its size, and objects: index, count, reserved, size, and the content in multiples of 8 bytes.
    The object of index 0 is the free rest, whose size includes its head.
    """
    with open(path, "rb") as file:
        parts = [file.read(_SEARCHED)]
        file.seek(max(file.tell(), os.fstat(file.fileno()).st_size - _SEARCHED))
        parts.append(file.read())
    return any(_is_endless(part, heap.start()) for part in parts for heap in re.finditer(_HEAP_SIGNATURE, part))


def _is_endless(content: bytes, start: int) -> bool:
    """Return whether the heap at `start` has an object that occupies no byte; those that are too long end it."""
    end = min(start + _HEAP.unpack_from(content, start)[1], len(content)) if start + _HEAP.size <= len(content) else 0
    at = start + _HEAP.size
    while at + _HEAP_OBJECT.size <= end:
        index, _, _, size = _HEAP_OBJECT.unpack_from(content, at)
        step = (_HEAP_OBJECT.size + (size + 7) // 8 * 8 if index else size) % 2**64
        if step == 0:
            return True
        at += step
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
