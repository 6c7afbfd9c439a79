"""How many threads render and learn, and which devices learn and path trace."""

import os
from collections.abc import Callable
from typing import Literal, NamedTuple

from formats.errors import QueryError

_LEARNER_SHARE = 0.25
"""Share of the cores that learn; the others render."""


class Threads(NamedTuple):
    """Numbers of threads of the renderer and of the learner."""

    renderer: int
    learner: int


def available_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def concurrent_threads(device: str) -> Threads:
    """Threads of a renderer and a learner that run at the same time.

    The learner gets a quarter of the cores, at least one. The renderer gets the others and one more, since it pauses
    whenever it is ahead. A learner on a GPU leaves all cores to the renderer.
    """
    cores = available_cores()
    if device != "cpu":
        return Threads(_numba_limit(cores), 1)
    learner = max(1, min(cores - 1, round(cores * _LEARNER_SHARE)))
    return Threads(_numba_limit(cores - learner + 1), learner)


def alternating_threads() -> Threads:
    """Threads of a renderer and a learner that take turns: every core renders, half of the cores learn.

    The learner's threads share a batch and wait for one another. With one thread per core they mostly wait as soon as
    any other process runs.
    """
    cores = available_cores()
    return Threads(_numba_limit(cores), max(1, cores // 2))


def _numba_limit(threads: int) -> int:
    import numba

    return min(threads, int(vars(numba.config)["NUMBA_NUM_THREADS"]))


def select_device(name: str) -> str:
    """ "cpu" or "cuda" for `name` "cpu", "cuda" or "auto" (CUDA if available).

    Raises QueryError for any other name, and for "cuda" if torch finds no usable GPU.
    """
    import torch

    if name == "cpu":
        return name
    available = torch.cuda.is_available()
    if name == "auto":
        return "cuda" if available else "cpu"
    if name == "cuda" and available:
        return name
    raise QueryError(f"device: {name!r} is not available (torch finds no such GPU); use 'auto' or 'cpu'")


def walking_device(device: str, on_processor: bool, report: Callable[[str], None]) -> Literal["cpu", "cuda"]:
    """The device that path traces: the one that learns, unless it is a GPU that cannot.

    `on_processor`: synchronous runs and values of Ŝ, of which a GPU can do neither.
    """
    if device == "cpu":
        return "cpu"
    if on_processor:
        report("the GPU learns, and the processor path traces")
        return "cpu"
    from prt_bake.tracer.gpu.availability import reason_against

    if reason := reason_against():
        report(f"the GPU learns, but the processor path traces: {reason}")
        return "cpu"
    report("the GPU path traces and learns")
    return "cuda"
