"""TorchScript files, run by torch on the CPU."""

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from formats.errors import ModelError


def open_torchscript(path: str | Path) -> Callable[[NDArray[np.float64]], Any]:
    """The function [rows, 7] → [rows, 3] of a TorchScript file; its rows have the type of its parameters.

    Raises ModelError if the file is not TorchScript; the function does if it fails.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # torch calls the format deprecated; people still use it
            load: Any = torch.jit.load
            function = load(str(path), map_location="cpu").eval()
    except (RuntimeError, ValueError, OSError):
        raise ModelError(f"{path}: not a TorchScript file; expected what torch.jit.save writes") from None
    floats = (each.dtype for each in function.parameters() if each.is_floating_point())
    dtype = next(floats, torch.float32)

    def call(rows: NDArray[np.float64]) -> Any:
        try:
            with torch.inference_mode():
                return function(torch.from_numpy(rows).to(dtype, copy=True))  # it may write into its rows
        except (RuntimeError, torch.jit.Error) as fault:
            last = str(fault).strip().splitlines()[-1]
            kind = str(dtype).removeprefix("torch.")
            raise ModelError(f"{path}: failed on [{len(rows)}, 7] of {kind} ({last})") from None

    return call
