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
from prt_bake.network import NeuralBSSRDF
from prt_bake.trainer.objective import Loss, of_exits, of_values
from prt_bake.trainer.rows import CHANNELS, INCIDENT, OUTGOING, POSITION, Batch, RowSource

Schedule = Literal["cosine", "constant", "exponential"]


@dataclass(frozen=True)
class LearningSettings:
    """How the learner learns; chosen by measured error after equal time (`make bench`).

    Raises QueryError where a number is out of its range.
    """

    batch: int = 4096
    rate: float = 2e-3
    schedule: Schedule = "cosine"
    """How the rate falls over the run: along a cosine to zero, not at all, or exponentially to `last_rate` of it."""
    last_rate: float = 0.01
    warm_up: float = 0.02
    """Share of the run over which the rate rises."""
    loss: Loss = "l2"
    floor: float = 0.01
    """Of the relative loss: what keeps it finite in the dark, in squares of the output scale."""
    average: bool = True
    """Whether the model is the running average of the weights rather than the last weights."""
    average_length: float = 0.03
    """How far the average looks back on average, as a share of the steps so far; 0.5 is all of them alike."""
    spread: int = 1
    """Directions drawn uniformly for each exit of a walk, behind smooth interfaces."""
    core_share: float = 0.25
    """Share of the cores that learns (at least one does); the others walk."""
    checkpoint_every: float = 60.0
    """Seconds between checkpoints."""
    report_every: float = 2.0
    bfloat16: bool = True
    """Matrix work in bfloat16, weights in float32, where the processor has it."""
    held_out_queries: int = 512
    held_out_walks: int = 256

    def __post_init__(self) -> None:
        sound = {
            "batch": self.batch >= 1,
            "rate": self.rate > 0.0,
            "schedule": self.schedule in ("cosine", "constant", "exponential"),
            "last_rate": 0.0 < self.last_rate <= 1.0,
            "warm_up": 0.0 <= self.warm_up <= 1.0,
            "loss": self.loss in ("l2", "relative"),
            "floor": self.floor > 0.0,
            "average_length": 0.0 < self.average_length <= 0.5,
            "spread": self.spread >= 1,
            "core_share": 0.0 <= self.core_share < 1.0,
            "held_out_queries": self.held_out_queries >= 1,
            "held_out_walks": self.held_out_walks >= 2,
        }
        for name, fits in sound.items():
            if not fits:
                raise QueryError(f"learning settings: {name} cannot be {getattr(self, name)!r}")


def rate_at(settings: LearningSettings, share: float) -> float:
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
    """A network on its way: `network` has the last weights, `answer` those that the model is made of."""

    def __init__(self, network: NeuralBSSRDF, settings: LearningSettings) -> None:
        """Learn on the device that the network is on."""
        self.network, self.settings = network, settings
        self.answer = copy.deepcopy(network) if settings.average else network
        self.optimizer = torch.optim.Adam(network.parameters(), lr=settings.rate, betas=(0.9, 0.99))
        self.step = 0
        self._device = network.frequencies.device
        self._bfloat16 = settings.bfloat16 and _has_bfloat16(self._device)

    def learn(self, source: RowSource, batch: Batch, share: float, generator: np.random.Generator) -> float:
        """One step from rows that `source` gave, after `share` of the run; returns the loss.

        Raises QueryError where the loss is not finite, with the query that caused it; no weight is touched then.
        """
        for group in self.optimizer.param_groups:
            group["lr"] = rate_at(self.settings, share)
        rows = torch.from_numpy(batch.rows).to(self._device)
        each = self._from_exits(rows, generator) if source.exits else self._from_values(rows)
        loss = each.mean()
        value = float(loss.detach())
        if not math.isfinite(value):
            raise QueryError(self._fault(source, batch, each.detach().cpu().numpy(), value))
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        self.optimizer.step()
        self.step += 1
        if self.settings.average:
            self._average()
        return value

    def state(self) -> dict[str, Any]:
        """What `restore` needs: weights, their average, the optimiser's moments, the step."""
        return {
            "network": self.network.state_dict(),
            "average": self.answer.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "step": self.step,
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Take up where `state` was taken."""
        self.network.load_state_dict(state["network"])
        self.answer.load_state_dict(state["average"] if self.settings.average else state["network"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.step = int(state["step"])

    def _from_values(self, rows: Tensor) -> Tensor:
        answer = self._answers(rows[:, INCIDENT], rows)
        value = rows[:, CHANNELS] / self.network.output_scale
        return of_values(answer, value, self.settings.loss, self.settings.floor)

    def _from_exits(self, rows: Tensor, generator: np.random.Generator) -> Tensor:
        count, spread = len(rows), self.settings.spread
        anywhere = torch.from_numpy(uniform_directions(count * spread, generator)).to(self._device)
        answers = self._answers(
            torch.cat((rows[:, INCIDENT], anywhere)), torch.cat((rows, rows.repeat_interleave(spread, dim=0)))
        )
        throughput = rows[:, CHANNELS] / self.network.output_scale
        everywhere = answers[count:].reshape(count, spread, 3)
        return of_exits(answers[:count], throughput, everywhere, self.settings.loss, self.settings.floor)

    def _answers(self, incident: Tensor, rows: Tensor) -> Tensor:
        """The network's answers [M,3] over its output scale, in float32."""
        network = self.network
        positions = network.box_min + network.box_side * rows[:, POSITION].double()
        with torch.autocast(self._device.type, torch.bfloat16, enabled=self._bfloat16):
            answer: Tensor = network(incident, positions, rows[:, OUTGOING])
        return answer.float() / network.output_scale

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
        network = self.network
        position = network.box_min.cpu().numpy() + network.box_side * row[POSITION]
        what = "throughput" if source.exits else "value"
        if not np.isfinite(row[CHANNELS]).all():
            cause = f"its {what} is not finite: look at the scene there"
        elif len(broken) == len(each):
            cause = f"so is that of every other query: lower the rate ({self.settings.rate:g})"
        else:
            cause = f"its {what} is too far from the others: look at the scene there, or lower the rate"
        return (
            f"train: the loss of step {self.step} is {value}, by {source.where(int(batch.numbers[at]))}: "
            f"position {_told(position)}, outgoing {_told(row[OUTGOING])}, incident {_told(row[INCIDENT])}, "
            f"{what} {_told(row[CHANNELS])}; {cause}"
        )


def uniform_directions(count: int, generator: np.random.Generator) -> NDArray[np.float32]:
    """Directions [count,3], uniform over the sphere."""
    u, v = generator.random((2, count))
    z, turn = 1.0 - 2.0 * u, 2.0 * np.pi * v
    r = np.sqrt(np.maximum(0.0, 1.0 - z * z))
    return np.stack([r * np.cos(turn), r * np.sin(turn), z], axis=1).astype(np.float32)


def _has_bfloat16(device: torch.device) -> bool:
    if device.type != "cpu":
        return bool(torch.cuda.is_bf16_supported())
    able = torch.cpu.get_capabilities()
    return any(bool(able.get(name)) for name in ("avx512_bf16", "amx_bf16", "bf16"))


def _told(vector: NDArray[np.float64]) -> str:
    return "(" + ", ".join(f"{x:.6g}" for x in vector) + ")"
