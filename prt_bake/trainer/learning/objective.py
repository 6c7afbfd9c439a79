"""Losses of a batch: squared distance between the network f and Ŝ, from values or from exits of walks.

Both losses estimate the squared distance over all queries and directions, in units of the network's output scale. The
loss of values is the mean of (f − Ŝ)². The loss of exits uses that the exit of a walk with throughput T is a sample of
Ŝ, E[T · f(ω_exit)] = ∫ Ŝ f dω: up to the constant ∫ Ŝ² it is ∫ f² dω − 2 E[T · f(ω_exit)], with the first term
estimated in uniform directions. Divided by 4π, it is a mean over the sphere like the loss of values.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

_SPHERE = 4.0 * math.pi


class LobeTerms(NamedTuple):
    """Sum of the lobes in uniform directions [Q,S,3], and the exact mean of its square over the sphere [Q,3]."""

    uniform: Tensor
    mean_square: Tensor


def value_loss(predicted: Tensor, value: Tensor) -> Tensor:
    """Loss [Q] of each query from predictions [Q,D,3] and values [Q,D,3], both over the output scale."""
    return torch.mean((predicted - value) ** 2, dim=(1, 2))


def exit_loss(predicted: Tensor, throughput: Tensor, uniform: Tensor, lobes: LobeTerms | None = None) -> Tensor:
    """Loss [Q] of each query from the exits of P walks; its expectation is the squared distance less a constant.

    predicted [Q,P,3] are the network's values in the exits' directions, throughput [Q,P,3] the walks', uniform [Q,S,3]
    the network's values in S uniform directions, all over the output scale. With `lobes` the mean square of narrow
    lobes is exact: estimated from S directions it would be most of the loss's noise.
    """
    squares = torch.mean(uniform**2, dim=(1, 2))
    if lobes is not None:
        squares = squares + torch.mean(lobes.mean_square - torch.mean(lobes.uniform**2, dim=1), dim=-1)
    return squares - (2.0 / _SPHERE) * torch.mean(throughput * predicted, dim=(1, 2))


def low_loss(coefficients: Tensor, estimates: Tensor) -> Tensor:
    """Loss [Q] of coefficients [Q,K,3] from estimates [Q,K,3], each the mean T · Y_lm over a query's walks.

    It is the squared distance of the functions, as a mean over the sphere. Its expectation is the distance to the truth
    plus a constant, the walks' noise.
    """
    return torch.sum(torch.mean((coefficients - estimates) ** 2, dim=-1), dim=-1) / _SPHERE
