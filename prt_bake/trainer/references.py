"""Path-traced references within a time: first as many queries as it allows, then more walks for each of them."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from prt_bake.mathematics.noise_free import Replicates, Sums, sums
from prt_bake.mathematics.random import hashed

Array = NDArray[np.float64]
Estimate = Callable[[slice, int, int], Array]
"""estimate(rows, paths, seed): unbiased, noisy values [n,…] of the queries `rows` from `paths` walks each."""
Predict = Callable[[slice], Array]
"""predict(rows): a network's values [n,…] of the queries `rows`."""
Follow = Callable[[float], None]
"""follow(share): receives the finished share several times a second. An exception ends the work."""

FIRST_BATCHES = 8
_LEAST_BATCHES = 4
MOST_BATCHES = 2048
"""Default for the most batches."""
_NOISE_TO_ERROR = 1.0 / 3.0
_FIRST_BLOCK = 8
"""Queries of the first block: the fewest that have an interval."""
_BLOCK_SECONDS = 0.5
_STREAM = 0xA55E


def silent(share: float) -> None:
    """Follow nothing."""


@dataclass(frozen=True)
class TracedReference:
    """A path-traced reference of the first N queries, and the network's predictions [N,…] there (None without one).

    walks: of each query. ended: "noise" if the noise is at most a third of the measured error, else "time" or "size".
    """

    estimates: Replicates
    predicted: Array | None
    walks: int
    seconds: float
    ended: str

    def __len__(self) -> int:
        return len(self.estimates.mean)

    def errors(self) -> Sums:
        """Sums of squared errors of the network's predictions, one per query."""
        assert self.predicted is not None
        return sums(self.predicted, self.estimates)

    @property
    def standard_error(self) -> Array:
        """One sigma of the estimates, from the scatter of their batches."""
        return np.sqrt(self.estimates.variance)

    @property
    def walk_variance(self) -> Array:
        """Variance [N] of a single walk, summed over the values of a query."""
        return np.asarray(self.walks * self.estimates.variance.reshape(len(self), -1).sum(axis=1))


class _Clock:
    """The time limit of a reference."""

    def __init__(self, seconds: float, follow: Follow) -> None:
        self.begun, self.limit, self._follow = time.perf_counter(), seconds, follow

    @property
    def seconds(self) -> float:
        return time.perf_counter() - self.begun

    @property
    def left(self) -> float:
        return self.limit - self.seconds

    def show(self, share: float) -> None:
        """Report the share of the time, or `share` of the work without a limit."""
        self._follow(share if math.isinf(self.limit) else min(1.0, self.seconds / max(self.limit, 1e-9)))


def trace_reference(
    estimate: Estimate,
    count: int,
    paths: int,
    most: int | None = None,
    *,
    predict: Predict | None = None,
    until_precise: bool = True,
    seconds: float = math.inf,
    seed: int = 0,
    stream: int = 0,
    follow: Follow = silent,
) -> TracedReference:
    """Estimate `count` queries in batches of `paths` walks per query, within `seconds`.

    Begins with 8 batches of each query, in blocks of queries; if the time is over, the other queries are left out. At
    least 8 queries get at least 4 batches. Then batches are doubled until the noise is a third of the error of
    `predict` (if `until_precise`), there are `most` of them, or the time is over. Without a time limit the result
    depends on the seeds alone.
    """
    if math.isfinite(seconds):  # compiling and loading kernels does not count
        estimate(slice(0, 1), 2, seed)
        if predict is not None:
            predict(slice(0, 1))
    clock, most = _Clock(seconds, follow), most or MOST_BATCHES
    key = (_STREAM, seed, stream)
    estimates, predicted = _first_batches(estimate, predict, count, paths, clock, key)
    rows = slice(0, len(estimates.mean))
    ended = "" if rows.stop == count and estimates.count >= FIRST_BATCHES else "time"
    while not ended:
        affordable = estimates.count * max(0.0, clock.left) / max(clock.seconds, 1e-9)
        due = int(min(estimates.count, affordable, most - estimates.count))
        if until_precise and predicted is not None and _is_precise(sums(predicted, estimates)):
            ended = "noise"
        elif estimates.count >= most:
            ended = "size"
        elif due < 1:
            ended = "time"
        else:
            for _ in range(due):
                if clock.left <= 0.0:
                    break
                estimates.add(estimate(rows, paths, _seed(key, estimates.count, 0)))
                clock.show(estimates.count / most)
    return TracedReference(estimates, predicted, paths * estimates.count, clock.seconds, ended)


def _first_batches(
    estimate: Estimate, predict: Predict | None, count: int, paths: int, clock: _Clock, key: tuple[int, ...]
) -> tuple[Replicates, Array | None]:
    """The first batches of as many queries as the time allows, and the predictions."""
    parts: list[Replicates] = []
    predictions: list[Array] = []
    first, size = 0, count if math.isinf(clock.limit) else _FIRST_BLOCK
    while first < count and size >= 1:
        begun, rows = time.perf_counter(), slice(first, min(count, first + size))
        part: Replicates | None = None
        for batch in range(FIRST_BATCHES):
            if clock.left <= 0.0 and (parts or batch >= _LEAST_BATCHES):
                break
            values = estimate(rows, paths, _seed(key, batch, first))
            part = part or Replicates.empty(values.shape)
            part.add(values)
            clock.show((batch + 1) / FIRST_BATCHES)
        if part is None or (parts and part.count < FIRST_BATCHES):
            break
        parts.append(part)
        if predict is not None:
            predictions.append(np.asarray(predict(rows), np.float64))
        first = rows.stop
        per_query = (time.perf_counter() - begun) / (rows.stop - rows.start)
        size = int(min(4 * size, min(_BLOCK_SECONDS, max(0.0, clock.left)) / max(per_query, 1e-9)))
    mean, squares = (np.concatenate([getattr(part, name) for part in parts]) for name in ("mean", "squares"))
    return Replicates(parts[0].count, mean, squares), np.concatenate(predictions) if predictions else None


def _seed(key: tuple[int, ...], batch: int, first: int) -> int:
    return int(hashed(*key, batch, first) >> np.uint64(1))


def _is_precise(clusters: Sums) -> bool:
    return bool(clusters.noise.sum() <= _NOISE_TO_ERROR**2 * clusters.error.sum())
