"""How the errors of a vertex's coefficients hang together: covariance over harmonics, and the share of each channel.

Directions miss narrow detail, and what they miss weighs in every harmonic as that harmonic is in the direction of the
detail. So errors hang together: on a trained network 89 % of the variance at a bin lies along one line among nine
harmonics, 59 % at a vertex over all its bins, and the three channels err alike. What such an error makes of a picture
is up to the light, by a factor of three either way; one sigma of all coefficients cannot tell.

Where every bin was evaluated twice, or differs from its neighbours by noise alone, the differences are errors
themselves. Elsewhere what a fit leaves over stands for them: with residuals r the covariance of a fit with weights W is
W diag(r²) Wᵀ (White, "A heteroskedasticity-consistent covariance matrix estimator", Econometrica 1980). Only the shape
is taken from it, the size is estimated apart.

All of it is told in the frame of each view, in which the errors of one bin are most like those of the next.

A covariance is kept as its lower triangle row by row: P = K(K+1)/2 numbers.
"""

import math
import warnings
from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from formats.asset.error_covariance import ErrorShape, pairs, triangle

Array = NDArray[np.float64]

TINY = 1e-280
"""Sums of squares up to here are no error of which a shape could be told."""
MOST_ROWS, A_ROW, LEARNED_FROM = 64, 16, 1 << 14
"""Rows that the shapes of all vertices are gathered into, vertices for each of them, and vertices that say which: on
two bakes of a trained network 16 rows tell no less than one for each vertex.
"""


class Frames(Protocol):
    """The frames of views, of which an object's harmonics know and this floor does not."""

    def in_view(self, vertices: NDArray[np.int64], outgoing: Array, coefficients: Array) -> Array:
        """Coefficients [M,K,C] of the world's frame in those of these vertices [M] as seen along outgoing [M,3]."""

    def matrices(self, vertices: NDArray[np.int64], outgoing: Array, count: int) -> Array:
        """What takes K = `count` coefficients there, [M,K,K]."""


def joined_shapes(parts: Sequence[ErrorShape]) -> ErrorShape:
    """Of the vertices of several parts, one after the other."""
    covariance, channels, apart = (
        np.concatenate([getattr(part, name) for part in parts]) for name in ("covariance", "channels", "apart")
    )
    return ErrorShape(covariance, channels, apart)


def packed(matrices: NDArray[np.floating]) -> NDArray[np.floating]:
    """The lower triangles [...,P] of symmetric matrices [...,K,K]."""
    rows, columns = triangle(matrices.shape[-1])
    return matrices[..., rows, columns]


def unpacked(triangles: NDArray[np.floating], count: int) -> Array:
    """Symmetric matrices [...,K,K] from their lower triangles [...,P]."""
    rows, columns = triangle(count)
    matrices = np.empty((*triangles.shape[:-1], count, count))
    matrices[..., rows, columns] = triangles
    matrices[..., columns, rows] = triangles
    return matrices


def products(weights: Array) -> Array:
    """W_kd W_ld [D,P] for each direction d of weights [K,D]: squared residuals [D] times this are a covariance."""
    rows, columns = triangle(len(weights))
    return np.ascontiguousarray((weights[rows] * weights[columns]).T)


def trace(triangles: NDArray[np.floating], count: int) -> Array:
    """Traces [...] of symmetric matrices by their lower triangles [...,P]."""
    rows, columns = triangle(count)
    return np.asarray(triangles[..., rows == columns].sum(axis=-1), np.float64)


def turned(triangles: Array, turns: Array) -> Array:
    """T C Tᵀ [M,P] of covariances [M,P] and matrices T [M,K,K], or one [K,K]."""
    matrices = unpacked(triangles, turns.shape[-1])
    return np.asarray(packed(turns @ matrices @ np.swapaxes(turns, -1, -2)))


def of_errors(errors: Array, channels: int = 3) -> tuple[Array, Array]:
    """Σ e_k e_l [n,P] and Σ e² [n,C] of errors [n,m,K,…·C], over all else."""
    n, many, count, width = errors.shape
    by_harmonic = errors.transpose(0, 2, 1, 3).reshape(n, count, many * width)
    squares = (errors**2).sum(axis=(1, 2)).reshape(n, width // channels, channels).sum(axis=1)
    return np.asarray(packed(by_harmonic @ by_harmonic.transpose(0, 2, 1))), squares


def of_residuals(residuals: Array, products: Array) -> tuple[Array, Array]:
    """The same [M,P], [M,C] of each bin, of what fits leave over [M,D,C]; `products` [D,P] of the fit's weights."""
    squares = residuals**2
    return squares.sum(axis=2) @ products, squares.sum(axis=1)


def shape_of(covariance: Array, channels: Array, apart: NDArray[np.floating], count: int) -> ErrorShape:
    """The shape of sums [n,P], [n,C] of any size; `apart` [n,2], or [n] of vertices that err by themselves.

    Where there is no error, or it is not finite, harmonics err apart and channels alike.
    """
    size, total = trace(covariance, count), channels.sum(axis=1)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        known = (size > TINY) & (total > TINY) & np.isfinite(size) & np.isfinite(total)
        known &= np.isfinite(covariance).all(axis=1) & np.isfinite(channels).all(axis=1)
        scaled = np.where(known[:, None], covariance * (count / size)[:, None], packed(np.eye(count)))
        shares = np.where(known[:, None], channels * (channels.shape[1] / total)[:, None], 1.0)
    apart = np.where(np.isfinite(apart), np.clip(apart, 0.0, 1.0), 0.0)
    each = np.column_stack([apart, np.ones(len(apart))]) if apart.ndim == 1 else apart
    return ErrorShape(scaled.astype(np.float32), shares.astype(np.float32), each.astype(np.float32))


def unshaped(n: int, count: int, channels: int = 3) -> ErrorShape:
    """Of n vertices of whose errors only the size is known: bins and vertices err alike, which is the safe side."""
    shape = shape_of(np.zeros((n, pairs(count))), np.zeros((n, channels)), np.zeros(n), count)
    return ErrorShape(shape.covariance, shape.channels, np.zeros_like(shape.apart))


def gathered(shape: ErrorShape, size: Array) -> ErrorShape:
    """The shapes of V vertices, a row each, in a few rows: means of those that are alike, weighted by the mean variance
    of each vertex, `size` [V].
    """
    from scipy.cluster.vq import vq

    size = size if size.any() else np.ones(len(size))
    known = np.flatnonzero(size > 0.0)
    some = known[:: max(1, len(known) // LEARNED_FROM)]
    centres = _centres(_features(shape.of(some)), int(np.clip(len(known) // A_ROW, 1, MOST_ROWS)))
    row, sums, total = np.zeros(len(size), np.int64), np.zeros_like(centres), np.zeros(len(centres))
    for first in range(0, len(size), LEARNED_FROM):
        block = np.arange(first, min(first + LEARNED_FROM, len(size)))
        features = _features(shape.of(block))
        row[block] = vq(features, centres)[0]
        weight = csr_array((size[block], (row[block], np.arange(len(block)))), shape=(len(centres), len(block)))
        sums, total = sums + weight @ features, total + weight.sum(axis=1)
    used, row = np.unique(row, return_inverse=True)
    means = np.divide(sums, total[:, None], out=centres, where=total[:, None] > 0.0)[used]
    covariance, channels, apart = np.split(means, np.cumsum(_widths(shape)), axis=1)
    covariance = (covariance / _scale(shape)).astype(np.float32)
    return ErrorShape(covariance, channels.astype(np.float32), apart.astype(np.float32), row)


def _features(shape: ErrorShape) -> Array:
    """What shapes are alike in, a row a vertex."""
    return np.column_stack([shape.covariance * _scale(shape), shape.channels, shape.apart]).astype(np.float64)


def _widths(shape: ErrorShape) -> tuple[int, int]:
    return shape.covariance.shape[1], shape.channels.shape[1]


def _scale(shape: ErrorShape) -> Array:
    """What a number of a lower triangle counts for in the distance of two matrices of trace 1."""
    count = _count(shape.covariance)
    rows, columns = triangle(count)
    return np.asarray(np.where(rows == columns, 1.0, np.sqrt(2.0)) / count, np.float64)


def _count(triangles: NDArray[np.floating]) -> int:
    """K of lower triangles [...,P]."""
    return (math.isqrt(8 * triangles.shape[-1] + 1) - 1) // 2


def _centres(features: Array, most: int) -> Array:
    """Means of the rows that are alike, at most so many."""
    from scipy.cluster.vq import kmeans2

    kinds = np.unique(features, axis=0)
    if len(kinds) <= most:
        return kinds
    with warnings.catch_warnings(action="ignore", category=UserWarning):  # of a mean that nothing belongs to
        return np.asarray(kmeans2(kinds, most, minit="++", seed=0)[0])


def both(first: ErrorShape, size: Array, covariance: Array, channels: Array) -> ErrorShape:
    """Of errors of shapes `first`, a row a vertex, of mean variance `size` [V], and others beside, which bins and
    vertices have in common: sums [V,P], [V,C] over the same number of bins and channels that `size` is a mean over.
    """
    count = _count(covariance)
    more = trace(covariance, count) / count
    apart = first.apart * np.divide(size, size + more, out=np.zeros_like(size), where=size > 0.0)[:, None]
    summed = first.covariance * size[:, None] + covariance, first.channels * size[:, None] + channels
    return shape_of(*summed, apart, count)
