"""Limits on the threads of numba and torch while several workers run."""

import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any


@contextmanager
def limited_threads(transport: Any, workers: int) -> Iterator[None]:
    """Limits numba to `workers` threads for path-traced transports, and torch to one thread per call if it is loaded.

    More threads would compete with the workers. Path-traced transports estimate coefficients themselves.
    """
    with ExitStack() as restore:
        if hasattr(transport, "estimate_coefficients"):
            import numba

            settings: Any = numba.config
            restore.callback(numba.set_num_threads, numba.get_num_threads())
            numba.set_num_threads(max(1, min(workers, settings.NUMBA_NUM_THREADS)))
        if (torch := sys.modules.get("torch")) is not None:
            restore.callback(torch.set_num_threads, torch.get_num_threads())
            torch.set_num_threads(1)
        yield
