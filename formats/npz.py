"""Reads `.npz` files of arrays, as checkpoints use them."""

import os
from typing import Any

import numpy as np
from numpy.typing import NDArray

from formats.errors import FormatError


def read_arrays(path: str | os.PathLike[str]) -> dict[str, NDArray[Any]]:
    """All arrays of a file by name. Raises FormatError if it is missing or damaged; nothing in it is run."""
    try:
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as arrays:
            return {name: arrays[name] for name in arrays.files}
    except Exception as cause:  # zipfile and NumPy raise errors of many classes for damaged files
        raise FormatError(f"{path}: is not a readable .npz file ({type(cause).__name__}); write it again") from cause
