"""The path of a view ray inside an object, in the network's grid of signed distances.

In a clear object a ray that meets the boundary from inside, beyond the critical angle, is totally reflected: what is
seen there is a mirror image of the inside. Such rays are followed through their reflections. A ray that leaves goes
straight on, and so does a ray in a medium that absorbs it first.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from prt_bake.network.features.interior import REACH

Grid = Callable[[Tensor], Tensor]
"""Points [N,K,3] → signed distances [N,K] to the boundary over REACH spacings, in −1 … 1, positive inside."""

MIN_SLOPE = 0.05
"""Minimum slope of the grid across two spacings that gives a normal; that of a distance is 2/REACH."""
STEP, MIN_STEP, ENTRY_DEPTH = 0.9, 0.5, 0.25
"""Length of a step as a share of the distance to the boundary, its minimum in spacings, and the depth in spacings that
a ray must reach before it can meet the boundary again."""


@dataclass(frozen=True)
class Ray:
    """Straight segments of N view rays.

    Attributes:
        starts: [N,P,3].
        towards: [N,P,3], unit vectors away from the eye.
        begins: [N,P], the length of the ray at each start; infinite for segments that do not exist.
    """

    starts: Tensor
    towards: Tensor
    begins: Tensor

    @staticmethod
    def straight(x: Tensor, back: Tensor) -> "Ray":
        """From x [N,3] along −back [N,3]."""
        return Ray(x[:, None], -back[:, None], torch.zeros((len(x), 1), device=x.device))

    def along(self, lengths: Tensor) -> Tensor:
        """Directions [N,K,3] of the ray after lengths [N,K], unit vectors."""
        segment = (lengths[..., None] >= self.begins[:, None, 1:]).sum(dim=-1)
        return self.towards.gather(1, segment[..., None].expand(-1, -1, 3))

    def points(self, lengths: Tensor) -> Tensor:
        """Points [N,K,3] of the ray after lengths [N,K], or [K] for all rays."""
        if self.starts.shape[1] == 1:
            return self.starts + lengths[..., None] * self.towards
        lengths = lengths.expand(len(self.starts), -1)
        segment = (lengths[..., None] >= self.begins[:, None, 1:]).sum(dim=-1)
        index = segment[..., None].expand(-1, -1, 3)
        distance = lengths - self.begins.gather(1, segment)
        return self.starts.gather(1, index) + distance[..., None] * self.towards.gather(1, index)


def normals(grid: Grid, spacing: float, x: Tensor) -> Tensor:
    """Outward normals [N,3] of the grid at x [N,3]: unit vectors, shorter where the distances hardly vary."""
    offsets = spacing * torch.eye(3, device=x.device)
    slope = grid(x[:, None] - offsets) - grid(x[:, None] + offsets)
    return nn.functional.normalize(slope, dim=-1, eps=MIN_SLOPE)


def trace(grid: Grid, spacing: float, eta: float, reflections: int, longest: float, x: Tensor, back: Tensor) -> Ray:
    """The rays from x [N,3] along −back [N,3], through at most `reflections` total reflections within `longest`.

    eta: index of refraction inside relative to outside.
    """
    count = len(x)
    starts, towards = x[:, None].repeat(1, reflections + 1, 1), -back[:, None].repeat(1, reflections + 1, 1)
    begins = torch.full((count, reflections + 1), torch.inf, device=x.device)
    begins[:, 0] = 0.0
    rows = torch.arange(count, device=x.device)
    segment = torch.zeros_like(rows)
    length, inside = torch.zeros_like(begins[:, 0]), torch.zeros_like(begins[:, 0])
    entered = torch.zeros_like(rows, dtype=torch.bool)
    active = rows
    while len(active):
        k = active
        at, along, begin = starts[k, segment[k]], towards[k, segment[k]], begins[k, segment[k]]
        step = spacing * torch.clamp(STEP * inside[k], min=MIN_STEP)
        distance = REACH * grid((at + (length[k] + step - begin)[:, None] * along)[:, None])[:, 0]
        met = entered[k] & (distance <= 0.0)
        share = torch.where(met, inside[k] / (inside[k] - distance).clamp(min=1e-6), 1.0)
        length[k] += share * step
        inside[k] = torch.where(met, 0.0, distance)
        entered[k] |= distance > ENTRY_DEPTH
        kept = length[k] < longest
        if bool(met.any()):
            hit, along = at[met] + (length[k] - begin)[met, None] * along[met], along[met]
            normal = normals(grid, spacing, hit)
            cosine = (along * normal).sum(dim=-1)
            reflected = (cosine > 0.0) & (eta**2 * (1.0 - cosine**2) > 1.0) & (segment[k[met]] < reflections)
            kept[met] &= reflected
            j = k[met][reflected]
            segment[j] += 1
            starts[j, segment[j]], begins[j, segment[j]] = hit[reflected], length[j]
            towards[j, segment[j]] = (along - 2.0 * cosine[:, None] * normal)[reflected]
            entered[j] = False
        active = k[kept]
    return Ray(starts, towards, begins)


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
