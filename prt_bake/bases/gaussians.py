"""Sums of spherical Gaussians fitted to single queries, beside harmonics.

A Gaussian is a exp(κ (ω·μ − 1)) with an RGB amplitude a, an axis μ and a sharpness κ. The best of a set of Gaussians is
added to those found before (matching pursuit). Axes and sharpness of all are then improved by steps of Levenberg and
Marquardt, with amplitudes by least squares in each (variable projection, Golub and Pereyra 1973, Kaufman's form).
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from prt_bake.mathematics import sh
from prt_bake.mathematics.directions import fibonacci

Array = NDArray[np.float64]

_AXES, _SHARPNESS = 256, (1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0, 256.0)
"""The Gaussians that the fit begins with."""
_LEAST, _MOST = math.log(0.3), math.log(3000.0)
_STEPS, _DAMPING = 4, 1e-2
_RIDGE = 1e-5
_AT_ONCE = 1 << 16
"""Directions of all queries that are fitted at once."""


class Gaussians(NamedTuple):
    """K Gaussians of each of N queries: unit axes [N,K,3], logarithms of the sharpness [N,K], amplitudes [N,K,3]."""

    axes: Tensor
    log_sharpness: Tensor
    amplitudes: Tensor


class GaussianFit:
    """Fits Gaussians to the residual of harmonics up to `degree`, over cells of the octahedron [M,3]."""

    def __init__(self, directions: Array, degree: int, most: int) -> None:
        """`most` Gaussians are fitted to every query; approximations use the first of them."""
        self._most = most
        self._fits: list[tuple[Array, list[Tensor]]] = []
        self._directions = torch.from_numpy(directions).float()
        self._harmonics: Tensor = torch.linalg.qr(torch.from_numpy(sh.evaluate(directions, degree)).float())[0]
        self._axes = torch.from_numpy(fibonacci(_AXES)).float().repeat(len(_SHARPNESS), 1)
        self._log_sharpness = torch.tensor(_SHARPNESS).log().repeat_interleave(_AXES)
        self._first = torch.nn.functional.normalize(_in_blocks(self._detail(self._axes, self._log_sharpness)), dim=-1)

    def of(self, count: int) -> Callable[[Array], Array]:
        """`approximate` with `count` Gaussians."""
        return lambda values: self.approximate(values, count)

    def approximate(self, values: Array, count: int) -> Array:
        """Approximate values [N,M,3] by the harmonics and `count` Gaussians for each query."""
        residual = next((residual for fitted, residual in self._fits if fitted is values), None)
        if residual is None:
            residual = self._residuals(torch.from_numpy(values).float())
            self._fits.append((values, residual))
        return np.asarray(values - residual[count - 1].double().numpy())

    def _residuals(self, target: Tensor) -> list[Tensor]:
        """The residuals [N,M,3] of 1, 2, … Gaussians; each is added to the improved ones before it."""
        detail = self._without_harmonics(target.transpose(1, 2)).transpose(1, 2)
        parts = []
        for rows in torch.split(detail, max(1, _AT_ONCE // detail.shape[1])):
            nothing = torch.zeros(len(rows), 0, 3)
            gaussians, residual, residuals = (
                Gaussians(nothing, torch.zeros(len(rows), 0), nothing),
                rows,
                list[Tensor](),
            )
            for _ in range(self._most):
                gaussians, residual = self._improved(self._with_best(gaussians, residual), rows)
                residuals.append(residual)
            parts.append(residuals)
        return [torch.cat(part) for part in zip(*parts, strict=True)]

    def _with_best(self, gaussians: Gaussians, residual: Tensor) -> Gaussians:
        """The Gaussians, and the best of the first ones for their residual."""
        blocks = _in_blocks(residual.transpose(1, 2)).transpose(1, 2)
        best = torch.matmul(self._first, blocks).square().sum(dim=2).argmax(dim=1)
        return Gaussians(
            torch.cat([gaussians.axes, self._axes[best, None]], dim=1),
            torch.cat([gaussians.log_sharpness, self._log_sharpness[best, None]], dim=1),
            gaussians.amplitudes,
        )

    def _improved(self, gaussians: Gaussians, detail: Tensor) -> tuple[Gaussians, Tensor]:
        """The Gaussians after a few steps, each kept where it lowers the residual, and their residual."""
        shapes, amplitudes, residual = self._solved(gaussians, detail)
        damping = torch.full((len(detail),), _DAMPING)
        for _ in range(_STEPS):
            gaussians = gaussians._replace(amplitudes=amplitudes)
            tried = self._stepped(gaussians, shapes, residual, damping)
            new = *tried[:2], *self._solved(tried, detail)
            better = new[-1].square().sum(dim=(1, 2)) < residual.square().sum(dim=(1, 2))
            damping = torch.where(better, 0.3 * damping, 5.0 * damping).clamp(1e-6, 1e4)
            axes, log_sharpness, shapes, amplitudes, residual = (
                torch.where(better.reshape(-1, *[1] * (found.ndim - 1)), found, before)
                for found, before in zip(new, (*gaussians[:2], shapes, amplitudes, residual), strict=True)
            )
            gaussians = Gaussians(axes, log_sharpness, amplitudes)
        return gaussians, residual

    def _solved(self, gaussians: Gaussians, detail: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Shapes [N,K,M] of the Gaussians beyond the harmonics, their best amplitudes, and the residual [N,M,3]."""
        shapes = self._detail(gaussians.axes, gaussians.log_sharpness)
        amplitudes = torch.linalg.solve(_products(shapes), shapes @ detail)
        return shapes, amplitudes, detail - shapes.transpose(1, 2) @ amplitudes

    def _stepped(self, gaussians: Gaussians, shapes: Tensor, residual: Tensor, damping: Tensor) -> Gaussians:
        """The Gaussians after a step of Gauss and Newton for the axes (two angles each) and log κ."""
        axes, log_sharpness, amplitudes = gaussians
        across = torch.where(axes[..., 2:].abs() < 0.9, torch.tensor([0.0, 0.0, 1.0]), torch.tensor([1.0, 0.0, 0.0]))
        first = torch.nn.functional.normalize(torch.linalg.cross(axes, across), dim=2)
        second = torch.linalg.cross(axes, first)
        sharpness = log_sharpness.exp()[..., None]
        cosines = axes @ self._directions.T - 1.0
        slopes = sharpness * torch.exp(sharpness * cosines)
        along = torch.stack([first @ self._directions.T, second @ self._directions.T, cosines], dim=2)
        changes = self._without_harmonics(slopes[:, :, None] * along).flatten(1, 2)  # [N,3K,M]
        changes = changes - (changes @ shapes.transpose(1, 2)) @ torch.linalg.solve(_products(shapes), shapes)
        weights = amplitudes.repeat_interleave(3, dim=1)
        normal = (changes @ changes.transpose(1, 2)) * (weights @ weights.transpose(1, 2))
        gradient = ((changes @ residual) * weights).sum(dim=2)
        size = torch.diagonal(normal, dim1=1, dim2=2)
        normal = normal + torch.diag_embed(damping[:, None] * size + 1e-6 * size.amax(dim=1, keepdim=True) + 1e-30)
        step = torch.linalg.solve(normal, gradient).reshape(len(normal), -1, 3)
        turn = step[..., :2].clamp(-0.5, 0.5)
        return Gaussians(
            torch.nn.functional.normalize(axes + turn[..., :1] * first + turn[..., 1:] * second, dim=2),
            (log_sharpness + step[..., 2].clamp(-1.0, 1.0)).clamp(_LEAST, _MOST),
            amplitudes,
        )

    def _detail(self, axes: Tensor, log_sharpness: Tensor) -> Tensor:
        return self._without_harmonics(torch.exp(log_sharpness.exp()[..., None] * (axes @ self._directions.T - 1.0)))

    def _without_harmonics(self, rows: Tensor) -> Tensor:
        return rows - (rows @ self._harmonics) @ self._harmonics.T


def _in_blocks(rows: Tensor) -> Tensor:
    """Means [...,M/4] of rows [...,M] over two by two cells, which are enough to choose the first Gaussians."""
    half = math.isqrt(rows.shape[-1]) // 2
    blocks: Tensor = rows.reshape(*rows.shape[:-1], half, 2, half, 2).mean(dim=(-3, -1)).flatten(-2)
    return blocks


def _products(shapes: Tensor) -> Tensor:
    """Inner products [N,K,K] of shapes [N,K,M], with a ridge."""
    products = shapes @ shapes.transpose(1, 2)
    size = torch.diagonal(products, dim1=1, dim2=2).mean(dim=1)
    return products + (_RIDGE * size + 1e-30)[:, None, None] * torch.eye(shapes.shape[1])
