"""Compiles the functions of the path tracer for CUDA, from the same source.

A function that the processor's compiler has decorated calls others by their names. Its copy for CUDA has the same code,
but its names refer to the copies for CUDA.
"""

from collections.abc import Callable
from functools import cache
from types import FunctionType
from typing import Any

import numba.cuda
from numba import config
from numba.core.dispatcher import Dispatcher

from prt_bake.geometry.embree import nearest_hit
from prt_bake.tracer.gpu.traversal import nearest_hit as nearest_hit_in_tree

cuda: Any = numba.cuda
"""numba's module for CUDA, whose annotations lack most of it."""
SIMULATED = bool(vars(config)["ENABLE_CUDASIM"])
"""Whether numba simulates a GPU in Python, for tests."""
_REPLACED: dict[Any, Any] = {nearest_hit: nearest_hit_in_tree}
"""Functions that cannot run on a GPU, and those that take their places there."""


def kernel(function: Callable[..., None]) -> Any:
    """Decorator: a kernel for CUDA, with few enough registers that a multiprocessor runs 16 warps.

    Walks with all the registers that they could use are slower by 7 to 25 %.
    """
    return cuda.jit(function) if SIMULATED else cuda.jit(function, max_registers=128)


@cache
def device_function(function: Any) -> Any:
    """The copy for CUDA of a function of the path tracer, which kernels for CUDA may call."""
    function = _REPLACED.get(function, function)
    # The search for hits is called from several places, and is long.
    options = {} if SIMULATED or function is nearest_hit_in_tree else {"forceinline": True}
    return cuda.jit(device=True, **options)(_retargeted(function.py_func))


def _retargeted(function: Any) -> FunctionType:
    """The function with the same code, whose global names refer to copies for CUDA."""
    names = {name: function.__globals__[name] for name in function.__code__.co_names if name in function.__globals__}
    copies = {name: device_function(value) if isinstance(value, Dispatcher) else value for name, value in names.items()}
    copy = FunctionType(function.__code__, {**copies, "__builtins__": __builtins__}, function.__name__)
    copy.__module__ = function.__module__
    return copy
