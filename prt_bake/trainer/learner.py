"""The learner: a network, its optimiser and the running average of its weights; one step from a batch of rows."""

import copy
import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from formats.errors import QueryError
from prt_bake.mathematics.directions import rotations
from prt_bake.mathematics.sphere import fibonacci
from prt_bake.network.bssrdf import NeuralBSSRDF
from prt_bake.network.features.view_features import ViewEncoding
from prt_bake.network.lobes import Lobes, evaluate_lobes, mean_square
from prt_bake.trainer.objective import LobeTerms, Loss, exit_loss, value_loss
from prt_bake.trainer.precision import bfloat16_is_faster
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

Schedule = Literal["cosine", "constant", "exponential"]


@dataclass(frozen=True)
class LearningSettings:
    """How the learner learns; chosen by measured error after equal time (`make bench`).

    Raises QueryError where a number is out of its range.
    """

    batch: int = 512
    """Queries a step."""
    rate: float = 4e-3
    schedule: Schedule = "cosine"
    """How the rate falls over the run: along a cosine to zero, not at all, or exponentially to `last_rate` of it."""
    last_rate: float = 0.01
    warm_up: float = 0.02
    """Share of the run over which the rate rises."""
    decay: float = 0.03
    """By which every weight shrinks in a step, times the rate: what walks say of it is noise in part. AdamW: Loshchilov
    and Hutter 2019, "Decoupled weight decay regularization"."""
    loss: Loss = "l2"
    floor: float = 0.01
    """Of the relative loss: what keeps it finite in the dark, in squares of the output scale."""
    average: bool = True
    """Whether the model is the running average of the weights rather than the last weights."""
    average_length: float = 0.03
    """How far the average looks back on average, as a share of the steps so far; 0.5 is all of them alike."""
    spread: int = 24
    """Directions all over the sphere, a lattice turned at random, that a query of exits is asked for besides."""
    coarse_steps: int = 1000
    """Steps at the beginning that look at a third of a query's exits and of the directions besides: what is learnt
    first is coarse, and comes sooner from many cheap steps."""
    core_share: float = 0.25
    """Share of the cores that learns (at least one does); the others walk."""
    checkpoint_every: float = 60.0
    """Seconds between checkpoints."""
    report_every: float = 2.0
    bfloat16: bool = True
    """Matrix work in bfloat16, weights in float32, where the processor is faster in it (`precision`)."""
    held_out_queries: int = 512
    held_out_walks: int = 256

    def __post_init__(self) -> None:
        sound = {
            "batch": self.batch >= 1,
            "rate": self.rate > 0.0,
            "schedule": self.schedule in ("cosine", "constant", "exponential"),
            "last_rate": 0.0 < self.last_rate <= 1.0,
            "warm_up": 0.0 <= self.warm_up <= 1.0,
            "decay": self.decay >= 0.0,
            "loss": self.loss in ("l2", "relative"),
            "floor": self.floor > 0.0,
            "average_length": 0.0 < self.average_length <= 0.5,
            "spread": self.spread >= 1,
            "coarse_steps": self.coarse_steps >= 0,
            "core_share": 0.0 <= self.core_share < 1.0,
            "held_out_queries": self.held_out_queries >= 1,
            "held_out_walks": self.held_out_walks >= 2,
        }
        for name, fits in sound.items():
            if not fits:
                raise QueryError(f"learning settings: {name} cannot be {getattr(self, name)!r}")


def learning_rate(settings: LearningSettings, share: float) -> float:
    """The learning rate after `share` of the run."""
    share = min(1.0, share)
    rise = min(1.0, (share + 1e-4) / max(settings.warm_up, 1e-4))
    if settings.schedule == "constant":
        fall = 1.0
    elif settings.schedule == "exponential":
        fall = settings.last_rate**share
    else:
        fall = 0.5 * (1.0 + math.cos(math.pi * share))
    return settings.rate * rise * fall


class Learner:
    """A network on its way: `network` has the last weights, `answer` those that the model is made of; `bfloat16` is the
    matrix work's.
    """

    def __init__(self, network: NeuralBSSRDF, settings: LearningSettings) -> None:
        """Learn on the device that the network is on."""
        self.network, self.settings = network, settings
        self.answer = copy.deepcopy(network) if settings.average else network
        self.optimizer = torch.optim.AdamW(
            network.parameters(), lr=settings.rate, betas=(0.9, 0.99), weight_decay=settings.decay
        )
        self.step = 0
        self._device = network.frequencies.device
        self.bfloat16 = settings.bfloat16 and bfloat16_is_faster(self._device.type)

    def told(self, batch: Batch) -> ViewEncoding | None:
        """What the network is told of the rows' views whatever it has learnt; other threads may ask for it."""
        rows = torch.from_numpy(batch.rows[:, :BEFORE_RAYS]).to(self._device)
        return self.network.encode_views(self._positions(rows), rows[:, OUTGOING])

    def learn(
        self,
        source: RowSource,
        batch: Batch,
        share: float,
        generator: np.random.Generator,
        told: ViewEncoding | None = None,
    ) -> float:
        """One step from rows that `source` gave, after `share` of the run; returns the loss. `told` is what `told` said
        of the rows, where that has been asked already.

        Raises QueryError where the loss is not finite, with the query that caused it; no weight is touched then.
        """
        for group in self.optimizer.param_groups:
            group["lr"] = learning_rate(self.settings, share)
        rows = torch.from_numpy(batch.rows).to(self._device)
        each = self._from_exits(rows, generator, told) if source.exits else self._from_values(rows, told)
        loss = each.mean()
        value = float(loss.detach())
        if not math.isfinite(value):
            raise QueryError(self._fault(source, batch, each.detach().cpu().numpy(), value))
        self.optimizer.zero_grad(set_to_none=True)
        torch.autograd.backward(loss)
        self.optimizer.step()
        self.step += 1
        if self.settings.average:
            self._average()
        return value

    def state(self) -> dict[str, Any]:
        """What `restore` needs: weights, their average, the optimiser's moments, the step, the matrix work's kind."""
        return {
            "network": self.network.state_dict(),
            "average": self.answer.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "step": self.step,
            "bfloat16": self.bfloat16,
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Take up where `state` was taken."""
        self.network.load_state_dict(state["network"])
        self.answer.load_state_dict(state["average"] if self.settings.average else state["network"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.step = int(state["step"])
        self.bfloat16 = bool(state.get("bfloat16", self.bfloat16))

    def _from_values(self, rows: Tensor, told: ViewEncoding | None) -> Tensor:
        rays = rays_of(rows)
        answers, _lobes = self._answers(rays[..., INCIDENT], rows, told)
        values = rays[..., CHANNELS] / self.network.output_scale
        return value_loss(answers, values, self.settings.loss, self.settings.floor)

    def _from_exits(self, rows: Tensor, generator: np.random.Generator, told: ViewEncoding | None) -> Tensor:
        rays, spread = rays_of(rows), self.settings.spread
        if self.step < self.settings.coarse_steps and bool(torch.isfinite(rays).all()):
            rays, spread = every_third(rays, int(generator.integers(3))), math.ceil(spread / 3)
        everywhere = torch.from_numpy(rotated_lattice(len(rows), spread, generator)).to(self._device)
        answers, lobes = self._answers(torch.cat((rays[..., INCIDENT], everywhere), dim=1), rows, told)
        throughput = rays[..., CHANNELS] / self.network.output_scale
        walks = rays.shape[1]
        some = None if lobes is None else LobeTerms(evaluate_lobes(lobes, everywhere), mean_square(lobes))
        settings = self.settings
        return exit_loss(answers[:, :walks], throughput, answers[:, walks:], settings.loss, settings.floor, some)

    def _answers(self, incident: Tensor, rows: Tensor, told: ViewEncoding | None) -> tuple[Tensor, Lobes | None]:
        """The network's answers [Q,D,3] towards incident [Q,D,3] over its output scale, in float32, and the lobes in
        them.
        """
        with torch.autocast(self._device.type, torch.bfloat16, enabled=self.bfloat16):
            answer, lobes = self.network.components(incident, self._positions(rows), rows[:, OUTGOING], told)
        return (answer.float() if lobes is None else answer.float() + evaluate_lobes(lobes, incident)), lobes

    def _positions(self, rows: Tensor) -> Tensor:
        """Positions [Q,3] in the scene."""
        positions: Tensor = self.network.box_min + self.network.box_side * rows[:, POSITION].double()
        return positions

    def _average(self) -> None:
        """Move the average towards the weights, so that it weighs step s of t by about (s/t)^γ."""
        steepness = 1.0 / self.settings.average_length - 2.0
        share = 1.0 - (1.0 - 1.0 / self.step) ** (steepness + 1.0)
        with torch.no_grad():
            for mean, weights in zip(self.answer.parameters(), self.network.parameters(), strict=True):
                mean.lerp_(weights, share)

    def _fault(self, source: RowSource, batch: Batch, each: NDArray[np.float32], value: float) -> str:
        broken = np.flatnonzero(~np.isfinite(each))
        at = int(broken[0]) if len(broken) else int(np.argmax(np.abs(each)))
        row = batch.rows[at].astype(np.float64)
        rays = batch.rays[at].astype(np.float64)
        unsound = ~np.isfinite(rays[:, CHANNELS]).all(axis=1)
        ray = rays[np.argmax(unsound) if unsound.any() else np.argmax(np.abs(rays[:, CHANNELS]).max(axis=1))]
        network = self.network
        position = network.box_min.cpu().numpy() + network.box_side * row[POSITION]
        what = "throughput" if source.exits else "value"
        if unsound.any():
            cause = f"its {what} is not finite: look at the scene there"
        elif len(broken) == len(each):
            cause = f"so is that of every other query: lower the rate ({self.settings.rate:g})"
        else:
            cause = f"its {what} is too far from the others: look at the scene there, or lower the rate"
        return (
            f"train: the loss of step {self.step} is {value}, by {source.where(int(batch.numbers[at]))}: "
            f"position {_told(position)}, outgoing {_told(row[OUTGOING])}, incident {_told(ray[INCIDENT])}, "
            f"{what} {_told(ray[CHANNELS])}; {cause}"
        )


def every_third(rays: Tensor, first: int) -> Tensor:
    """Every third of the rays [Q,P,6] of each query, a systematic sample where they are one. The mean of what they
    carry, averaged over `first`, is that of all.
    """
    rays_a_query = rays.shape[1]
    if rays_a_query < 3:
        return rays
    third = rays[:, first::3].clone()
    third[..., CHANNELS] *= 3.0 * third.shape[1] / rays_a_query
    return third


def rotated_lattice(count: int, spread: int, generator: np.random.Generator) -> NDArray[np.float32]:
    """`spread` directions for each of `count` queries [count, spread, 3], each uniform over the sphere."""
    turns = rotations(generator.random((count, 3))).astype(np.float32)
    return np.asarray(np.einsum("nij,dj->ndi", turns, fibonacci(spread).astype(np.float32), optimize=True))


def _told(vector: NDArray[np.float64]) -> str:
    return "(" + ", ".join(f"{x:.6g}" for x in vector) + ")"
