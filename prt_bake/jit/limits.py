"""Limits on the threads of numba and torch while several workers run."""

import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

from bakers.transport import transport_kind


@contextmanager
def limited_threads(transport: Any, workers: int) -> Iterator[None]:
    """Random walks take `workers` threads, as many as there are at most; torch one intra-op thread a worker, if it is
    loaded at all: more of them get in one another's way.
    """
    with ExitStack() as before:
        if transport_kind(transport) == "coefficients":
            import numba

            settings: Any = numba.config
            before.callback(numba.set_num_threads, numba.get_num_threads())
            numba.set_num_threads(max(1, min(workers, settings.NUMBA_NUM_THREADS)))
        if (torch := sys.modules.get("torch")) is not None:
            before.callback(torch.set_num_threads, torch.get_num_threads())
            torch.set_num_threads(1)
        yield
