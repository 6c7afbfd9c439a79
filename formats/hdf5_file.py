"""Opening HDF5 files that may be anything, and telling what is wrong with them."""

import os
import re
from pathlib import Path
from typing import Any

import h5py

from formats.atomic import existing
from formats.errors import FormatError

DAMAGE = (OSError, RuntimeError, KeyError, ValueError, TypeError, AttributeError)
"""What h5py raises on damaged files."""
_ENDS = re.compile(r"stored_eof = (\d+)")
"""Where HDF5 expects the end of a file that it finds truncated."""
_SIGNATURE = b"\x89HDF\r\n\x1a\n"


class Damage(OSError):
    """A part of a file that cannot be unpacked, named in words of ours."""


def open_hdf5(path: str | os.PathLike[str], fault: type[FormatError], is_not: str, remedy: str) -> Any:
    """Open an HDF5 file to read.

    Raises `fault` for a file that is empty, truncated, damaged or of another kind: it `is_not` ("is no asset") what it
    should be, and `remedy` ("bake it") would mend that; StorageError where there is none.
    """
    with open(existing(path), "rb") as file:
        signature = file.read(len(_SIGNATURE))
    if not signature:
        raise fault(f"{path}: is empty")
    if signature != _SIGNATURE:
        raise fault(f"{path}: {is_not}: expected an HDF5 file, found something that begins with {signature!r}")
    try:
        return h5py.File(path, "r")
    except DAMAGE as cause:
        size = Path(path).stat().st_size
        ends = _ENDS.search(str(cause))
        if ends is not None and int(ends[1]) > size:
            raise fault(f"{path}: is truncated: has {size} bytes of {ends[1]}; copy or {remedy} again") from cause
        system = isinstance(cause, OSError) and cause.errno is not None
        what = damage(cause) if system else f"is damaged or truncated, of {size} bytes"
        raise fault(f"{path}: {what}; copy or {remedy} again") from cause


def damage(cause: BaseException) -> str:
    """What was met in a damaged file, without the words of the libraries, which stay with the exception."""
    if isinstance(cause, Damage):
        return f"is damaged: {cause}"
    if isinstance(cause, OSError) and cause.errno is not None:
        return f"cannot be read: {os.strerror(cause.errno)}"
    return "is damaged: a part of it cannot be read"
