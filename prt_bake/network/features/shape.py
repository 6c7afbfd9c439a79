"""How much of an object lies around a place, and on which side of it: the object, shape_grid at several scales.

Light reaches a place inside from all that lies within some mean free paths: how thick the object is there, how its
boundary curves, and which side is nearest decide how much and whence. ViewEncoding of that, a network need not learn it again
for every place that is like another. (Vicini, Koltun and Jakob 2019 tell theirs a polynomial fitted to the boundary.)
"""

import math

import numpy as np
import torch
from torch import Tensor

from prt_bake.network.features.interior import LEVELS, REACH, Interior
from prt_bake.network.settings import SHAPE_SCALES

_FARTHEST = 3.5
"""Standard deviations, where Gaussians are cut off."""
_OCCUPANCY_SCALE, SLOPE_SCALE = 5.0, 7.0
"""Of the share less ½ and of its slope over a standard deviation, among features whose mean square is ½: at a flat wall
the slope is MAX_SLOPE long."""
MAX_SLOPE = 0.4


def shape_grid(interior: Interior) -> Tensor:
    """What is told of each place of the interior's grid: float32 [X,Y,Z,SHAPE_INPUTS], at each scale how much of the
    surroundings is inside, and its slope.
    """
    solid = torch.from_numpy(interior.levels[0].astype(np.float32) * (REACH / LEVELS) + 0.5).clamp_(0.0, 1.0)
    told = []
    for scale in SHAPE_SCALES:
        sigma = scale / interior.spacing
        blur = [_gaussian(sigma, places) for places in solid.shape]
        slope = [_slope(sigma, places) for places in solid.shape]
        slopes = [_along_each(solid, [*blur[:axis], slope[axis], *blur[axis + 1 :]]) for axis in range(3)]
        told += [_OCCUPANCY_SCALE * (_along_each(solid, blur) - 0.5), *(SLOPE_SCALE * part for part in slopes)]
    return torch.stack(told, dim=-1)


def trilinear(told: Tensor, spacing: float, points: Tensor) -> Tensor:
    """What a grid [X,Y,Z,C], as `shape_grid` makes it, tells at points [...,3] from its corner, linear between places:
    [...,C]; outside, what the border has.
    """
    # The sampler counts its axes from the last one.
    axes = zip(points.unbind(dim=-1), told.shape[:3], strict=True)
    at = torch.stack([along * (2.0 / (spacing * (places - 1))) - 1.0 for along, places in axes][::-1], dim=-1)
    found = torch.nn.functional.grid_sample(
        told.movedim(-1, 0)[None], at.reshape(1, -1, 1, 1, 3), padding_mode="border", align_corners=True
    )
    return found[0, :, :, 0, 0].T.reshape(*points.shape[:-1], told.shape[3])


def _gaussian(sigma: float, places: int, shift: int = 0) -> Tensor:
    """A line's places, or those `shift` behind them, as Gaussian means of the line [places,places]; nothing lies
    beyond its ends.
    """
    reach = math.ceil(_FARTHEST * sigma)
    whole = float(torch.exp(-0.5 * (torch.arange(-reach, reach + 1) / sigma) ** 2).sum())
    at = torch.arange(places)
    apart = at[:, None] + shift - at
    weights = torch.exp(-0.5 * (apart / sigma) ** 2) / whole
    return torch.where(apart.abs() <= reach, weights, 0.0)


def _slope(sigma: float, places: int) -> Tensor:
    """The same means' central differences over a standard deviation."""
    return 0.5 * sigma * (_gaussian(sigma, places, 1) - _gaussian(sigma, places, -1))


def _along_each(grid: Tensor, lines: list[Tensor]) -> Tensor:
    """A grid [X,Y,Z] with a matrix applied along each axis."""
    for axis, line in enumerate(lines):
        grid = torch.tensordot(line, grid, dims=([1], [axis])).movedim(0, axis)
    return grid
