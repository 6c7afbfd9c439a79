"""Path-traced references that grow until their noise is small beside what they are to measure, or the time is up."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from formats.scene import Scene
from prt_bake.mathematics.noise_free import Replicates, Sums, sums
from prt_bake.mathematics.random import hashed
from prt_bake.tracer.estimate import estimate_coefficients, estimate_transport

Array = NDArray[np.float64]

FIRST_BATCHES = 8
_LEAST_BATCHES = 4
_MOST_BATCHES = 2048
_NOISE_TO_ERROR = 1.0 / 3.0
_STREAM = 0xA55E


class Tracer(Protocol):
    """What answers as the truth, with noise: every call of another seed is an independent estimate."""

    def transport(self, positions: Array, outgoing: Array, incident: Array, paths: int, seed: int) -> Array:
        """Ŝ [N,D,3] towards incident [N,D,3]."""

    def coefficients(self, positions: Array, outgoing: Array, paths: int, seed: int) -> Array:
        """Degree-2 a_lm [N,9,3]."""


@dataclass(frozen=True)
class PathTracer:
    """The trainer's own estimates as a `Tracer`; `connections` is how many directions each event of a walk looks at."""

    scene: Scene
    connections: int

    def transport(self, positions: Array, outgoing: Array, incident: Array, paths: int, seed: int) -> Array:
        """As `estimate_transport`."""
        return estimate_transport(
            self.scene, positions, outgoing, incident, paths, seed, connections=self.connections
        ).mean

    def coefficients(self, positions: Array, outgoing: Array, paths: int, seed: int) -> Array:
        """As `estimate_coefficients`."""
        return estimate_coefficients(self.scene, positions, outgoing, 2, paths, seed).mean


@dataclass(frozen=True)
class Reference:
    """What was traced: the estimates together, walks behind each query, the seconds, and why it ended there.

    `ended` is "noise" where the noise is at most a third of the error that is measured, else "time" or "size".
    """

    estimates: Replicates
    walks: int
    seconds: float
    ended: str

    def against(self, answer: ArrayLike) -> Sums:
        """Sums for each query of what `answer` misses."""
        return sums(answer, self.estimates)

    @property
    def walk_variance(self) -> Array:
        """Variance [N] of one walk, summed over the values of a query."""
        return np.asarray(self.walks * self.estimates.variance.reshape(len(self.estimates.mean), -1).sum(axis=1))


def grow(
    estimate: Callable[[int, int], Array], answer: ArrayLike, paths: int, seconds: float, seed: int, stream: int
) -> Reference:
    """Estimates by `estimate(paths, seed)`, doubled until they are as exact as the error of `answer` asks for.

    Begins with 8 batches of `paths` walks a query, four of them whatever the time; goes on for `seconds` in all at
    most.
    """
    begun = time.perf_counter()
    values = np.asarray(answer, np.float64)
    estimates = Replicates.of(values.shape)
    due, ended = FIRST_BATCHES, ""
    while not ended:
        for _ in range(due):
            if estimates.count >= _LEAST_BATCHES and time.perf_counter() - begun > seconds:
                break
            estimates.add(estimate(paths, int(hashed(_STREAM, seed, stream, estimates.count) >> np.uint64(1))))
        spent = time.perf_counter() - begun
        affordable = estimates.count * max(0.0, seconds - spent) / max(spent, 1e-9)
        due = int(min(estimates.count, affordable, _MOST_BATCHES))
        ended = _ending(sums(values, estimates), due, estimates.count)
    return Reference(estimates, paths * estimates.count, time.perf_counter() - begun, ended)


def _ending(clusters: Sums, due: int, batches: int) -> str:
    """Why to stop here; empty where to go on."""
    if clusters.noise.sum() <= _NOISE_TO_ERROR**2 * clusters.error.sum():
        return "noise"
    if batches >= _MOST_BATCHES:
        return "size"
    return "time" if due < 1 else ""
