"""The object's occupancy along the ray to the light: fine near the start, coarser farther away.

Whether light from ωi reaches a point, and what it crosses, depends on the point and on ωi together. From separate
features of both, layers learn the shadows that an object casts on itself last, and blurred. Here the late layers see
what a cone towards the light meets at a few samples, in a pyramid of grids of the object, each half as fine as the one
before: Crassin et al. 2011, "Interactive indirect illumination using voxel cone tracing", section 4.
"""

import math
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from prt_bake.network.features.interior import Interior

FIRST_DISTANCE, DISTANCE_RATIO = 0.04, 1.6
"""Distance of the first sample in box sides, and ratio of each distance to the one before."""
_CONE_OPENING = 0.2
"""Spacing of the grid of a sample over its distance."""
OCCUPANCY_SCALE = 5.0
"""Scale of the occupancy among features with a mean square of ½."""


class Level(NamedTuple):
    """A grid [X,Y,Z] of the object's occupancy in [0, 1]; its nodes are `spacing` apart, the first is at `corner`."""

    grid: Tensor
    corner: NDArray[np.float32]
    spacing: float


class LightRay(nn.Module):
    """Occupancy along rays towards the light; compiled on the CPU unless `torch_only` is set."""

    def __init__(self, interior: Interior, samples: int, with_bodies: bool = False) -> None:
        """`samples` is the number of samples on each ray; with_bodies: `Interior.occupancy`."""
        super().__init__()
        self.torch_only = False
        self.distances = [FIRST_DISTANCE * DISTANCE_RATIO**sample for sample in range(samples)]
        levels = [math.log2(max(_CONE_OPENING * distance / interior.spacing, 1.0)) for distance in self.distances]
        self.level_at = [round(level) for level in levels]
        corner, spacing = np.array(interior.corner), interior.spacing
        grid = _with_empty_border(interior.occupancy(with_bodies))
        self._corners, self._spacings = [], []
        for level in range(max(self.level_at, default=0) + 1):
            if level:
                corner, spacing, grid = corner - 0.5 * spacing, 2.0 * spacing, _downsampled(grid)
            self.register_buffer(f"grid{level}", grid, persistent=False)
            self._corners.append(corner.astype(np.float32))
            self._spacings.append(spacing)
            scale = (2.0 / spacing) / (np.array(grid.shape) - 1.0)
            self.register_buffer(f"corner{level}", torch.from_numpy(self._corners[-1]), persistent=False)
            self.register_buffer(f"scale{level}", torch.from_numpy(scale.astype(np.float32)), persistent=False)

    def forward(self, origins: Tensor, incident: Tensor) -> Tensor:
        """Scaled occupancies [N,D,S·samples] in float32, those of the first origin first.

        origins [N,S,3] are in box sides from the box's corner, incident [N,D,3] unit vectors.
        """
        origins, incident = origins.float().contiguous(), incident.float().contiguous()
        with torch.no_grad(), torch.autocast(origins.device.type, enabled=False):
            if self.torch_only or origins.device.type != "cpu":
                occupancy = self._by_torch(origins, incident)
            else:
                occupancy = self._compiled(origins, incident)
            return occupancy.mul_(OCCUPANCY_SCALE).flatten(2)

    def pyramid(self) -> list[Level]:
        """The grids, the finest first."""
        geometry = zip(self._corners, self._spacings, strict=True)
        return [Level(self.get_buffer(f"grid{level}"), *where) for level, where in enumerate(geometry)]

    def _compiled(self, origins: Tensor, incident: Tensor) -> Tensor:
        from prt_bake.network.features.light_kernel import occupancy_along

        occupancy = torch.empty((*incident.shape[:2], origins.shape[1], len(self.distances)))
        rays, distances = (origins.numpy(), incident.numpy()), np.array(self.distances, np.float32)
        levels = np.array(self.level_at)
        for number, level in enumerate(self.pyramid()):
            samples = np.flatnonzero(levels == number)
            if len(samples):
                per_length = np.float32(1.0 / level.spacing)
                grid = level.grid.numpy()
                occupancy_along(grid, per_length, level.corner, *rays, distances, samples, occupancy.numpy())
        return occupancy

    def _by_torch(self, origins: Tensor, incident: Tensor) -> Tensor:
        occupancy, pyramid = [], self.pyramid()
        for distance, number in zip(self.distances, self.level_at, strict=True):
            level = pyramid[number]
            points = origins[:, None] + distance * incident[:, :, None]
            at = (points - self.get_buffer(f"corner{number}")) * self.get_buffer(f"scale{number}") - 1.0
            # grid_sample counts axes from the last one.
            rows = nn.functional.grid_sample(level.grid[None, None], at.flip(-1)[None], align_corners=True)
            occupancy.append(rows[0, 0])
        return torch.stack(occupancy, dim=-1)


def _with_empty_border(grid: Tensor) -> Tensor:
    grid[[0, -1]], grid[:, [0, -1]], grid[:, :, [0, -1]] = 0.0, 0.0, 0.0
    return grid


def _downsampled(grid: Tensor) -> Tensor:
    """Means of 2×2×2 nodes, with an empty border; the first node is half a spacing before that of `grid`."""
    padding = [length for places in reversed(grid.shape) for length in (1, 2 if places % 2 else 1)]
    means: Tensor = nn.functional.avg_pool3d(nn.functional.pad(grid, padding)[None], 2)[0]
    return means.contiguous()
