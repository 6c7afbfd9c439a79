"""Training rows from walks on a GPU, which stay there.

Walks and learning take turns on the GPU, which both can fill alone. The processor meanwhile places the next queries
and, in clear objects, finds the paths of their view rays.
"""

from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from formats.scene import Scene
from prt_bake.network.low_bands import low_harmonics
from prt_bake.tracer.gpu.device_functions import SIMULATED
from prt_bake.tracer.gpu.exits import Exits, on_gpu
from prt_bake.tracer.prepared import KernelQueries, PreparedScene, prepare
from prt_bake.trainer.gpu.resampling import kernel_array, resampled
from prt_bake.trainer.samples.queries import QuerySource
from prt_bake.trainer.samples.resampling import resampling_offsets
from prt_bake.trainer.samples.rows import Box, SourceStatistics, StreamSettings, query_description
from prt_bake.trainer.samples.traced import TracedQueries

Array = NDArray[np.float64]

GPU_STREAM = StreamSettings(queries_a_batch=1 << 15, exits=32, kept=24)
"""Settings for a GPU: `queries_a_batch` are traced at once, each with `exits` walks."""
_AHEAD = 4
"""Blocks whose queries are placed in advance, in as many threads."""


Paths = Callable[[Tensor, Tensor, Tensor], Tensor]
"""`NetworkCore.packed_paths`."""


class GpuBatch(NamedTuple):
    """A `Batch` on the GPU: rows [Q, 6 + 6 R] float32, the queries' numbers [Q] int64, and float32 normals [Q,3] of the
    mesh and paths [Q,·] of the views (`NetworkCore.packed_paths`).
    """

    rows: Tensor
    numbers: Tensor
    normals: Tensor
    paths: Tensor


class _Placed(NamedTuple):
    """Queries of a block: their number, rows before the rays float32 [B,6], normals float32 [B,3], paths float32 [B,·],
    in the kernels' coordinates, and the random numbers of resampling [B,1].
    """

    first: int
    rows: NDArray[np.float32]
    normals: NDArray[np.float32]
    paths: NDArray[np.float32]
    queries: KernelQueries
    offsets: Array


class GpuRenderer:
    """Traces rows of exits on the GPU, a block at a time."""

    exits = True

    def __init__(
        self,
        prepared: PreparedScene,
        box: Box,
        settings: StreamSettings,
        seed: int,
        batch: int,
        normals: Literal["face", "vertex"],
        paths: Paths,
        state: dict[str, int] | None = None,
    ) -> None:
        """Rows are drawn `batch` at a time, of which blocks hold a multiple. `paths` finds the paths of view rays. The
        source continues from `state` if given.
        """
        begun = state or {"next_query": 0, "walks": 0, "rows": 0}
        self._next_query, self._walks, self._rows = begun["next_query"], begun["walks"], begun["rows"]
        self.traced: TracedQueries | None = TracedQueries()
        self._prepared, self._box, self._settings, self._seed, self._normals = prepared, box, settings, seed, normals
        self._paths = paths
        self._source = QuerySource(prepared, 1, seed, settings.face_share, settings.edge_share)
        self._scene, self._size = on_gpu(prepared), batch * -(-settings.queries_a_batch // batch)
        self._pool = ThreadPoolExecutor(_AHEAD, "prtbake-places")
        self._pending: deque[Future[_Placed]] = deque()
        self._block: GpuBatch | None = None
        self._drawn = 0
        shape = self._size, settings.exits
        self._directions, self._throughput = (torch.empty((*shape, 3), device=_device()) for _ in range(2))
        self._scattered = torch.empty(shape, dtype=torch.int32, device=_device())
        self._lost = torch.empty(shape, device=_device())

    def start(self) -> None:
        """Begin to place the first queries."""
        for block in range(_AHEAD):
            self._pending.append(self._pool.submit(self._place, self._next_query + block * self._size))

    def stop(self) -> None:
        """End the threads that place queries."""
        self._pool.shutdown(cancel_futures=True)

    def draw(self, count: int) -> Any:
        """The next `count` rows, the batch, on the GPU."""
        if self._block is None or self._drawn == self._size:
            self._block, self._drawn = self._trace_block(), 0
        chosen = slice(self._drawn, self._drawn + count)
        self._drawn += count
        return GpuBatch._make(part[chosen] for part in self._block)

    def describe(self, number: int) -> str:
        """A query's number, seed and face, for messages."""
        return query_description(self._source, number)

    def statistics(self) -> SourceStatistics:
        """Walks and rows so far. How long the GPU walks is not measured: that would wait for it."""
        return SourceStatistics(self._walks, self._rows, 0.0)

    def state(self) -> dict[str, int]:
        """State to continue from, with queries that were not traced yet."""
        return {"next_query": self._next_query, "walks": self._walks, "rows": self._rows}

    def _place(self, first: int) -> _Placed:
        queries = self._source.draw(first, self._size)
        rows = np.concatenate([(queries.positions - self._box.corner) / self._box.side, queries.outgoing], axis=1)
        normals = self._prepared.surface.normals(queries.positions, queries.outgoing, self._normals)
        placed = KernelQueries._make(self._source.for_kernel(queries))
        offsets = resampling_offsets(self._seed, queries.keys)[:, None]
        paths = self._paths(*map(torch.from_numpy, (queries.positions, queries.outgoing, normals))).numpy()
        single = [part.astype(np.float32) for part in (rows, normals, paths)]
        return _Placed(first, single[0], single[1], single[2], placed, offsets)

    def _trace_block(self) -> GpuBatch:
        placed = self._pending.popleft().result()
        self._pending.append(self._pool.submit(self._place, placed.first + _AHEAD * self._size))
        rows, normals, paths = map(_to_gpu, (placed.rows, placed.normals, placed.paths))
        queries = KernelQueries._make(kernel_array(_to_gpu(array)) for array in placed.queries)
        buffers = self._directions, self._throughput, self._scattered, self._lost
        exits = Exits._make(map(kernel_array, buffers))
        first_path = kernel_array(torch.zeros(self._size, dtype=torch.int64, device=_device()))
        self._scene.draw(queries, first_path, self._seed, exits)
        light = torch.where(self._scattered[..., None] == 0, 0.0, self._throughput)
        coefficients = low_harmonics(self._directions).transpose(1, 2) @ light / self._settings.exits
        assert self.traced is not None
        self.traced.add(placed.first, rows, coefficients.flatten(1))
        rays = torch.cat(self._kept(light, placed.offsets), dim=-1).flatten(1)
        self._next_query = placed.first + self._size
        self._walks += self._size * self._settings.exits
        self._rows += self._size
        numbers = torch.arange(placed.first, placed.first + self._size, device=_device())
        return GpuBatch(torch.cat((rows, rays), dim=1), numbers, normals, paths)

    def _kept(self, light: Tensor, offsets: Array) -> tuple[Tensor, Tensor]:
        """Directions and throughput [B,K,3] of the rays to learn from."""
        if self._settings.kept == self._settings.exits:
            return self._directions, light
        return resampled(self._directions, light, self._settings.kept, _to_gpu(offsets))


def compiled_renderer(
    scene: Scene,
    box: Box,
    settings: StreamSettings,
    seed: int,
    batch: int,
    paths: Paths,
    state: dict[str, int] | None,
) -> GpuRenderer:
    """A renderer whose kernels are compiled."""
    prepared = prepare(scene)
    trial = GpuRenderer(prepared, box, replace(settings, queries_a_batch=1), seed, 1, scene.normals, paths)
    trial.start()
    trial.draw(1)
    trial.stop()
    return GpuRenderer(prepared, box, settings, seed, batch, scene.normals, paths, state)


def _device() -> str:
    """The GPU; the processor where numba simulates one."""
    return "cpu" if SIMULATED else "cuda"


def _to_gpu(array: NDArray[np.generic]) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(array)).to(_device())
