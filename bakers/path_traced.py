"""Coefficients estimated directly by random walks, a_lm = E[throughput · Y_lm(exit)], without directions or a network.

The estimate is unbiased, so such a bake is the reference for every other. Each bin has its own walks; the rms of their
standard errors over K and channels matches the true errors (measured on six scenes, 64 and 256 walks per bin against
8192: stated over true 0.98 to 1.05; 98 to 100 % of the bins' rms errors are within 1.96, since an rms of many numbers
varies less than one number).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bakers.transport import WalkBlockTransport, as_radiance, label
from formats.arguments import described
from formats.errors import QueryError

Array = NDArray[np.float64]

WALKS_AT_ONCE = 1 << 17
"""Walks per block: enough to keep many cores busy, few enough that a bake stops soon after a request."""


@dataclass(frozen=True)
class Walks:
    """How many random walks estimate the coefficients at every bin."""

    degree: int
    paths: int
    seed: Callable[[int], int]
    """Vertex → its seed."""


@dataclass(frozen=True)
class WalkStatistics:
    """Statistics of random walks, summed over bins."""

    bins: int = 0
    clamped: int = 0
    """Bins whose direction the transport itself clamped to its horizon."""
    unreliable: int = 0
    """Bins whose error bars cannot be trusted at this number of walks."""
    unscattered: float = 0.0
    """Unscattered fraction of the view ray, which is in no coefficient."""
    lost: float = 0.0
    """Throughput of truncated walks."""

    def __add__(self, other: "WalkStatistics") -> "WalkStatistics":
        return WalkStatistics(**{name: value + getattr(other, name) for name, value in vars(self).items()})

    def as_json(self) -> dict[str, float | int]:
        """Means over the bins, and the number of unreliable ones."""
        bins = max(1, self.bins)
        return {"unscattered": self.unscattered / bins, "lost": self.lost / bins, "unreliable_bins": self.unreliable}


def vertices_walked_at_once(bins: int, paths: int) -> int:
    """Vertices per block, at least 1."""
    return max(1, WALKS_AT_ONCE // (bins * paths))


def walk_block(
    transport: Any, walks: Walks, positions: Array, outgoing: Array, first_vertex: int
) -> tuple[Array, Array, WalkStatistics]:
    """Coefficients [n,B,K,3] at positions [n,3] seen along outgoing [n,B,3], their variances [n,B,K,3], and statistics.

    A vertex's numbers depend on its own seed alone. Raises QueryError if the transport returns another
    shape, or errors that are negative or NaN.
    """
    seeds = [walks.seed(first_vertex + row) for row in range(len(positions))]
    shape = (*outgoing.shape[:2], (walks.degree + 1) ** 2, 3)
    if isinstance(transport, WalkBlockTransport):
        estimate = transport.estimate_block(positions, outgoing, walks.degree, walks.paths, seeds)
        mean, error = _mean_and_error(estimate, shape, transport, "estimate_block")
        statistics = estimate.statistics
    else:
        mean, error = _vertex_by_vertex(transport, walks, positions, outgoing, seeds)
        statistics = WalkStatistics(bins=mean.shape[0] * mean.shape[1])
    return mean.astype(np.float64), np.asarray(error, np.float64) ** 2, statistics


def _vertex_by_vertex(
    transport: Any, walks: Walks, positions: Array, outgoing: Array, seeds: list[int]
) -> tuple[Array, Array]:
    """Mean and standard error [n,B,K,3] of a transport that is evaluated one vertex at a time."""
    means, errors = [], []
    bins = outgoing.shape[1]
    expected = (bins, (walks.degree + 1) ** 2, 3)
    for x, eye, seed in zip(positions, outgoing, seeds, strict=True):
        at = np.repeat(x[None], bins, 0)
        estimate = transport.estimate_coefficients(at, np.array(eye), walks.degree, walks.paths, seed)
        mean, error = _mean_and_error(estimate, expected, transport, "estimate_coefficients")
        means.append(mean)
        errors.append(error)
    return np.stack(means), np.stack(errors)


def _mean_and_error(estimate: Any, shape: tuple[int, ...], transport: Any, method: str) -> tuple[Array, Array]:
    """The mean and the standard error of an estimate; raises QueryError if they are no such numbers."""
    if not hasattr(estimate, "mean") or not hasattr(estimate, "standard_error"):
        raise QueryError(
            f"{label(transport)}.{method}: expected an object with mean and standard_error, such as a SimpleNamespace, "
            f"found {described(estimate)}"
        )
    mean = as_radiance(estimate.mean, shape, f"mean of {method}")
    error = as_radiance(estimate.standard_error, shape, f"standard_error of {method}")
    # Where the mean is not finite the vertex is not valid, and its error does not matter.
    wrong = np.isfinite(mean) & ~(error >= 0.0)
    if wrong.any():
        raise QueryError(
            f"{label(transport)}.{method}: expected standard errors of 0 or more, found {error[wrong][0]:.4g} for "
            f"{wrong.sum()} of {wrong.size} means"
        )
    return mean, error
