"""Path-traced references, refined until their noise is small compared with the measured error or the time is up."""

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
    """Unbiased noisy estimates of the truth; calls with different seeds are independent."""

    def transport(self, positions: Array, outgoing: Array, incident: Array, paths: int, seed: int) -> Array:
        """Ŝ [N,D,3] towards incident [N,D,3]."""

    def coefficients(self, positions: Array, outgoing: Array, paths: int, seed: int) -> Array:
        """Degree-2 a_lm [N,9,3]."""


@dataclass(frozen=True)
class PathTracer:
    """The path tracer as a `Tracer`; `connections` is the number of directions that each event connects to."""

    scene: Scene
    connections: int

    def transport(self, positions: Array, outgoing: Array, incident: Array, paths: int, seed: int) -> Array:
        """Ŝ [N,D,3] by `estimate_transport`."""
        return estimate_transport(
            self.scene, positions, outgoing, incident, paths, seed, connections=self.connections
        ).mean

    def coefficients(self, positions: Array, outgoing: Array, paths: int, seed: int) -> Array:
        """Degree-2 a_lm [N,9,3] by `estimate_coefficients`."""
        return estimate_coefficients(self.scene, positions, outgoing, 2, paths, seed).mean


@dataclass(frozen=True)
class Reference:
    """A path-traced reference: its estimates, the walks per query, the seconds spent, and why tracing ended.

    `ended` is "noise" if the noise is at most a third of the measured error, else "time" or "size".
    """

    estimates: Replicates
    walks: int
    seconds: float
    ended: str

    def compare(self, predicted: ArrayLike) -> Sums:
        """Sums of squared errors of `predicted`, one per query."""
        return sums(predicted, self.estimates)

    @property
    def walk_variance(self) -> Array:
        """Variance [N] of a single walk, summed over the values of a query."""
        return np.asarray(self.walks * self.estimates.variance.reshape(len(self.estimates.mean), -1).sum(axis=1))


def refine_reference(
    estimate: Callable[[int, int], Array], predicted: ArrayLike, paths: int, seconds: float, seed: int, stream: int
) -> Reference:
    """Average `estimate(paths, seed)` over batches, doubled until the noise is a third of the error of `predicted`.

    Begins with 8 batches of `paths` walks per query, at least four of them whatever the time, and ends after `seconds`.
    """
    begun = time.perf_counter()
    values = np.asarray(predicted, np.float64)
    estimates = Replicates.empty(values.shape)
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
    """Why tracing ends now; empty if it continues."""
    if clusters.noise.sum() <= _NOISE_TO_ERROR**2 * clusters.error.sum():
        return "noise"
    if batches >= _MOST_BATCHES:
        return "size"
    return "time" if due < 1 else ""
