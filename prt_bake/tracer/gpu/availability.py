"""Whether walks can run on a GPU here."""

from functools import cache
from importlib.util import find_spec
from typing import Any

import numba
import numpy as np

from formats.errors import QueryError
from prt_bake.mathematics.counter import mix


def require_walks_on(device: str) -> None:
    """Raise QueryError if paths cannot be traced on `device`, "cpu" or "cuda"."""
    if device == "cpu":
        return
    reason = reason_against() if device == "cuda" else f"expected 'cpu' or 'cuda', found {device!r}"
    if reason:
        raise QueryError(f"device: paths cannot be traced on a GPU: {reason}; or use the CPU")


@cache
def reason_against() -> str:
    """Why walks cannot run on a GPU here, with what would help; empty if they can.

    Compilers, drivers and versions that do not fit together fail in many ways, so a small kernel is tried.
    """
    if find_spec("numba_cuda") is None and not vars(numba.config)["ENABLE_CUDASIM"]:
        return "numba-cuda is not installed; pip install 'numba-cuda[cu13]'"
    try:
        from prt_bake.tracer.gpu.device_functions import cuda, device_function, kernel

        device_function(mix)
        if not cuda.is_available():
            return "numba-cuda finds no GPU that it can use; its driver may be too old"
        numbers = cuda.to_device(np.zeros(1))
        kernel(_add_one)[1, 1](numbers)
        works = numbers.copy_to_host()[0] == 1.0
    except Exception as fault:
        return f"numba-cuda fails ({type(fault).__name__}: {fault}); its version, numba's and NumPy's must fit together"
    return "" if works else "numba-cuda computes wrong numbers"


def _add_one(numbers: Any) -> None:
    numbers[0] += 1.0
