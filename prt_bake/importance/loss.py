"""KL divergence and variance of lobes with respect to their targets, in torch, differentiable.

The density is that of `prt_bake.mathematics.lobe` in float32, with wraps and uniform share.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from prt_bake.importance.module import ImportanceModule
from prt_bake.importance.targets import Targets
from prt_bake.mathematics import lobe

TAIL = 1e-7
"""The share of a lobe in wraps that are left out, below float32's rounding."""
_NEAR_AXIS = 1.0 - 1e-6
"""Cosines are clamped to this, because the arc cosine has no derivative at ±1."""
ROWS_PER_BATCH = 256


@dataclass(frozen=True)
class TargetTensors:
    """`Targets` on the device of the fit."""

    positions: Tensor
    outgoing: Tensor
    normals: Tensor
    turn: Tensor
    directions: Tensor
    share: Tensor

    @staticmethod
    def of(targets: Targets, device: str = "cpu") -> "TargetTensors":
        """A copy on `device`: positions in float64, the rest in float32."""
        keep = {"positions": torch.float64, "turn": torch.int64}
        return TargetTensors(
            **{
                name: torch.as_tensor(np.ascontiguousarray(rows)).to(device, keep.get(name, torch.float32))
                for name, rows in vars(targets).items()
            }
        )

    def first(self, count: int) -> "TargetTensors":
        """The first `count` queries."""
        rows = {name: tensor if name == "directions" else tensor[:count] for name, tensor in vars(self).items()}
        return TargetTensors(**rows)

    def __len__(self) -> int:
        return len(self.turn)


@dataclass(frozen=True)
class Fitness:
    """Means over queries: KL divergence [nats], and relative variance of one sample under a uniform environment."""

    divergence: float
    variance: float


def density(module: ImportanceModule, targets: TargetTensors, rows: Tensor, bins: slice = slice(None)) -> Tensor:
    """The module's density per steradian [n,D] at the directions `bins` of the queries `rows`."""
    sigma, tilts, weights = module(targets.positions[rows], targets.outgoing[rows])
    axes = torch.nn.functional.normalize(targets.normals[rows, None, :] + tilts, dim=2)
    cosines = targets.directions[targets.turn[rows], bins] @ axes.transpose(1, 2)
    settings = module.settings
    lobes = (weights[:, None, :] * wrapped(sigma[:, None, :], settings.shape, cosines)).sum(dim=2)
    total: Tensor = (1.0 - settings.uniform_share) * lobes + settings.uniform_share / (4.0 * math.pi)
    return total


def wrapped(sigma: Tensor, shape: float, cosines: Tensor) -> Tensor:
    """Density per steradian of `prt_bake.mathematics.lobe` without its uniform share; arguments broadcast."""
    c = cosines.clamp(-_NEAR_AXIS, _NEAR_AXIS)
    theta, sine = torch.arccos(c), torch.sqrt((1.0 - c) * (1.0 + c))
    width = sigma * lobe.width_per_sigma(shape)
    total = theta * torch.exp(-((theta / width) ** shape))
    farthest, turn = float(width.detach().max()) * lobe.reach(shape, TAIL), 2.0 * math.pi
    while farthest > turn - math.pi:
        for angle in (turn - theta, turn + theta):
            total = total + angle * torch.exp(-((angle / width) ** shape))
        turn += 2.0 * math.pi
    return lobe.normalisation(shape) * total / (width * width * sine)


def divergence(share: Tensor, pdf: Tensor) -> Tensor:
    """KL divergence [n] in nats from the shares [n,D] of D bins of 4π/D sr to `pdf` [n,D] per steradian."""
    expected = pdf * (4.0 * math.pi / share.shape[1])
    return torch.xlogy(share, share).sum(dim=1) - (share * torch.log(expected)).sum(dim=1)


def variance(share: Tensor, pdf: Tensor) -> Tensor:
    """Relative variance [n] of f/pdf under a uniform environment, for f with the shares [n,D]."""
    expected = pdf * (4.0 * math.pi / share.shape[1])
    return (share * share / expected).sum(dim=1) - 1.0


def assess(module: ImportanceModule, targets: TargetTensors) -> Fitness:
    """The module's divergence and variance, means over all targets."""
    sums = torch.zeros(2, dtype=torch.float64)
    with torch.inference_mode():
        for rows in torch.split(torch.arange(len(targets), device=targets.turn.device), ROWS_PER_BATCH):
            share, pdf = targets.share[rows], density(module, targets, rows)
            sums += torch.stack([divergence(share, pdf).sum(), variance(share, pdf).sum()]).double().cpu()
    return Fitness(*(sums / len(targets)).tolist())


def assess_constant(sigma: float, shape: float, share: float, targets: TargetTensors) -> Fitness:
    """As `assess`, for one lobe about the normal with one σ for the object."""
    sums = torch.zeros(2, dtype=torch.float64)
    with torch.inference_mode():
        for rows in torch.split(torch.arange(len(targets), device=targets.turn.device), ROWS_PER_BATCH):
            cosines = (targets.directions[targets.turn[rows]] @ targets.normals[rows, :, None])[..., 0]
            width = torch.full_like(cosines[:, :1], sigma)
            pdf = (1.0 - share) * wrapped(width, shape, cosines) + share / (4.0 * math.pi)
            target = targets.share[rows]
            sums += torch.stack([divergence(target, pdf).sum(), variance(target, pdf).sum()]).double().cpu()
    return Fitness(*(sums / len(targets)).tolist())


def uniform_fitness(targets: TargetTensors) -> Fitness:
    """As `assess`, for uniform directions."""
    pdf = torch.full((1, 1), 1.0 / (4.0 * math.pi), device=targets.share.device)
    return Fitness(float(divergence(targets.share, pdf).mean()), float(variance(targets.share, pdf).mean()))
