"""Leaves out of baked blocks what the scene does not need, and holds every vertex against what a few have promised."""

import math
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from bakers.baker import Block
from bakers.error_covariance import shape_of
from formats.asset import Asset, AssetHead
from formats.asset.error_covariance import ErrorShape
from prt_bake.baking.job.pruning_record import Needs
from prt_bake.baking.job.running_error import ErrorMeter
from prt_bake.baking.output.sink import Sink, open_sink
from prt_bake.baking.pruning.pruning import WORST
from prt_bake.mathematics import sh
from prt_bake.mathematics.view_frames import ViewFrames, frames_of

Array = NDArray[np.float64]

DARK = 1e-2
"""Of the mean square coefficient: darker vertices are held to the errors of those that have it."""
NOISE = 1.5
"""Standard errors that bands which hold nothing may show."""


class NotSo(Exception):
    """An item was left out that a vertex needs."""

    def __init__(self, item: str, vertex: int) -> None:
        super().__init__(f"{item} matter at vertex {vertex}")
        self.item, self.vertex = item, vertex


def pared_head(head: AssetHead, needs: Needs) -> AssetHead:
    """The head of an asset that keeps what is needed alone."""
    degree = needs.kept_degree
    head = replace(
        head,
        degree=degree,
        check_values=head.check_values[:, : sh.count(degree)],
        left_out=[item.as_json() for item in needs.left_out],
    )
    if needs.light is None:
        return head
    return replace(head, quantity="radiance", folded_in=f"light {needs.light.content_hash}")


def pared_sink(out: str | Path | None, head: AssetHead, storage: str, needs: Needs) -> "ParedSink":
    """A sink in memory or for the file `out`, for blocks of all that is baked; raises QueryError on a storage type."""
    folded = None if needs.light is None else needs.light.coefficients
    views = len(head.directions) if needs.views == "all" else 1
    sink = open_sink(out, pared_head(head, needs), storage, views, needs.channels, folded)
    return ParedSink(sink, needs, frames_of(head.mesh))


class ParedSink:
    """Takes blocks of all that was baked and hands on what the asset keeps.

    Attributes:
        squared: Σ of squares that were left out, mean over K and channels, noise taken off without bias, and of those
            that stayed, over vertices.
    """

    def __init__(self, sink: Sink, needs: Needs, frames: ViewFrames) -> None:
        self._sink, self._needs, self._frames = sink, needs, frames
        self._copies: dict[int, list[int]] = {}
        for vertex, same in needs.copies.tolist():
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
    def left_out(self) -> float:
        """Relative RMSE that leaving out has added so far."""
        return float(np.sqrt(max(self.squared[0], 0.0) / self.squared[1])) if self.squared[1] > 0.0 else 0.0

    def write(self, block: Block) -> None:
        """Takes a block [n,B,K,3] of consecutive vertices; raises NotSo where one of them needs what is left out."""
        pared = self._pared(block)
        self._sink.write(pared)
        if self._needs.light is not None:
            self._meter.add(pared)
        for row, vertex in enumerate(range(block.first_vertex, block.first_vertex + len(block.valid))):
            for copy in self._copies.get(vertex, ()):
                rows = slice(row, row + 1)
                parts = pared.coefficients[rows], pared.standard_error[rows], pared.valid[rows]
                shape = None if pared.shape is None else pared.shape.of(np.array([row]))
                self._sink.write(Block(copy, *parts, 0, shape=shape))

    def finish(self, provenance: dict[str, Any], error_vs_time: NDArray[np.float64], complete: bool) -> Asset:
        """The asset, whole or in part; its error figures hold what was left out, and rounding, besides."""
        if self._needs.light is not None:
            # What was foretold are errors of coefficients: under a light they weigh as it has it.
            told = {"total": self._meter.total, "percentile_95_over_vertices": self._meter.percentile_95}
            return self._sink.finish(provenance | {"estimated_relative_rmse": told}, error_vs_time, complete)
        parts = {"left_out": self.left_out, "rounding": self._needs.rounding}
        parts = {name: value for name, value in parts.items() if value > 0.0}
        if parts or self._needs.views == "one":
            smaller = math.sqrt(self._averaged[1] / self._averaged[0]) if self._averaged[0] > 0.0 else 1.0
            told = {name: smaller * value for name, value in provenance["estimated_relative_rmse"].items()}
            whole = {name: math.hypot(value, *parts.values()) for name, value in told.items()}
            provenance = provenance | {"estimated_relative_rmse": whole | parts}
        return self._sink.finish(provenance, error_vs_time, complete)

    def _pared(self, block: Block) -> Block:
        needs = self._needs
        a, variance = block.coefficients.astype(np.float64), (block.standard_error / np.float64(block.bound)) ** 2
        squares = (a**2).mean(axis=(2, 3))
        variance += needs.rounding**2 * squares
        off, shape = np.zeros(variance.shape), block.shape
        if needs.views == "one":
            mean = a.mean(axis=1, keepdims=True)
            spread = ((a - mean) ** 2).mean(axis=(1, 2, 3), keepdims=True)[..., 0, 0]
            each, squares = variance.mean(axis=1, keepdims=True), squares.mean(axis=1, keepdims=True)
            apart = each * _spreading(block, a.shape[1])
            off, variance = self._held("views", block, spread, squares, each, apart), each - apart
            shape = None if shape is None else replace(shape, apart=shape.apart * [0.0, 1.0])
            self._averaged += each[block.valid].sum(), variance[block.valid].sum()
            a = mean
        kept = sh.count(needs.kept_degree)
        if kept < a.shape[2]:
            cut = (a[:, :, kept:] ** 2).sum(axis=(2, 3)) / (a.shape[2] * 3)
            off = off + self._held("bands", block, cut, squares, variance, (1.0 - kept / a.shape[2]) * variance)
            a = a[:, :, :kept]
            shape = None if shape is None else shape.of_first(kept)
        if needs.channels == 1:
            grey = a.mean(axis=3, keepdims=True)
            cut = ((a - grey) ** 2).mean(axis=(2, 3))
            off = off + self._held("channels", block, cut, squares, 0.0 * variance, 0.0)
            a = grey
            shape = None if shape is None else replace(shape, channels=np.ones_like(shape.channels[:, :1]))
        self.squared += off[block.valid].sum(), squares[block.valid].sum()
        variance = variance + np.maximum(off, 0.0)
        if needs.light is not None:
            light = needs.light.coefficients[: a.shape[2], : a.shape[3]]
            a = np.einsum("nbkc,kc->nbc", a, light)[:, :, None]
            times = self._under(shape, light, block)
            variance = variance * times.mean(axis=2)
            shape = None if shape is None else shape_of(np.ones((len(a), 1)), times.mean(axis=1), shape.apart, 1)
        stated = (block.bound * np.sqrt(variance)).astype(np.float32)
        return replace(block, coefficients=a.astype(np.float32), standard_error=stated, shape=shape)

    def _under(self, shape: ErrorShape | None, light: Array, block: Block) -> Array:
        """The variance [n,b,C] in each channel, over that of a coefficient, of what bins send under the light [K,C]."""
        n, views = len(block.valid), 1 if self._needs.views == "one" else block.coefficients.shape[1]
        if shape is None:
            return np.broadcast_to((light**2).sum(axis=0), (n, views, light.shape[1]))
        outgoing, _bent = self._needs.outgoing(block.first_vertex, block.first_vertex + n)
        rows, many = np.repeat(np.arange(n), outgoing.shape[1]), n * outgoing.shape[1]
        lights = np.broadcast_to(light, (many, *light.shape))
        in_view = self._frames.in_view(block.first_vertex + rows, outgoing.reshape(-1, 3), lights)
        times = shape.of(rows).under(in_view).reshape(n, -1, light.shape[1])
        return times if views > 1 else times.mean(axis=1, keepdims=True)

    def _held(
        self, item: str, block: Block, off: Array, squares: Array, variance: Array, noise: Array | float
    ) -> Array:
        """What is left out at each bin, `noise` apart, at times below 0; raises NotSo at a vertex where it is too much,
        as far as errors of that variance tell.
        """
        each = np.maximum(off - variance, 0.0).mean(axis=1)
        scale = np.maximum(squares.mean(axis=1), DARK * self._needs.signal)
        limit = (WORST * self._needs.tolerated) ** 2 * scale + (NOISE**2) * variance.mean(axis=1)
        wrong = block.valid & (each > limit)
        if wrong.any():
            raise NotSo(item, block.first_vertex + int(wrong.argmax()))
        return off - noise


def _spreading(block: Block, bins: int) -> Array:
    """Of the variance of bins, what is not in their mean [n,1]: some err together and the others apart."""
    if block.together is None:
        return np.zeros((len(block.valid), 1))
    together = np.where(block.valid, block.together, 0.0)[:, None]
    return np.asarray(1.0 - together**2 - (1.0 - together) / bins)
