"""The learner: a network, its optimiser and the running average of its weights, one step per batch of rows."""

import copy
import math
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from formats.errors import QueryError
from prt_bake.mathematics.directions import rotations
from prt_bake.mathematics.sphere import fibonacci
from prt_bake.network.lobes import Lobes, evaluate_lobes, mean_square
from prt_bake.network.model import TrainableModel
from prt_bake.trainer.learning.muon import Muon
from prt_bake.trainer.learning.objective import LobeTerms, exit_loss, value_loss
from prt_bake.trainer.learning.precision import bfloat16_is_faster
from prt_bake.trainer.samples.rows import (
    BEFORE_RAYS,
    CHANNELS,
    INCIDENT,
    OUTGOING,
    POSITION,
    Batch,
    RowSource,
    rays_of,
)

_RATE_OF_EARLIER_WEIGHTS = 2e-3
"""A compromise: small changes of a material gain from a lower rate, large ones from this one."""


@dataclass(frozen=True)
class LearningSettings:
    """Settings of the optimisation; the defaults have the least measured error after equal time (`make bench`).

    Raises QueryError if a value is out of range.
    """

    batch: int = 512
    """Queries per step."""
    rate: float = 4e-3
    """Learning rate, which falls along a cosine to zero."""
    warm_up: float = 0.02
    """Share of the run over which the rate rises linearly."""
    decay: float = 0.03
    """Weight decay, times the rate, per step; it damps weights fitted to the noise of the walks. AdamW: Loshchilov and
    Hutter 2019, "Decoupled weight decay regularization"."""
    muon: bool = True
    """Whether Muon updates the matrices of the hidden layers (`muon.py`); AdamW updates all other weights."""
    average_length: float = 0.03
    """Mean age of the weights, whose running average the model has, as a share of the steps so far; 0.5 weights all
    steps equally."""
    spread: int = 12
    """Uniform directions in which a query of exits is also evaluated: a randomly rotated lattice."""
    coarse_steps: int = 300
    """First steps that use a third of the exits and of the uniform directions. The network learns coarse structure
    first, sooner from many cheap steps."""
    low_batch: int = 512
    """Queries per step of the low bands (`low_bands.py`)."""
    checkpoint_every: float = 60.0
    """Seconds between checkpoints."""
    report_every: float = 2.0
    bfloat16: bool = True
    """Matrix products in bfloat16, weights in float32, if the processor is faster in it (`precision.py`)."""
    held_out_queries: int = 512
    held_out_walks: int = 256

    def __post_init__(self) -> None:
        valid = {
            "batch": (self.batch >= 1, "1 or more"),
            "rate": (self.rate > 0.0, "a number above 0"),
            "warm_up": (0.0 <= self.warm_up <= 1.0, "0 to 1"),
            "decay": (self.decay >= 0.0, "0 or more"),
            "average_length": (0.0 < self.average_length <= 0.5, "above 0 and at most 0.5"),
            "spread": (self.spread >= 1, "1 or more"),
            "coarse_steps": (self.coarse_steps >= 0, "0 or more"),
            "low_batch": (self.low_batch >= 1, "1 or more"),
            "held_out_queries": (self.held_out_queries >= 1, "1 or more"),
            "held_out_walks": (self.held_out_walks >= 2, "2 or more"),
        }
        for name, (fits, expected) in valid.items():
            if not fits:
                raise QueryError(f"learning settings: {name}: expected {expected}, found {getattr(self, name)!r}")


def continued(settings: LearningSettings) -> LearningSettings:
    """The settings for weights of an earlier training, which a high rate would undo."""
    return replace(settings, rate=_RATE_OF_EARLIER_WEIGHTS, coarse_steps=0)


def learning_rate(settings: LearningSettings, share: float) -> float:
    """The learning rate after `share` of the run."""
    share = min(1.0, share)
    rise = min(1.0, (share + 1e-4) / max(settings.warm_up, 1e-4))
    return settings.rate * rise * 0.5 * (1.0 + math.cos(math.pi * share))


def optimizers_of(layers: nn.Module, settings: LearningSettings) -> list[torch.optim.Optimizer]:
    """Muon for the matrices of the hidden layers of `layers`, and AdamW for all their other weights."""
    hidden = getattr(layers, "hidden", ()) if settings.muon else ()
    matrices = [layer.weight for layer in hidden if isinstance(layer, nn.Linear)]
    chosen = set(map(id, matrices))
    others = [part for part in layers.parameters() if id(part) not in chosen]
    adam = torch.optim.AdamW(others, lr=settings.rate, betas=(0.9, 0.99), weight_decay=settings.decay)
    return [adam, Muon(matrices, settings.rate, settings.decay)] if matrices else [adam]


def descend(loss: Tensor, optimizers: list[torch.optim.Optimizer]) -> None:
    """A step of all optimisers down the gradient of a loss."""
    for optimizer in optimizers:
        optimizer.zero_grad(set_to_none=True)
    torch.autograd.backward(loss)
    for optimizer in optimizers:
        optimizer.step()


def share_of_average(settings: LearningSettings, step: Any) -> Any:
    """The share with which step s of t, a number or a tensor, has a weight of about (s/t)^γ in the average."""
    gamma = 1.0 / settings.average_length - 2.0
    return 1.0 - (1.0 - 1.0 / step) ** (gamma + 1.0)


@torch.no_grad()
def move_average(average: nn.Module, weights: nn.Module, share: float | Tensor) -> None:
    """Move an average of weights towards them by a share of the way."""
    for mean, last in zip(average.parameters(), weights.parameters(), strict=True):
        mean.lerp_(last, share)


class Learner:
    """A network in training.

    Attributes:
        network: has the last weights.
        model: has the running average of the weights.
        step: optimiser steps so far.
        bfloat16: whether matrix products are in bfloat16.
    """

    def __init__(self, network: TrainableModel, settings: LearningSettings) -> None:
        """Learn on the network's device."""
        self.network, self.settings = network, settings
        self.model = copy.deepcopy(network)
        self.optimizers = self._optimizers()
        self.step = 0
        self._device = network.box_min.device
        self.bfloat16 = settings.bfloat16 and bfloat16_is_faster(self._device.type)

    def encode_views(self, batch: Batch) -> Any:
        """The network's encoding of the rows' views, which does not depend on its weights; safe in any thread."""
        rows = torch.from_numpy(batch.rows[:, :BEFORE_RAYS]).to(self._device)
        return self.network.encode_views(self._positions(rows), rows[:, OUTGOING])

    def learn(
        self,
        source: RowSource,
        batch: Batch,
        share: float,
        generator: np.random.Generator,
        encoding: Any = None,
    ) -> float:
        """Take one step on rows of `source` after `share` of the run, and return the loss.

        `encoding` is that of `encode_views`, computed here if None. Raises QueryError if the loss is not finite, naming
        the query that caused it; the weights are unchanged then.
        """
        for group in self._groups():
            group["lr"] = learning_rate(self.settings, share)
        rows = torch.from_numpy(batch.rows).to(self._device)
        losses = self._exit_losses(rows, generator, encoding) if source.exits else self._value_losses(rows, encoding)
        loss = losses.mean()
        value = float(loss.detach())
        if not math.isfinite(value):
            raise QueryError(self._error(source, batch, losses.detach().cpu().numpy(), value))
        descend(loss, self.optimizers)
        self.step += 1
        self._average(share_of_average(self.settings, self.step))
        return value

    def result(self) -> TrainableModel:
        """The model, its weights rounded as in a file."""
        return self.model.eval().rounded()

    def check(self, source: RowSource) -> None:
        """Do nothing: `learn` has looked at every loss."""

    def stream(self) -> AbstractContextManager[Any]:
        """The context in which to learn: none on the processor."""
        return nullcontext()

    def state(self) -> dict[str, Any]:
        """The state that `restore` reads: weights, their average, the optimiser's moments, and the step."""
        return {
            "network": self.network.state_dict(),
            "average": self.model.state_dict(),
            "optimizers": [optimizer.state_dict() for optimizer in self.optimizers],
            "step": self.step,
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from `state`."""
        self.network.load_state_dict(state["network"])
        self.model.load_state_dict(state["average"])
        for optimizer, values in zip(self.optimizers, state["optimizers"], strict=True):
            optimizer.load_state_dict(values)
        for group in self._groups():
            # A run on a GPU keeps its rate there.
            group.update(lr=self.settings.rate, capturable=False, foreach=None)
        self.step = int(state["step"])

    def _optimizers(self) -> list[torch.optim.Optimizer]:
        """The optimisers of all weights."""
        return optimizers_of(self.network, self.settings)

    def _average(self, share: float | Tensor) -> None:
        """Move the average towards the weights by a share of the way."""
        move_average(self.model, self.network, share)

    def _groups(self) -> list[dict[str, Any]]:
        """The groups of weights of all optimisers."""
        return [group for optimizer in self.optimizers for group in optimizer.param_groups]

    def _value_losses(self, rows: Tensor, encoding: Any) -> Tensor:
        rays = rays_of(rows)
        predicted, _lobes = self._predict(rays[..., INCIDENT], rows, encoding)
        values = rays[..., CHANNELS] / self.network.output_scale
        return value_loss(predicted, values)

    def _exit_losses(self, rows: Tensor, generator: np.random.Generator, encoding: Any) -> Tensor:
        rays, count = rays_of(rows), self.settings.spread
        if self.step < self.settings.coarse_steps and bool(torch.isfinite(rays).all()):
            rays, count = every_third(rays, int(generator.integers(3))), math.ceil(count / 3)
        uniform = torch.from_numpy(rotated_lattice(len(rows), count, generator)).to(self._device)
        return self._losses_of_exits(rows, rays, uniform, encoding)

    def _losses_of_exits(self, rows: Tensor, rays: Tensor, uniform: Tensor, encoding: Any) -> Tensor:
        """Losses [Q] of rows from rays [Q,P,6] and uniform directions [Q,S,3]."""
        predicted, lobes = self._predict(torch.cat((rays[..., INCIDENT], uniform), dim=1), rows, encoding)
        throughput = rays[..., CHANNELS] / self.network.output_scale
        walks = rays.shape[1]
        terms = None if lobes is None else LobeTerms(evaluate_lobes(lobes, uniform), mean_square(lobes))
        return exit_loss(predicted[:, :walks], throughput, predicted[:, walks:], terms)

    def _predict(self, incident: Tensor, rows: Tensor, encoding: Any) -> tuple[Tensor, Lobes | None]:
        """The network's float32 values [Q,D,3] for incident [Q,D,3] over its output scale, and their lobes."""
        with torch.autocast(self._device.type, torch.bfloat16, enabled=self.bfloat16):
            values, lobes = self.network.components(incident, self._positions(rows), rows[:, OUTGOING], encoding)
        return (values.float() if lobes is None else values.float() + evaluate_lobes(lobes, incident)), lobes

    def _positions(self, rows: Tensor) -> Tensor:
        """Positions [Q,3] in the scene's units."""
        positions: Tensor = self.network.box_min + self.network.box_side * rows[:, POSITION].double()
        return positions

    def _error(self, source: RowSource, batch: Batch, losses: NDArray[np.float32], value: float) -> str:
        """The message about a loss that is not finite: the query and the ray that caused it."""
        broken = np.flatnonzero(~np.isfinite(losses))
        at = int(broken[0]) if len(broken) else int(np.argmax(np.abs(losses)))
        row = batch.rows[at].astype(np.float64)
        rays = batch.rays[at].astype(np.float64)
        not_finite = ~np.isfinite(rays[:, CHANNELS]).all(axis=1)
        ray = rays[np.argmax(not_finite) if not_finite.any() else np.argmax(np.abs(rays[:, CHANNELS]).max(axis=1))]
        position = self.network.box_min.cpu().numpy() + self.network.box_side * row[POSITION]
        channel = "throughput" if source.exits else "value"
        if not_finite.any():
            cause = f"its {channel} is not finite: check the scene there"
        elif len(broken) == len(losses):
            cause = f"so are the losses of all other queries: lower the rate ({self.settings.rate:g})"
        else:
            cause = f"its {channel} is too far from the others: check the scene there, or lower the rate"
        return (
            f"train: the loss of step {self.step} is {value}, caused by {source.describe(int(batch.numbers[at]))}: "
            f"position {_text(position)}, outgoing {_text(row[OUTGOING])}, incident {_text(ray[INCIDENT])}, "
            f"{channel} {_text(ray[CHANNELS])}; {cause}"
        )


def every_third(rays: Tensor, first: int) -> Tensor:
    """Every third of the rays [Q,P,6] of each query, from ray number `first` on.

    Channels are rescaled so that the mean over `first` of the thirds' means is the mean of all rays.
    """
    count = rays.shape[1]
    if count < 3:
        return rays
    third = rays[:, first::3].clone()
    third[..., CHANNELS] *= 3.0 * third.shape[1] / count
    return third


def rotated_lattice(queries: int, directions: int, generator: np.random.Generator) -> NDArray[np.float32]:
    """A randomly rotated lattice for each query [queries, directions, 3]; each direction is uniform over the sphere."""
    turns = rotations(generator.random((queries, 3))).astype(np.float32)
    return np.asarray(np.einsum("nij,dj->ndi", turns, fibonacci(directions).astype(np.float32), optimize=True))


def _text(vector: NDArray[np.float64]) -> str:
    return "(" + ", ".join(f"{x:.6g}" for x in vector) + ")"
