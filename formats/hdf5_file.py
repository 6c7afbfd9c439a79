"""Opening HDF5 files of unknown content, and describing what is wrong with them.

Format: https://support.hdfgroup.org/documentation/hdf5/latest/_f_m_t3.html, read with h5py.
"""

import os
import re
import reprlib
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from formats.atomic import existing
from formats.errors import FormatError
from formats.hdf5_strings import DamagedDataError, has_damaged_strings, is_readable

HDF5_ERRORS = (OSError, RuntimeError, KeyError, ValueError, TypeError, AttributeError)
"""What h5py raises on damaged files."""
_EXPECTED_SIZE = re.compile(r"stored_eof = (\d+)")
"""The size that HDF5 expects of a truncated file, in its message."""
_SIGNATURE = b"\x89HDF\r\n\x1a\n"


def attribute(node: Any, name: str) -> Any:
    """The attribute `name` of an open file, group or dataset.

    An array of one value counts as the value, and bytes as UTF-8 text: other programs write both.

    Raises:
        DamagedDataError: the attribute is neither a number nor text.
    """
    if not is_readable(node.attrs.get_id(name)):
        raise DamagedDataError(f"{node.name}: the attribute {name} cannot be read")
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
    if has_damaged_strings(path):
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
