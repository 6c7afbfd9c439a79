"""Runs of one query by any program, in batches whose spread tells the variance, whatever error bars it claims."""

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from formats.scene import Scene
from prt_bake import estimate_transport

BATCHES = 32
REPEATS = 2

Batches = Callable[[int, int], tuple[np.ndarray, float]]
"""(paths a batch, seed) → means [32,D], and the seconds of CPU that all batches took."""


@dataclass(frozen=True)
class Run:
    """Figures of one program for one query: means and variances a path [D], and seconds a path for all of them."""

    mean: np.ndarray
    variance: np.ndarray
    seconds: float


def ours(scene: Scene, position: np.ndarray, outgoing: np.ndarray, incident: np.ndarray) -> Batches:
    """`estimate_transport` for one light [1,3] or more [D,3]: the query 32 times in one call."""
    where, eye = np.tile(position, (BATCHES, 1)), np.tile(outgoing, (BATCHES, 1))
    lights = np.tile(incident, (BATCHES, 1, 1)) if len(incident) > 1 else np.tile(incident, (BATCHES, 1))

    def batches(paths: int, seed: int) -> tuple[np.ndarray, float]:
        began = time.process_time()
        seen = estimate_transport(scene, where, eye, lights, paths, seed)
        return seen.mean.reshape(BATCHES, -1, 3).mean(axis=2), time.process_time() - began

    return batches


def paths_for(batches: Batches, seconds: float) -> int:
    """Warm up, and find how many paths a batch last so long."""
    paths = 16
    batches(paths, 0)
    _, took = batches(paths, 1)
    while took < 0.3 * seconds:
        paths *= 4
        _, took = batches(paths, 2)
    return max(16, int(paths * seconds / took))


def timed(batches: Batches, paths: int, seed: int) -> Run:
    """Run 32 batches of so many paths, REPEATS times."""
    found = [batches(paths, REPEATS * seed + repeat) for repeat in range(REPEATS)]
    means = np.concatenate([means for means, _ in found])
    # Other work on the machine only ever adds to the time.
    seconds = min(seconds for _, seconds in found) / (BATCHES * paths)
    return Run(means.mean(axis=0), paths * means.var(axis=0, ddof=1), seconds)
