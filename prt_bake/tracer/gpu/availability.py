"""Whether walks can run on a GPU here."""

from functools import cache
from importlib.util import find_spec


@cache
def reason_against() -> str:
    """Why walks cannot run on a GPU here, with what would help; empty if they can."""
    if find_spec("numba_cuda") is None:
        return "numba-cuda is not installed; pip install 'prt-bake[cuda]'"
    from prt_bake.tracer.gpu.device_functions import cuda

    if not cuda.is_available():
        return "numba-cuda finds no GPU that it can use"
    return ""
