"""How much of an object lies on the way to the light: near and finely told, farther away more coarsely.

Whether ωi reaches a place, or what it has to cross on its way there, depends on the place and on ωi together: told of
one after the other, layers learn the shadows that an object casts on itself last, and shape_grid. Here they are told what
a cone towards the light meets, at a few places along it, in a pyramid of grids of the object each half as fine as the
one before: Crassin et al. 2011, "Interactive indirect illumination using voxel cone tracing", section 4.
"""

import math
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from prt_bake.network.features.interior import LEVELS, REACH, Interior

FIRST_DISTANCE, DISTANCE_RATIO = 0.04, 1.6
"""How far away the first place is, in box sides, and how many times as far each next one."""
_OPENING = 0.2
"""Of the cones: the spacing of the grid that a place is looked up in over its distance."""
OCCUPANCY_SCALE = 5.0
"""Of the share that is inside, among features whose mean square is ½."""


class Level(NamedTuple):
    """How much of the object lies around places `spacing` apart, the first of them at `corner`: grid [X,Y,Z]."""

    grid: Tensor
    corner: NDArray[np.float32]
    spacing: float


class LightRay(nn.Module):
    """What lies on the way to the light from `starts` of a view; on a CPU compiled, unless `torch_only`."""

    def __init__(self, interior: Interior, places: int) -> None:
        """`places` on each ray."""
        super().__init__()
        self.torch_only = False
        self.distances = [FIRST_DISTANCE * DISTANCE_RATIO**place for place in range(places)]
        wanted = [math.log2(max(_OPENING * distance / interior.spacing, 1.0)) for distance in self.distances]
        self.level_at = [round(level) for level in wanted]
        corner, spacing, grid = np.array(interior.corner), interior.spacing, _solid(interior)
        self._corners, self._spacings = [], []
        for level in range(max(self.level_at, default=0) + 1):
            if level:
                corner, spacing, grid = corner - 0.5 * spacing, 2.0 * spacing, _half_as_fine(grid)
            self.register_buffer(f"grid{level}", grid, persistent=False)
            self._corners.append(corner.astype(np.float32))
            self._spacings.append(spacing)

    def forward(self, starts: Tensor, incident: Tensor) -> Tensor:
        """Shares [N,D,S·places] in float32, the first start's first: starts [N,S,3] in the box's sides from its corner,
        unit vectors incident [N,D,3].
        """
        starts, incident = starts.float().contiguous(), incident.float().contiguous()
        shape = (*incident.shape[:2], starts.shape[1], len(self.distances))
        with torch.no_grad(), torch.autocast(starts.device.type, enabled=False):
            if self.torch_only or starts.device.type != "cpu":
                shares = self._looked_up(starts, incident)
            else:
                shares = torch.empty(shape)
                self._look(starts, incident, shares)
            return shares.mul_(OCCUPANCY_SCALE).flatten(2)

    def pyramid(self) -> list[Level]:
        """Its grids, the finest first."""
        each = zip(self._corners, self._spacings, strict=True)
        return [Level(self.get_buffer(f"grid{level}"), *where) for level, where in enumerate(each)]

    def _look(self, starts: Tensor, incident: Tensor, shares: Tensor) -> None:
        from prt_bake.network.features.light_kernel import shares_along

        told = starts.numpy(), incident.numpy(), np.array(self.distances, np.float32), shares.numpy()
        levels = np.array(self.level_at)
        for number, level in enumerate(self.pyramid()):
            places = np.flatnonzero(levels == number)
            if len(places):
                per_length = np.float32(1.0 / level.spacing)
                shares_along(level.grid.numpy(), per_length, level.corner, *told[:3], places, told[3])

    def _looked_up(self, starts: Tensor, incident: Tensor) -> Tensor:
        found, pyramid = [], self.pyramid()
        for distance, number in zip(self.distances, self.level_at, strict=True):
            level = pyramid[number]
            last = torch.tensor(level.grid.shape, device=level.grid.device, dtype=torch.float32) - 1.0
            corner = torch.from_numpy(level.corner).to(level.grid.device)
            points = starts[:, None] + distance * incident[:, :, None]
            at = (points - corner) * (2.0 / level.spacing) / last - 1.0
            # The sampler counts its axes from the last one.
            rows = nn.functional.grid_sample(level.grid[None, None], at.flip(-1)[None], align_corners=True)
            found.append(rows[0, 0])
        return torch.stack(found, dim=-1)


def _solid(interior: Interior) -> Tensor:
    """How much of the object lies around each place of its grid, and nothing around it."""
    share = torch.from_numpy(interior.levels[0].astype(np.float32) * (REACH / LEVELS) + 0.5).clamp_(0.0, 1.0)
    share[[0, -1]], share[:, [0, -1]], share[:, :, [0, -1]] = 0.0, 0.0, 0.0
    return share


def _half_as_fine(grid: Tensor) -> Tensor:
    """Means of eight places each, with nothing around them again; the first lies half a spacing before the first."""
    room = [length for places in reversed(grid.shape) for length in (1, 2 if places % 2 else 1)]
    means: Tensor = nn.functional.avg_pool3d(nn.functional.pad(grid, room)[None], 2)[0]
    return means.contiguous()
