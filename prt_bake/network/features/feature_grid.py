"""Numbers that a network learns at places in its object, linear between them and averaged along the ray of view.

Fourier features say quickly what varies slowly; a detail (the border of two media, a thin part) is learnt through all
of the layers at once, and late. In a grid it is learnt where it lies, by the few numbers next to it. (Müller et al.
2022, Instant neural graphics primitives, hash theirs; here places that no ray of view comes near are not kept.)
"""

from collections.abc import Callable
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor, nn

from prt_bake.network.features.interior import LEVELS, REACH, Interior


class FeatureGrid(nn.Module):
    """`numbers` to learn at places 1/per_side apart in box sides: `rows` [1 + places, numbers], all 0 at first.

    The first row stands for what is not kept and stays 0.
    """

    row_index: Tensor
    corner: Tensor
    last: Tensor
    strides: Tensor
    around: Tensor

    def __init__(self, interior: Interior, per_side: int, numbers: int, reach: float) -> None:
        """reach: how deep in the object rays of view are followed, in box sides."""
        super().__init__()
        kept = kept_places(interior, per_side, reach)
        row_index = np.where(kept, np.cumsum(kept).reshape(kept.shape), 0)
        self.torch_only = False
        self.per_side = per_side
        self.register_buffer("row_index", torch.from_numpy(row_index.astype(np.int64)), persistent=False)
        self.register_buffer("corner", torch.tensor(interior.corner, dtype=torch.float32), persistent=False)
        _, ny, nz = row_index.shape
        self.register_buffer("last", torch.tensor(row_index.shape) - 1, persistent=False)
        self.register_buffer("strides", torch.tensor([ny * nz, nz, 1]), persistent=False)
        self.register_buffer("around", torch.tensor(list(np.ndindex(2, 2, 2))), persistent=False)
        self.rows = nn.Parameter(torch.zeros(1 + int(kept.sum()), numbers))

    def forward(self, points: Tensor, weights: Tensor) -> Tensor:
        """Sums [N,numbers] over points [N,K,3] in box sides, by weights [N,K]; float32."""
        if not self.torch_only and points.device.type == "cpu" and self.rows.dtype == torch.float32:
            return _compiled_sums(self, self.rows, points.contiguous(), weights.contiguous())
        with torch.no_grad():
            rows, shares = self._around(points)
            shares = (shares * weights[..., None]).flatten(1)
        with torch.autocast(points.device.type, enabled=False):
            summed: Tensor = nn.functional.embedding_bag(
                rows.flatten(1), self.rows, mode="sum", per_sample_weights=shares, padding_idx=0
            )
        return summed

    def _around(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """The rows of the eight places around points [N,K,8], and the shares that they have."""
        at = torch.minimum(((points - self.corner) * self.per_side).clamp(min=0.0), self.last.float())
        low = torch.minimum(at.long(), self.last - 1)
        upper = at - low
        flat = (low * self.strides).sum(dim=-1, keepdim=True) + (self.around * self.strides).sum(dim=-1)
        shares = torch.where(self.around == 1, upper[..., None, :], 1.0 - upper[..., None, :]).prod(dim=-1)
        return self.row_index.flatten()[flat], shares


class _Compiled(torch.autograd.Function):
    """The same sums by the compiled kernel; differentiable in the rows alone."""

    @staticmethod
    def forward(context: Any, grid: FeatureGrid, rows: Tensor, points: Tensor, weights: Tensor) -> Tensor:
        sums = torch.empty((len(points), rows.shape[1]))
        _visit(grid, rows, points, weights, sums, torch.empty((0, rows.shape[1])))
        context.grid = grid
        context.save_for_backward(points, weights)
        return sums

    @staticmethod
    def backward(context: Any, *derivatives: Tensor) -> tuple[None, Tensor, None, None]:
        points, weights = context.saved_tensors
        gradient = torch.zeros(context.grid.rows.shape)
        _visit(context.grid, gradient, points, weights, derivatives[0].float().contiguous(), gradient)
        return None, gradient, None, None


_compiled_sums = cast("Callable[[FeatureGrid, Tensor, Tensor, Tensor], Tensor]", _Compiled.apply)
"""Torch gives `apply` no types."""


def _visit(grid: FeatureGrid, rows: Tensor, points: Tensor, weights: Tensor, sums: Tensor, gradient: Tensor) -> None:
    from prt_bake.network.features.feature_kernel import sum_rows

    told = [tensor.detach().numpy() for tensor in (grid.corner, rows, points, weights, sums, gradient)]
    corner, values, at, shares, totals, slopes = told
    sum_rows(grid.row_index.numpy(), np.float32(grid.per_side), corner, values, at, shares, totals, slopes)


def kept_places(interior: Interior, per_side: int, reach: float) -> NDArray[np.bool_]:
    """Which places [X,Y,Z] of a grid, 1/per_side apart from the interior's corner, lie around what rays of view reach.

    The object is known at the interior's own places; a cell of the grid counts where one of them inside, or within a
    spacing of the boundary, lies in it, unless it is deeper than `reach`.
    """
    extent = interior.spacing * (np.array(interior.levels.shape[1:]) - 1)
    cells = np.maximum(1, np.ceil(extent * per_side - 1e-6).astype(np.int64))
    near = np.argwhere(interior.levels[0] > -LEVELS / REACH)
    met = np.zeros(cells, np.bool_)
    met[tuple(np.minimum((near * (interior.spacing * per_side)).astype(np.int64), cells - 1).T)] = True
    # The cells at the boundary have depth 1; what surrounds the grid is outside.
    depth = ndimage.distance_transform_edt(np.pad(met, 1))[1:-1, 1:-1, 1:-1]
    met &= (depth - 2.0) / per_side <= reach
    kept = np.zeros(cells + 1, np.bool_)
    for corner in np.ndindex(2, 2, 2):
        kept[tuple(slice(first, first + n) for first, n in zip(corner, cells, strict=True))] |= met
    return kept
