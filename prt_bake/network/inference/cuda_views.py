"""View features on a GPU, recorded as a CUDA graph, and the layout of the features of views and directions together."""

from collections.abc import Callable
from threading import Lock
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from prt_bake.network.core import NetworkCore
from prt_bake.network.settings import LIGHT_RAY_ORIGINS

MIN_TILE = 16
"""Minimum of rows and columns of a matrix product in Triton."""
stream: Any = torch.cuda.Stream
"""Torch has no type annotations for it."""


class ViewTerms(NamedTuple):
    """What late layers need of N views.

    Attributes:
        added: contributions to the late layers [layers,N,width].
        frame: vectors that are combined with ωi [N,·,3] (`ViewEncoding.frame`).
        lobes: the tensors of `Lobes` or `Bands`, or none.
        correction: coefficients [N,9,3] of what is added to the output; [N,0,3] if nothing is.
    """

    added: Tensor
    frame: Tensor
    lobes: tuple[Tensor, ...]
    correction: Tensor


class PairColumns(NamedTuple):
    """How the kernel computes each feature of a view and a direction together: see `cuda_kernels._pair_inputs`."""

    columns: int
    """Number of features, with padding."""
    numbers: Tensor
    lengths: Tensor
    grids: Tensor

    @staticmethod
    def of(network: NetworkCore) -> "PairColumns":
        """The columns of a network whose late layers see ωi."""
        settings, device = network.settings, network.frequencies.device
        count = max(MIN_TILE, 1 << (settings.pair_inputs - 1).bit_length()) if settings.pair_inputs else MIN_TILE
        numbers, lengths = np.zeros((count, 5), np.int32), np.zeros((count, 5), np.float32)
        light = None if network.view is None else network.view.light
        grids = [torch.zeros(1, device=device)]
        if light is not None:
            pyramid = light.pyramid()
            begins = np.cumsum([1, *(level.grid.numel() for level in pyramid)])
            samples = [(row, sample) for row in range(len(LIGHT_RAY_ORIGINS)) for sample in range(len(light.distances))]
            for column, (row, sample) in enumerate(samples, start=settings.angle_powers):
                number = light.level_at[sample]
                level = pyramid[number]
                numbers[column] = row, begins[number], *level.grid.shape
                lengths[column] = light.distances[sample], *level.corner, 1.0 / level.spacing
            grids += [level.grid.flatten() for level in pyramid]
        axes = settings.angle_powers + settings.light_places
        numbers[axes : axes + settings.light_axes, 0] = len(LIGHT_RAY_ORIGINS) + np.arange(settings.light_axes)
        tables = torch.from_numpy(numbers).to(device), torch.from_numpy(lengths).to(device)
        return PairColumns(count, *tables, torch.cat(grids))


class RecordedGraph:
    """A function of views, evaluated in batches of one size; on CUDA it is recorded once and replayed as one launch."""

    def __init__(self, function: Callable[[Tensor], ViewTerms], size: int, device: torch.device) -> None:
        self._function, self._size, self._device = function, size, device
        self._lock = Lock()
        self._graph: Any = None
        self._inputs = torch.empty((0, 0))
        self._outputs = ViewTerms(torch.empty(0), torch.empty(0), (), torch.empty(0))

    def __call__(self, queries: Tensor) -> ViewTerms:
        """The function's values for any number of views [N,·]."""
        batches = [self._batch(part) for part in torch.split(queries, self._size)]
        if len(batches) == 1:
            return batches[0]
        added = torch.cat([batch.added for batch in batches], dim=1)
        frame = torch.cat([batch.frame for batch in batches])
        lobes = zip(*(batch.lobes for batch in batches), strict=True)
        correction = torch.cat([batch.correction for batch in batches])
        return ViewTerms(added, frame, tuple(torch.cat(parts) for parts in lobes), correction)

    def _batch(self, queries: Tensor) -> ViewTerms:
        count = len(queries)
        with self._lock:
            if not len(self._inputs):
                self._inputs = queries.new_zeros((self._size, queries.shape[1]))
                self._record()
            self._inputs[:count] = queries
            if self._graph is None:
                terms = self._function(self._inputs)
            else:
                self._graph.replay()
                terms = self._outputs
            # Copies: the next batch overwrites these tensors.
            lobes = tuple(part[:count].clone() for part in terms.lobes)
            added = terms.added[:, :count].contiguous().clone()
            return ViewTerms(added, terms.frame[:count].clone(), lobes, terms.correction[:count].clone())

    def _record(self) -> None:
        if self._device.type != "cuda":
            return
        warm_up = stream(self._device)
        warm_up.wait_stream(torch.cuda.current_stream(self._device))
        with torch.cuda.stream(warm_up):
            # First compilations and allocations cannot be recorded.
            self._function(self._inputs)
        torch.cuda.current_stream(self._device).wait_stream(warm_up)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph, capture_error_mode="thread_local"):
            self._outputs = self._function(self._inputs)
        self._graph = graph
