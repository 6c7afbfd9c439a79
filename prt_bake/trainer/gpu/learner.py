"""A learner whose steps are recorded as one graph of the GPU's operations, and replayed without waiting for it."""

import math
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import numpy as np
import torch
from torch import Tensor

from formats.errors import QueryError
from prt_bake.mathematics.sphere import fibonacci
from prt_bake.network.bssrdf import NeuralBSSRDF
from prt_bake.network.features.view_features import ViewEncoding
from prt_bake.network.features.view_path import known_paths
from prt_bake.tracer.gpu.device_functions import cuda
from prt_bake.trainer.gpu.renderer import GpuBatch
from prt_bake.trainer.learning.learner import Learner, LearningSettings, learning_rate, share_of_average
from prt_bake.trainer.samples.rows import OUTGOING, POSITION, Batch, RowSource, rays_of

GPU_LEARNING = LearningSettings(spread=24, coarse_steps=0, low_batch=2048)
"""Settings for a GPU, where more directions take hardly any time. Larger batches take less time, but on the same rows
they learn much less (`docs/measurements/training.md`)."""
_WARM_UP = 3
"""Steps before the recording: first compilations and allocations cannot be recorded."""
_stream: Any = torch.cuda.Stream
_on_stream: Any = torch.cuda.stream
"""Torch has no type annotations for them."""
_CHECK_EVERY = 64
"""Steps between two looks at the loss, each of which waits for the GPU."""
_NONE = -1
"""Number of no query."""


class GpuLearner(Learner):
    """A `Learner` for rows that are on the GPU."""

    def __init__(self, network: NeuralBSSRDF, settings: LearningSettings) -> None:
        """Learn on the network's device, a GPU."""
        super().__init__(network, settings)
        self._view = network.view
        self._recordable = self._device.type == "cuda"
        self._set_optimizer()
        self._generator = torch.Generator(self._device)
        self._turns = torch.zeros((settings.batch, 3), device=self._device)
        self._lattice = torch.from_numpy(fibonacci(settings.spread).astype(np.float32)).to(self._device)
        self._average_share = torch.zeros((), device=self._device)
        self._loss = torch.zeros((), device=self._device)
        self._faulty = torch.full((), _NONE, device=self._device)
        self._batch: GpuBatch | None = None
        self._graph: Any = None
        self._last_loss, self._steps_here = math.nan, 0

    def encode_views(self, batch: Batch) -> ViewEncoding | None:
        """None: the recorded step encodes the views."""
        return None

    def learn(
        self,
        source: RowSource,
        batch: Any,
        share: float,
        generator: np.random.Generator,
        encoding: ViewEncoding | None = None,
    ) -> float:
        """As `Learner.learn`. Returns the loss of the last step at which it was looked at."""
        if self._batch is None:
            self._batch = GpuBatch._make(part.clone() for part in batch)
        for kept, part in zip(self._batch, batch, strict=True):
            kept.copy_(part)
        self._set_rate(learning_rate(self.settings, share))
        self._generator.manual_seed(int(generator.integers(2**62)))
        self._turns.uniform_(generator=self._generator)
        self._average_share.fill_(share_of_average(self.settings, self.step + 1))
        if not self._recordable:
            self._step()
        elif self._graph is None and self._steps_here < _WARM_UP:
            self._warm_up()
        elif self._graph is None:
            self._record()
        else:
            self._graph.replay()
        self.step += 1
        self._steps_here += 1
        if self._steps_here % _CHECK_EVERY == 1:
            self.check(source)
        return self._last_loss

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from `state`, also of a run on the processor."""
        super().restore(state)
        self._set_optimizer()

    def _set_optimizer(self) -> None:
        """Let the optimiser keep its rate and its numbers of steps on the GPU, so that its steps can be recorded."""
        if self._recordable:
            for group in self._groups():
                rate = torch.tensor(self.settings.rate, device=self._device)
                group.update(lr=rate, capturable=True, foreach=True)
            for optimizer in self.optimizers:
                for values in optimizer.state.values():
                    if "step" in values:
                        values["step"] = values["step"].to(self._device)

    def _set_rate(self, rate: float) -> None:
        for group in self._groups():
            if self._recordable:
                group["lr"].fill_(rate)
            else:
                group["lr"] = rate

    def _warm_up(self) -> None:
        stream: Any = _stream(self._device)
        stream.wait_stream(torch.cuda.current_stream(self._device))
        with torch.cuda.stream(stream):
            self._step()
        torch.cuda.current_stream(self._device).wait_stream(stream)

    def _record(self) -> None:
        self._graph = torch.cuda.CUDAGraph()
        # Arrays that numba frees meanwhile would end the recording.
        with cuda.defer_cleanup(), torch.cuda.graph(self._graph, capture_error_mode="thread_local"):
            self._step()
        self._graph.replay()

    def _step(self) -> None:
        assert self._batch is not None
        rows, view, path = self._batch.rows, self._view, known_paths(self._batch.paths)
        encoding = None
        if view is not None:
            encoding = view.encode(rows[:, POSITION], rows[:, OUTGOING], self._batch.normals, path)
        losses = self._losses_of_exits(rows, rays_of(rows), self._uniform(), encoding)
        loss = losses.mean()
        self._descend(loss)
        self._loss.copy_(loss.detach())
        faulty = torch.where(losses.detach().isfinite(), _NONE, self._batch.numbers).max()
        self._faulty.copy_(torch.maximum(self._faulty, faulty))
        self._average(self._average_share)

    def _descend(self, loss: Tensor) -> None:
        """As `descend`, without gradients that are not finite."""
        for optimizer in self.optimizers:
            optimizer.zero_grad(set_to_none=True)
        torch.autograd.backward(loss)
        for optimizer in self.optimizers:
            for group in optimizer.param_groups:
                for weights in group["params"]:
                    if weights.grad is not None:
                        # A look at the loss, which may come many steps later, stops the training.
                        weights.grad.nan_to_num_(0.0, 0.0, 0.0)
            optimizer.step()

    def _uniform(self) -> Tensor:
        """A randomly rotated lattice [Q,S,3] for each query (Shoemake 1992, as `prt_bake.mathematics.directions`)."""
        u = self._turns
        low, high = (1.0 - u[:, 0]).sqrt(), u[:, 0].sqrt()
        a, b = 2.0 * math.pi * u[:, 1], 2.0 * math.pi * u[:, 2]
        q = torch.stack((low * torch.sin(a), low * torch.cos(a), high * torch.sin(b)), dim=1)[:, None]
        w = (high * torch.cos(b))[:, None, None]
        lattice = self._lattice.expand(len(u), -1, -1)
        twice = 2.0 * torch.linalg.cross(q.expand_as(lattice), lattice)
        turned: Tensor = lattice + w * twice + torch.linalg.cross(q.expand_as(lattice), twice)
        return turned

    def stream(self) -> AbstractContextManager[Any]:
        """The stream of the GPU on which numba launches the walks."""
        return _on_stream(torch.cuda.default_stream(self._device)) if self._device.type == "cuda" else nullcontext()

    def check(self, source: RowSource) -> None:
        """Raise QueryError if the loss of a step since the last look was not finite."""
        self._last_loss, faulty = float(self._loss), int(self._faulty)
        if faulty != _NONE:
            raise QueryError(
                f"train: the loss of one of the last {_CHECK_EVERY} steps before step {self.step} is not finite, "
                f"caused by {source.describe(faulty)}: check the scene there, or lower the rate "
                f"({self.settings.rate:g})"
            )
