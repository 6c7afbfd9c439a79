"""What the learner minimises, for rays that are values and for rays that are exits.

Both measure the squared distance between the network f and Ŝ, over all queries and directions, in units of the
network's output scale. From values it is the mean of (f − Ŝ)². From exits it is, up to the constant ∫ Ŝ²,
∫ f² dω − 2 E[T · f(ω_exit)], since a walk's exit is a sample of Ŝ: E[T · f(ω_exit)] = ∫ Ŝ f dω. The first term is
estimated in directions drawn uniformly. Divided by 4π, as here, it is the mean over the sphere as it is from values.

The relative form weighs each direction by 1 / (m² + floor), m the network's own answer there, its channels averaged and
held fixed (Müller et al. 2021, "Real-time neural radiance caching", section 4.3).
"""

import math
from typing import Literal, NamedTuple

import torch
from torch import Tensor

Loss = Literal["l2", "relative"]

_SPHERE = 4.0 * math.pi


class SomeLobes(NamedTuple):
    """What lobes add in the directions of `spread` [Q,S,3], and the mean of its square over the sphere [Q,3]."""

    spread: Tensor
    mean_square: Tensor


def of_values(answer: Tensor, value: Tensor, loss: Loss, floor: float) -> Tensor:
    """Each query's loss [Q]: answers [Q,D,3] and values [Q,D,3], both over the output scale."""
    return torch.mean(torch.mean((answer - value) ** 2, dim=-1) * _weight(answer, loss, floor), dim=-1)


def of_exits(
    answer: Tensor, throughput: Tensor, spread: Tensor, loss: Loss, floor: float, lobes: SomeLobes | None = None
) -> Tensor:
    """Each query's loss [Q], whose expectation is the distance less a constant.

    answer [Q,P,3] in the directions of the exits of P walks, throughput [Q,P,3], and spread [Q,S,3], answers in S
    directions drawn uniformly; all over the output scale. Where narrow lobes are a part of the answers, their own
    square is put in exactly (loss l2): as S directions see it, it would be most of the noise.
    """
    squares = torch.mean(torch.mean(spread**2, dim=-1) * _weight(spread, loss, floor), dim=-1)
    if lobes is not None and loss == "l2":
        squares = squares + torch.mean(lobes.mean_square - torch.mean(lobes.spread**2, dim=1), dim=-1)
    carried = torch.mean(torch.mean(throughput * answer, dim=-1) * _weight(answer, loss, floor), dim=-1)
    return squares - (2.0 / _SPHERE) * carried


def _weight(answer: Tensor, loss: Loss, floor: float) -> Tensor:
    if loss == "l2":
        return torch.ones((), dtype=answer.dtype, device=answer.device)
    return 1.0 / (answer.detach().mean(dim=-1) ** 2 + floor)
