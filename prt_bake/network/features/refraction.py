"""Refraction of view rays at the boundary, and normals from the network's grid of signed distances."""

from collections.abc import Callable

import torch
from torch import Tensor, nn

Grid = Callable[[Tensor], Tensor]
"""Points [N,K,3] → signed distances [N,K] to the boundary over REACH spacings, in −1 … 1, positive inside."""

MIN_SLOPE = 0.05
"""Minimum slope of the grid across two spacings that gives a normal; that of a distance is 2/REACH."""


def normals(grid: Grid, spacing: float, x: Tensor) -> Tensor:
    """Outward normals [N,3] of the grid at x [N,3]: unit vectors, shorter where the distances hardly vary."""
    offsets = spacing * torch.eye(3, device=x.device)
    slope = grid(x[:, None] - offsets) - grid(x[:, None] + offsets)
    return nn.functional.normalize(slope, dim=-1, eps=MIN_SLOPE)


def refracted_in(eye: Tensor, normal: Tensor, cosine: Tensor, eta: float) -> Tensor:
    """Directions [N,3] inside of light that leaves along `eye` [N,3], by Snell's law; unit vectors.

    `cosine` [N,1] is that of `eye` and the normal.
    """
    ratio = 1.0 / eta
    inner = (1.0 - ratio**2 * (1.0 - cosine**2)).clamp(min=0.0).sqrt()
    return nn.functional.normalize(ratio * eye + (inner - ratio * cosine) * normal, dim=-1)


def refracted_out(ahead: Tensor, normal: Tensor, eta: float) -> Tensor:
    """Directions [N,3] outside of rays that leave along `ahead` [N,3], by Snell's law; unit vectors.

    They go straight on where they are totally reflected, or where the normal is 0.
    """
    cosine = (ahead * normal).sum(-1, keepdim=True)
    squared = 1.0 - eta**2 * (1.0 - cosine**2)
    refracted = eta * ahead + (squared.clamp(min=0.0).sqrt() - eta * cosine) * normal
    leaves = (squared > 0.0) & (cosine > 0.0) & normal.any(dim=-1, keepdim=True)
    return nn.functional.normalize(torch.where(leaves, refracted, ahead), dim=-1)
