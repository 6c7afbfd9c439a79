"""Measures the efficiency of any program for one query: the variance follows from the spread of its batches."""

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from formats.scene import Scene
from prt_bake import estimate_transport

BATCHES = 32
REPEATS = 2

Batches = Callable[[int, int], tuple[np.ndarray, float]]
"""(paths per batch, seed) → means [32,D], and the CPU seconds of all batches."""


@dataclass(frozen=True)
class Run:
    """Figures of one program for one query: means and variances per path [D], and seconds per path."""

    mean: np.ndarray
    variance: np.ndarray
    seconds: float


def ours(scene: Scene, position: np.ndarray, outgoing: np.ndarray, incident: np.ndarray) -> Batches:
    """`estimate_transport` for one or more lights [D,3]: the query 32 times in one call."""
    where, eye = np.tile(position, (BATCHES, 1)), np.tile(outgoing, (BATCHES, 1))
    lights = np.tile(incident, (BATCHES, 1, 1)) if len(incident) > 1 else np.tile(incident, (BATCHES, 1))

    def batches(paths: int, seed: int) -> tuple[np.ndarray, float]:
        began = time.process_time()
        estimate = estimate_transport(scene, where, eye, lights, paths, seed)
        return estimate.mean.reshape(BATCHES, -1, 3).mean(axis=2), time.process_time() - began

    return batches


def paths_for(batches: Batches, seconds: float) -> int:
    """Warm up, and return the number of paths per batch that takes `seconds`."""
    paths = 16
    batches(paths, 0)
    _, took = batches(paths, 1)
    while took < 0.3 * seconds:
        paths *= 4
        _, took = batches(paths, 2)
    return max(16, int(paths * seconds / took))


def timed(batches: Batches, paths: int, seed: int) -> Run:
    """Run 32 batches of `paths` paths, REPEATS times."""
    found = [batches(paths, REPEATS * seed + repeat) for repeat in range(REPEATS)]
    means = np.concatenate([means for means, _ in found])
    # Other processes only ever add to the time, so the least is the best estimate.
    seconds = min(seconds for _, seconds in found) / (BATCHES * paths)
    return Run(means.mean(axis=0), paths * means.var(axis=0, ddof=1), seconds)
