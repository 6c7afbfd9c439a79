"""A grid of learned features in the object, interpolated trilinearly and averaged along the view ray.

A network with Fourier features learns what varies slowly first. A detail (the border of two media, a thin part) changes
all weights, and is learned late. In a grid it is learned by the few features next to it. (Müller et al. 2022, Instant
neural graphics primitives, use a hash table; here nodes that no view ray comes near are not stored.)
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
    """Learned features at nodes 1/per_side box sides apart: `rows` [1 + nodes, numbers], initially 0.

    The first row represents all nodes that are not stored, and stays 0.
    """

    row_index: Tensor
    corner: Tensor
    last: Tensor
    strides: Tensor
    offsets: Tensor

    def __init__(self, interior: Interior, per_side: int, numbers: int, reach: float) -> None:
        """reach: length of the view rays in box sides."""
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
        self.register_buffer("offsets", torch.tensor(list(np.ndindex(2, 2, 2))), persistent=False)
        self.rows = nn.Parameter(torch.zeros(1 + int(kept.sum()), numbers))

    def forward(self, points: Tensor, weights: Tensor) -> Tensor:
        """Sums [N,numbers] of the features at points [N,K,3] in box sides, with weights [N,K]; float32."""
        if not self.torch_only and points.device.type == "cpu" and self.rows.dtype == torch.float32:
            return _compiled_sums(self, self.rows, points.contiguous(), weights.contiguous())
        with torch.no_grad():
            rows, shares = self._neighbours(points)
            shares = (shares * weights[..., None]).flatten(1)
        with torch.autocast(points.device.type, enabled=False):
            summed: Tensor = nn.functional.embedding_bag(
                rows.flatten(1), self.rows, mode="sum", per_sample_weights=shares, padding_idx=0
            )
        return summed

    def _neighbours(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """The rows of the eight nodes around points [N,K,8], and their trilinear weights."""
        at = torch.minimum(((points - self.corner) * self.per_side).clamp(min=0.0), self.last.float())
        low = torch.minimum(at.long(), self.last - 1)
        upper = at - low
        flat = (low * self.strides).sum(dim=-1, keepdim=True) + (self.offsets * self.strides).sum(dim=-1)
        shares = torch.where(self.offsets == 1, upper[..., None, :], 1.0 - upper[..., None, :]).prod(dim=-1)
        return self.row_index.flatten()[flat], shares


class _Compiled(torch.autograd.Function):
    """The sums by the compiled kernel; differentiable in the rows only."""

    @staticmethod
    def forward(context: Any, grid: FeatureGrid, rows: Tensor, points: Tensor, weights: Tensor) -> Tensor:
        sums = torch.empty((len(points), rows.shape[1]))
        _call_kernel(grid, rows, points, weights, sums, torch.empty((0, rows.shape[1])))
        context.grid = grid
        context.save_for_backward(points, weights)
        return sums

    @staticmethod
    def backward(context: Any, *derivatives: Tensor) -> tuple[None, Tensor, None, None]:
        points, weights = context.saved_tensors
        gradient = torch.zeros(context.grid.rows.shape)
        _call_kernel(context.grid, gradient, points, weights, derivatives[0].float().contiguous(), gradient)
        return None, gradient, None, None


_compiled_sums = cast("Callable[[FeatureGrid, Tensor, Tensor, Tensor], Tensor]", _Compiled.apply)
"""Torch has no type annotations for `apply`."""


def _call_kernel(
    grid: FeatureGrid, rows: Tensor, points: Tensor, weights: Tensor, sums: Tensor, gradient: Tensor
) -> None:
    from prt_bake.network.features.feature_kernel import sum_rows

    corner, *arrays = [tensor.detach().numpy() for tensor in (grid.corner, rows, points, weights, sums, gradient)]
    sum_rows(grid.row_index.numpy(), np.float32(grid.per_side), corner, *arrays)


def kept_places(interior: Interior, per_side: int, reach: float) -> NDArray[np.bool_]:
    """Mask [X,Y,Z] of the nodes, 1/per_side apart from the interior's corner, around cells that view rays reach.

    A cell counts if it contains a node of the interior's grid that is inside, or within a spacing of the boundary,
    unless the cell is deeper than `reach`.
    """
    extent = interior.spacing * (np.array(interior.levels.shape[1:]) - 1)
    cells = np.maximum(1, np.ceil(extent * per_side - 1e-6).astype(np.int64))
    near = np.argwhere(interior.levels[0] > -LEVELS / REACH)
    reached = np.zeros(cells, np.bool_)
    reached[tuple(np.minimum((near * (interior.spacing * per_side)).astype(np.int64), cells - 1).T)] = True
    # Cells at the boundary have depth 1; everything around the grid is outside.
    depth = ndimage.distance_transform_edt(np.pad(reached, 1))[1:-1, 1:-1, 1:-1]
    reached &= (depth - 2.0) / per_side <= reach
    kept = np.zeros(cells + 1, np.bool_)
    for corner in np.ndindex(2, 2, 2):
        kept[tuple(slice(first, first + n) for first, n in zip(corner, cells, strict=True))] |= reached
    return kept
