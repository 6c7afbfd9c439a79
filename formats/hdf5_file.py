"""Opening HDF5 files that may be anything, and telling what is wrong with them."""

import os
from typing import Any

import h5py

from formats.errors import FormatError
from formats.whole import existing

DAMAGE = (OSError, RuntimeError, KeyError, ValueError, TypeError, AttributeError)
"""What h5py raises on damaged files."""
_SIGNATURE = b"\x89HDF\r\n\x1a\n"


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
        what = "is truncated" if "truncated" in str(cause) else "is damaged or truncated"
        raise fault(f"{path}: {what}: {first_line(cause)}; copy or {remedy} again") from cause


def first_line(cause: BaseException) -> str:
    """The first line of what an exception says, its name where it says nothing."""
    return (str(cause).splitlines() or [type(cause).__name__])[0]
