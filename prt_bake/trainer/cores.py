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
    """Threads of both: about `share` of the cores learn, at least one. The others walk, and one more: walkers rest when
    they are ahead, and otherwise walks are what is wanting. A graphics card that learns leaves all cores to them.
    """
    cores = available()
    learners = 1 if device != "cpu" else max(1, min(cores - 1, round(cores * share)))
    walkers = cores if device != "cpu" else min(cores, cores - learners + 1)
    return Cores(_allowed(walkers), learners)


def undivided() -> Cores:
    """Every core walks while nothing learns; half of them learn while nothing walks.

    Threads that share a batch wait for one another: with one for each core they do little else as soon as anything
    else runs.
    """
    cores = available()
    return Cores(_allowed(cores), max(1, cores // 2))


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
