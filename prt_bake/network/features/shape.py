"""The object's shape around a point: its occupancy, blurred at several scales, and the slopes of that.

Light reaches a point inside from everything within some mean free paths: how much and from where depends on the
thickness of the object there, the curvature of its boundary, and the nearest side. With these as inputs a network does
not have to learn them again at every similar point. (Vicini, Koltun and Jakob 2019 use a polynomial fitted to the
boundary.)
"""

import math

import torch
from torch import Tensor

from prt_bake.network.features.interior import Interior
from prt_bake.network.settings import SHAPE_SCALES

_CUTOFF = 3.5
"""Radius of the Gaussians in standard deviations."""
_OCCUPANCY_SCALE, SLOPE_SCALE = 5.0, 7.0
"""Scales of the occupancy less ½ and of its slope per standard deviation, among features with a mean square of ½."""
MAX_SLOPE = 0.4
"""The slope at a flat wall."""


def shape_grid(interior: Interior, with_bodies: bool = False) -> Tensor:
    """The shape features at the nodes of the interior's grid: float32 [X,Y,Z,SHAPE_INPUTS].

    They are the blurred occupancy (with_bodies: `Interior.occupancy`) and its slope along each axis, scale by scale.
    """
    occupancy = interior.occupancy(with_bodies)
    features = []
    for scale in SHAPE_SCALES:
        sigma = scale / interior.spacing
        blur = [_gaussian(sigma, nodes) for nodes in occupancy.shape]
        slope = [_slope(sigma, nodes) for nodes in occupancy.shape]
        slopes = [_filtered(occupancy, [*blur[:axis], slope[axis], *blur[axis + 1 :]]) for axis in range(3)]
        features += [_OCCUPANCY_SCALE * (_filtered(occupancy, blur) - 0.5), *(SLOPE_SCALE * part for part in slopes)]
    return torch.stack(features, dim=-1)


def trilinear(grid: Tensor, spacing: float, points: Tensor) -> Tensor:
    """Trilinear values [...,C] of a grid [X,Y,Z,C] at points [...,3] from its first node, clamped to its border."""
    # grid_sample counts axes from the last one.
    axes = zip(points.unbind(dim=-1), grid.shape[:3], strict=True)
    at = torch.stack([along * (2.0 / (spacing * (nodes - 1))) - 1.0 for along, nodes in axes][::-1], dim=-1)
    values = torch.nn.functional.grid_sample(
        grid.movedim(-1, 0)[None], at.reshape(1, -1, 1, 1, 3), padding_mode="border", align_corners=True
    )
    return values[0, :, :, 0, 0].T.reshape(*points.shape[:-1], grid.shape[3])


def _gaussian(sigma: float, nodes: int, shift: int = 0) -> Tensor:
    """The matrix [nodes,nodes] of a Gaussian blur along a line, shifted by `shift` nodes; 0 beyond its ends."""
    radius = math.ceil(_CUTOFF * sigma)
    total = float(torch.exp(-0.5 * (torch.arange(-radius, radius + 1) / sigma) ** 2).sum())
    at = torch.arange(nodes)
    distance = at[:, None] + shift - at
    weights = torch.exp(-0.5 * (distance / sigma) ** 2) / total
    return torch.where(distance.abs() <= radius, weights, 0.0)


def _slope(sigma: float, nodes: int) -> Tensor:
    """The matrix of the blur's central differences over a standard deviation."""
    return 0.5 * sigma * (_gaussian(sigma, nodes, 1) - _gaussian(sigma, nodes, -1))


def _filtered(grid: Tensor, matrices: list[Tensor]) -> Tensor:
    """A grid [X,Y,Z] with a matrix applied along each axis."""
    for axis, matrix in enumerate(matrices):
        grid = torch.tensordot(matrix, grid, dims=([1], [axis])).movedim(0, axis)
    return grid
