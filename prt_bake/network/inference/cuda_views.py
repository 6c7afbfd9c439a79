"""What a network on a graphics card is told of views, and of views and directions together."""

from collections.abc import Callable
from threading import Lock
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from prt_bake.network.settings import LIGHT_RAY_ORIGINS

if TYPE_CHECKING:
    from prt_bake.network.bssrdf import NeuralBSSRDF

MIN_TILE = 16
"""Rows and columns of the smallest product that matrix units do."""
stream: Any = torch.cuda.Stream
"""Torch gives it no types."""


class ViewTerms(NamedTuple):
    """Views [N]: what they add to the late layers [layers,N,width], what is held against ωi [N,·,3], and lobes."""

    added: Tensor
    frame: Tensor
    lobes: tuple[Tensor, ...]


class PairColumns(NamedTuple):
    """What the kernel must know to tell of views and directions together: `card_kernels._pair_inputs`."""

    columns: int
    """With those that fill up."""
    numbers: Tensor
    lengths: Tensor
    grids: Tensor

    @staticmethod
    def of(network: "NeuralBSSRDF") -> "PairColumns":
        """Those of a network that sees ωi late."""
        settings, at = network.settings, network.frequencies.device
        count = max(MIN_TILE, 1 << (settings.pair_inputs - 1).bit_length()) if settings.pair_inputs else MIN_TILE
        numbers, lengths = np.zeros((count, 5), np.int32), np.zeros((count, 5), np.float32)
        light = None if network.view is None else network.view.light
        grids = [torch.zeros(1, device=at)]
        if light is not None:
            pyramid = light.pyramid()
            begins = np.cumsum([1, *(level.grid.numel() for level in pyramid)])
            each = [(start, place) for start in range(len(LIGHT_RAY_ORIGINS)) for place in range(len(light.distances))]
            for column, (start, place) in enumerate(each, start=settings.angle_powers):
                which = light.level_at[place]
                level = pyramid[which]
                numbers[column] = start, begins[which], *level.grid.shape
                lengths[column] = light.distances[place], *level.corner, 1.0 / level.spacing
            grids += [level.grid.flatten() for level in pyramid]
        axes = settings.angle_powers + settings.light_places
        numbers[axes : axes + settings.light_axes, 0] = len(LIGHT_RAY_ORIGINS) + np.arange(settings.light_axes)
        told = torch.from_numpy(numbers).to(at), torch.from_numpy(lengths).to(at)
        return PairColumns(count, *told, torch.cat(grids))


class RecordedGraph:
    """A function of views, in lots of one size, recorded once and played back on a card: its many steps are one."""

    def __init__(self, function: Callable[[Tensor], ViewTerms], size: int, device: torch.device) -> None:
        self._function, self._size, self._device = function, size, device
        self._lock = Lock()
        self._graph: Any = None
        self._asked = torch.empty((0, 0))
        self._found = ViewTerms(torch.empty(0), torch.empty(0), ())

    def __call__(self, asked: Tensor) -> ViewTerms:
        """The function's answers, of any number of views [N,·]."""
        lots = [self._lot(some) for some in torch.split(asked, self._size)]
        if len(lots) == 1:
            return lots[0]
        added, frame = torch.cat([lot.added for lot in lots], dim=1), torch.cat([lot.frame for lot in lots])
        return ViewTerms(added, frame, tuple(torch.cat(alike) for alike in zip(*(lot.lobes for lot in lots), strict=True)))

    def _lot(self, asked: Tensor) -> ViewTerms:
        many = len(asked)
        with self._lock:
            if not len(self._asked):
                self._asked = asked.new_zeros((self._size, asked.shape[1]))
                self._record()
            self._asked[:many] = asked
            if self._graph is None:
                found = self._function(self._asked)
            else:
                self._graph.replay()
                found = self._found
            # Copies: the next lot is written over these.
            lobes = tuple(part[:many].clone() for part in found.lobes)
            return ViewTerms(found.added[:, :many].contiguous().clone(), found.frame[:many].clone(), lobes)

    def _record(self) -> None:
        if self._device.type != "cuda":
            return
        beside = stream(self._device)
        beside.wait_stream(torch.cuda.current_stream(self._device))
        with torch.cuda.stream(beside):
            # Once before: what is compiled or allocated for the first time cannot be recorded.
            self._function(self._asked)
        torch.cuda.current_stream(self._device).wait_stream(beside)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph, capture_error_mode="thread_local"):
            self._found = self._function(self._asked)
        self._graph = graph
