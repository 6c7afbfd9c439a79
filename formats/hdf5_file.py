"""Opening HDF5 files of unknown content, and describing what is wrong with them.

Format: https://support.hdfgroup.org/documentation/hdf5/latest/_f_m_t3.html, read with h5py.
"""

import os
import re
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


def describe_damage(cause: BaseException) -> str:
    """Return what is wrong with a file as the end of a sentence, without the wording of h5py."""
    if isinstance(cause, DamagedDataError):
        return f"is damaged: {cause}"
    if isinstance(cause, OSError) and cause.errno is not None:
        return f"cannot be read: {os.strerror(cause.errno)}"
    return "is damaged: a part of it cannot be read"
