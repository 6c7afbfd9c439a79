"""The way that a ray of view takes inside an object, in the grid of signed distances that its network keeps.

In clear objects a ray that meets the boundary from inside, farther from its normal than the critical angle, is totally
reflected: what is seen there is the inside in a mirror. Rays that may turn are followed through such reflections; where
they leave, and in media that end them first, they run straight on.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from prt_bake.network.features.interior import REACH

Grid = Callable[[Tensor], Tensor]
"""Signed distances [N,K] to the object's boundary at points [N,K,3] over REACH spacings, in −1 … 1, positive inside."""

MIN_SLOPE = 0.05
"""Of the grid across two spacings, where 2/REACH is that of a distance: rounding alone has no direction."""
STEP, MIN_STEP, ENTRY_DEPTH = 0.9, 0.5, 0.25
"""How far a ray is followed at once, as a share of its distance to the boundary, and at least, in spacings; and how far
inside it must have been before it can meet the boundary again."""


@dataclass(frozen=True)
class Ray:
    """Pieces of a ray of view.

    Attributes:
        starts: [N,P,3].
        towards: [N,P,3], unit vectors away from the eye.
        begins: [N,P], the length of the ray at each start; infinite for pieces that are not there.
    """

    starts: Tensor
    towards: Tensor
    begins: Tensor

    @staticmethod
    def straight(x: Tensor, back: Tensor) -> "Ray":
        """From x [N,3] along −back [N,3]."""
        return Ray(x[:, None], -back[:, None], torch.zeros((len(x), 1), device=x.device))

    def along(self, lengths: Tensor) -> Tensor:
        """Unit vectors [N,K,3] along which the ray runs after lengths [N,K]."""
        piece = (lengths[..., None] >= self.begins[:, None, 1:]).sum(dim=-1)
        return self.towards.gather(1, piece[..., None].expand(-1, -1, 3))

    def points(self, lengths: Tensor) -> Tensor:
        """Where the ray is after lengths [N,K] or, the same for all, [K]: [N,K,3]."""
        if self.starts.shape[1] == 1:
            return self.starts + lengths[..., None] * self.towards
        lengths = lengths.expand(len(self.starts), -1)
        piece = (lengths[..., None] >= self.begins[:, None, 1:]).sum(dim=-1)
        which = piece[..., None].expand(-1, -1, 3)
        passed = lengths - self.begins.gather(1, piece)
        return self.starts.gather(1, which) + passed[..., None] * self.towards.gather(1, which)


def normals(grid: Grid, spacing: float, x: Tensor) -> Tensor:
    """Normals [N,3] of the grid at x [N,3], pointing out; unit vectors but where the distances hardly vary."""
    apart = spacing * torch.eye(3, device=x.device)
    slope = grid(x[:, None] - apart) - grid(x[:, None] + apart)
    return nn.functional.normalize(slope, dim=-1, eps=MIN_SLOPE)


def folded(grid: Grid, spacing: float, eta: float, turns: int, longest: float, x: Tensor, back: Tensor) -> Ray:
    """The rays from x [N,3] along −back [N,3], through at most `turns` total reflections within `longest`.

    eta: index of refraction inside relative to outside.
    """
    count = len(x)
    starts, towards = x[:, None].repeat(1, turns + 1, 1), -back[:, None].repeat(1, turns + 1, 1)
    begins = torch.full((count, turns + 1), torch.inf, device=x.device)
    begins[:, 0] = 0.0
    rows = torch.arange(count, device=x.device)
    piece = torch.zeros_like(rows)
    length, inside = torch.zeros_like(begins[:, 0]), torch.zeros_like(begins[:, 0])
    entered = torch.zeros_like(rows, dtype=torch.bool)
    followed = rows
    while len(followed):
        k = followed
        at, along, begun = starts[k, piece[k]], towards[k, piece[k]], begins[k, piece[k]]
        step = spacing * torch.clamp(STEP * inside[k], min=MIN_STEP)
        then = REACH * grid((at + (length[k] + step - begun)[:, None] * along)[:, None])[:, 0]
        met = entered[k] & (then <= 0.0)
        share = torch.where(met, inside[k] / (inside[k] - then).clamp(min=1e-6), 1.0)
        length[k] += share * step
        inside[k] = torch.where(met, 0.0, then)
        entered[k] |= then > ENTRY_DEPTH
        kept = length[k] < longest
        if bool(met.any()):
            there, along = at[met] + (length[k] - begun)[met, None] * along[met], along[met]
            normal = normals(grid, spacing, there)
            cosine = (along * normal).sum(dim=-1)
            turned = (cosine > 0.0) & (eta**2 * (1.0 - cosine**2) > 1.0) & (piece[k[met]] < turns)
            kept[met] &= turned
            j = k[met][turned]
            piece[j] += 1
            starts[j, piece[j]], begins[j, piece[j]] = there[turned], length[j]
            towards[j, piece[j]] = (along - 2.0 * cosine[:, None] * normal)[turned]
            entered[j] = False
        followed = k[kept]
    return Ray(starts, towards, begins)
