"""Who gets which cores, and which device learns."""

import os
from typing import NamedTuple

from formats.errors import QueryError


class Cores(NamedTuple):
    """Threads that walk, and threads that learn."""

    walkers: int
    learners: int


def available() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def divided(share: float, device: str) -> Cores:
    """The cores divided: about `share` of them learn, at least one where they do it at all; the others walk.

    One core is shared by both. A graphics card that learns is fed by one thread, which hardly works: all cores walk.
    """
    cores = available()
    learners = 1 if device != "cpu" else max(1, min(cores - 1, round(cores * share)))
    return Cores(_allowed(cores if device != "cpu" else max(1, cores - learners)), learners)


def all_cores() -> Cores:
    """Every core walks, or every core learns: for work in turns."""
    cores = available()
    return Cores(_allowed(cores), cores)


def _allowed(threads: int) -> int:
    import numba

    return min(threads, int(vars(numba.config)["NUMBA_NUM_THREADS"]))


def chosen_device(name: str) -> str:
    """ "cpu" or "cuda" of "auto" (a graphics card where there is one), "cpu" or "cuda".

    Raises QueryError where a card is asked for and there is none that this torch can use.
    """
    import torch

    if name == "cpu":
        return name
    there = torch.cuda.is_available()
    if name == "auto":
        return "cuda" if there else "cpu"
    if name == "cuda" and there:
        return name
    raise QueryError(f"device: {name!r} is not there (no graphics card that this torch can use); take 'auto' or 'cpu'")
