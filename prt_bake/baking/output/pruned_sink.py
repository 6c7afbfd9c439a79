"""Prunes baked blocks, and checks at every vertex that what is pruned is as redundant as the pilot predicted."""

import math
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from bakers.baker import Block
from bakers.error_covariance import normalised_covariance
from formats.asset import Asset, AssetHead
from formats.asset.error_covariance import ErrorCovariance
from prt_bake.baking.job.pruning_record import Pruning
from prt_bake.baking.job.running_error import ErrorMeter
from prt_bake.baking.output.sink import Sink, open_sink
from prt_bake.baking.pruning.redundancy import WORST
from prt_bake.mathematics import sh
from prt_bake.mathematics.view_frames import ViewFrames, mesh_view_frames

Array = NDArray[np.float64]

DARK = 1e-2
"""Share of the mean square coefficient; the errors of darker vertices are taken relative to this value."""
NOISE = 1.5
"""Standard errors by which redundant values may differ because of noise."""


class WronglyPruned(Exception):
    """A vertex needs an item that was pruned."""

    def __init__(self, item: str, vertex: int) -> None:
        super().__init__(f"{item} matter at vertex {vertex}")
        self.item, self.vertex = item, vertex


def pruned_head(head: AssetHead, pruning: Pruning) -> AssetHead:
    """The head of the pruned asset."""
    degree = pruning.kept_degree
    head = replace(
        head,
        degree=degree,
        check_values=head.check_values[:, : sh.count(degree)],
        left_out=[item.as_json() for item in pruning.pruned],
    )
    if pruning.light is None:
        return head
    return replace(head, quantity="radiance", folded_in=f"light {pruning.light.content_hash}")


def open_pruned_sink(out: str | Path | None, head: AssetHead, storage: str, pruning: Pruning) -> "PrunedSink":
    """A sink for unpruned blocks, in memory or in the file `out`; raises QueryError on an unknown storage type."""
    folded = None if pruning.light is None else pruning.light.coefficients
    views = len(head.directions) if pruning.views == "all" else 1
    sink = open_sink(out, pruned_head(head, pruning), storage, views, pruning.channels, folded)
    return PrunedSink(sink, pruning, mesh_view_frames(head.mesh))


@dataclass
class _Working:
    """A block in double precision while it is pruned."""

    coefficients: Array
    variance: Array
    squares: Array
    """Mean square coefficient of each bin."""
    pruned: Array
    """Mean square of what was pruned, noise subtracted: an unbiased estimate that may be negative."""
    shape: ErrorCovariance | None


class PrunedSink:
    """Takes unpruned blocks and writes what the asset keeps.

    Attributes:
        squared: sums over vertices of the squares that were pruned (mean over K and channels, noise subtracted) and of
            those that were kept.
    """

    def __init__(self, sink: Sink, pruning: Pruning, frames: ViewFrames) -> None:
        self._sink, self._pruning, self._frames = sink, pruning, frames
        self._copies: dict[int, list[int]] = {}
        for vertex, same in pruning.copies.tolist():
            self._copies.setdefault(same, []).append(vertex)
        self.squared, self._averaged = np.zeros(2), np.zeros(2)
        self._meter = ErrorMeter()

    def __enter__(self) -> Self:
        self._sink.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, fault: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._sink.__exit__(kind, fault, trace)

    @property
    def pruning_error(self) -> float:
        """Relative RMSE that pruning has added so far."""
        return float(np.sqrt(max(self.squared[0], 0.0) / self.squared[1])) if self.squared[1] > 0.0 else 0.0

    def write(self, block: Block) -> None:
        """Takes a block [n,B,K,3] of consecutive vertices; raises WronglyPruned if a vertex needs what is pruned."""
        pruned = self._prune(block)
        self._sink.write(pruned)
        if self._pruning.light is not None:
            self._meter.add(pruned)
        for row, vertex in enumerate(range(block.first_vertex, block.first_vertex + len(block.valid))):
            for copy in self._copies.get(vertex, ()):
                rows = slice(row, row + 1)
                parts = pruned.coefficients[rows], pruned.standard_error[rows], pruned.valid[rows]
                shape = (
                    None if pruned.error_covariance is None else pruned.error_covariance.at_vertices(np.array([row]))
                )
                self._sink.write(Block(copy, *parts, 0, error_covariance=shape))

    def finish(self, provenance: dict[str, Any], error_vs_time: NDArray[np.float64], complete: bool) -> Asset:
        """Ends the writing and returns the asset, whose error figures include pruning and rounding."""
        if provenance["estimated_relative_rmse"]["total"] is None:
            return self._sink.finish(provenance, error_vs_time, complete)
        if self._pruning.light is not None:
            # The predicted errors are of coefficients; under a light they have other weights.
            measured = {"total": self._meter.total, "percentile_95_over_vertices": self._meter.percentile_95}
            return self._sink.finish(provenance | {"estimated_relative_rmse": measured}, error_vs_time, complete)
        parts = {"left_out": self.pruning_error, "rounding": self._pruning.rounding}
        parts = {name: value for name, value in parts.items() if value > 0.0}
        if parts or self._pruning.views == "one":
            smaller = math.sqrt(self._averaged[1] / self._averaged[0]) if self._averaged[0] > 0.0 else 1.0
            averaged = {name: smaller * value for name, value in provenance["estimated_relative_rmse"].items()}
            total = {name: math.hypot(value, *parts.values()) for name, value in averaged.items()}
            provenance = provenance | {"estimated_relative_rmse": total | parts}
        return self._sink.finish(provenance, error_vs_time, complete)

    def _prune(self, block: Block) -> Block:
        a, variance = block.coefficients.astype(np.float64), (block.standard_error / np.float64(block.bound)) ** 2
        squares = (a**2).mean(axis=(2, 3))
        variance += self._pruning.rounding**2 * squares
        work = _Working(a, variance, squares, np.zeros(variance.shape), block.error_covariance)
        if self._pruning.views == "one":
            self._average_views(block, work)
        if sh.count(self._pruning.kept_degree) < a.shape[2]:
            self._drop_bands(block, work)
        if self._pruning.channels == 1:
            self._average_channels(block, work)
        self.squared += work.pruned[block.valid].sum(), work.squares[block.valid].sum()
        work.variance = work.variance + np.maximum(work.pruned, 0.0)
        if self._pruning.light is not None:
            self._apply_light(self._pruning.light.coefficients, block, work)
        standard_error = (block.bound * np.sqrt(work.variance)).astype(np.float32)
        coefficients = work.coefficients.astype(np.float32)
        return replace(block, coefficients=coefficients, standard_error=standard_error, error_covariance=work.shape)

    def _average_views(self, block: Block, work: _Working) -> None:
        a = work.coefficients
        mean = a.mean(axis=1, keepdims=True)
        spread = ((a - mean) ** 2).mean(axis=(1, 2, 3), keepdims=True)[..., 0, 0]
        variance = work.variance.mean(axis=1, keepdims=True)
        work.squares = work.squares.mean(axis=1, keepdims=True)
        independent = variance * _independent_share(block, a.shape[1])
        work.pruned = self._checked("views", block, spread, work.squares, variance, independent)
        work.coefficients, work.variance = mean, variance - independent
        if work.shape is not None:
            work.shape = replace(work.shape, apart=work.shape.apart * [0.0, 1.0])
        self._averaged += variance[block.valid].sum(), work.variance[block.valid].sum()

    def _drop_bands(self, block: Block, work: _Working) -> None:
        a, kept = work.coefficients, sh.count(self._pruning.kept_degree)
        above = (a[:, :, kept:] ** 2).sum(axis=(2, 3)) / (a.shape[2] * 3)
        noise = (1.0 - kept / a.shape[2]) * work.variance
        work.pruned = work.pruned + self._checked("bands", block, above, work.squares, work.variance, noise)
        work.coefficients = a[:, :, :kept]
        work.shape = None if work.shape is None else work.shape.truncated(kept)

    def _average_channels(self, block: Block, work: _Working) -> None:
        grey = work.coefficients.mean(axis=3, keepdims=True)
        spread = ((work.coefficients - grey) ** 2).mean(axis=(2, 3))
        work.pruned = work.pruned + self._checked("channels", block, spread, work.squares, 0.0 * work.variance, 0.0)
        work.coefficients = grey
        if work.shape is not None:
            work.shape = replace(work.shape, channels=np.ones_like(work.shape.channels[:, :1]))

    def _apply_light(self, coefficients: Array, block: Block, work: _Working) -> None:
        a = work.coefficients
        light = coefficients[: a.shape[2], : a.shape[3]]
        gain = self._variance_gain(work.shape, light, block)
        work.coefficients = np.einsum("nbkc,kc->nbc", a, light)[:, :, None]
        work.variance = work.variance * gain.mean(axis=2)
        if work.shape is not None:
            work.shape = normalised_covariance(np.ones((len(a), 1)), gain.mean(axis=1), work.shape.apart, 1)

    def _variance_gain(self, shape: ErrorCovariance | None, light: Array, block: Block) -> Array:
        """Variance [n,b,C] of the radiance under the light [K,C], over the variance of a coefficient."""
        n, views = len(block.valid), 1 if self._pruning.views == "one" else block.coefficients.shape[1]
        if shape is None:
            return np.broadcast_to((light**2).sum(axis=0), (n, views, light.shape[1]))
        outgoing, _clamped = self._pruning.outgoing(block.first_vertex + np.arange(n))
        rows, many = np.repeat(np.arange(n), outgoing.shape[1]), n * outgoing.shape[1]
        lights = np.broadcast_to(light, (many, *light.shape))
        in_view = self._frames.in_view(block.first_vertex + rows, outgoing.reshape(-1, 3), lights)
        gain = shape.at_vertices(rows).variance_under(in_view).reshape(n, -1, light.shape[1])
        return gain if views > 1 else gain.mean(axis=1, keepdims=True)

    def _checked(
        self, item: str, block: Block, pruned: Array, squares: Array, variance: Array, noise: Array | float
    ) -> Array:
        """The pruned mean square less its expected noise. Raises WronglyPruned at the first vertex where it exceeds
        what is tolerated and what errors of that variance explain.
        """
        excess = np.maximum(pruned - variance, 0.0).mean(axis=1)
        scale = np.maximum(squares.mean(axis=1), DARK * self._pruning.signal)
        limit = (WORST * self._pruning.tolerated) ** 2 * scale + (NOISE**2) * variance.mean(axis=1)
        wrong = block.valid & (excess > limit)
        if wrong.any():
            raise WronglyPruned(item, block.first_vertex + int(wrong.argmax()))
        return pruned - noise


def _independent_share(block: Block, bins: int) -> Array:
    """Share [n,1] of the variance of bins that averaging over them removes; bins that share directions err together."""
    if block.correlated is None:
        return np.zeros((len(block.valid), 1))
    together = np.where(block.valid, block.correlated, 0.0)[:, None]
    return np.asarray(1.0 - together**2 - (1.0 - together) / bins)
