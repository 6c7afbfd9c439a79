"""Error covariance of a vertex's coefficients: covariance over harmonics, and the share of each channel.

A set of directions misses narrow features, and a missed feature enters every harmonic by that harmonic's value in its
direction. So the errors are correlated: on a trained network one principal component holds 89 % of the variance over
nine harmonics at a bin, 59 % at a vertex over all its bins, and the three channels err alike. The resulting error of an
image depends on the light, by a factor of three either way, which a single standard error cannot express.

Where every bin is evaluated twice, or differs from its neighbours by noise alone, the differences are samples of the
error. Elsewhere the residuals r of the fit take their place: a fit with weights W has the covariance W diag(r²) Wᵀ
(White, "A heteroskedasticity-consistent covariance matrix estimator", Econometrica 1980). Only the normalised matrix is
used; the variance is estimated separately.

All covariances are in the frame of each view, in which the errors of neighbouring bins are most alike.

A covariance is stored as its lower triangle, row by row: P = K(K+1)/2 numbers.
"""

import math
import warnings
from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from formats.asset.error_covariance import ErrorCovariance, pairs, triangle

Array = NDArray[np.float64]

TINY = 1e-280
"""Sums of squares below this are too small to estimate a covariance from."""
MOST_CLUSTERS, VERTICES_PER_CLUSTER, MOST_TRAINING_VERTICES = 64, 16, 1 << 14
"""Most clusters that the covariances of all vertices are grouped into, vertices per cluster, and most vertices that the
clustering is trained on. On two bakes of a trained network 16 clusters are as accurate as one covariance per vertex.
"""


class ViewFrames(Protocol):
    """Rotations into the frames of views; the harmonics are not known to this package."""

    def in_view(self, vertices: NDArray[np.int64], outgoing: Array, coefficients: Array) -> Array:
        """Coefficients [M,K,C] rotated from the world frame into the view frames of vertices [M] seen along outgoing
        [M,3].
        """

    def matrices(self, vertices: NDArray[np.int64], outgoing: Array, count: int) -> Array:
        """Matrices [M,K,K] of that rotation for K = `count` coefficients."""


def concatenated(parts: Sequence[ErrorCovariance]) -> ErrorCovariance:
    """Concatenates covariances of consecutive vertices."""
    covariance, channels, apart = (
        np.concatenate([getattr(part, name) for part in parts]) for name in ("covariance", "channels", "apart")
    )
    return ErrorCovariance(covariance, channels, apart)


def packed(matrices: NDArray[np.floating]) -> NDArray[np.floating]:
    """Lower triangles [...,P] of symmetric matrices [...,K,K]."""
    rows, columns = triangle(matrices.shape[-1])
    return matrices[..., rows, columns]


def unpacked(triangles: NDArray[np.floating], count: int) -> Array:
    """Symmetric matrices [...,K,K] from their lower triangles [...,P]."""
    rows, columns = triangle(count)
    matrices = np.empty((*triangles.shape[:-1], count, count))
    matrices[..., rows, columns] = triangles
    matrices[..., columns, rows] = triangles
    return matrices


def weight_products(weights: Array) -> Array:
    """W_kd W_ld [D,P] for each direction d of weights [K,D]; squared residuals [D] times this are a covariance."""
    rows, columns = triangle(len(weights))
    return np.ascontiguousarray((weights[rows] * weights[columns]).T)


def trace(triangles: NDArray[np.floating], count: int) -> Array:
    """Traces [...] of symmetric matrices given as lower triangles [...,P]."""
    rows, columns = triangle(count)
    return np.asarray(triangles[..., rows == columns].sum(axis=-1), np.float64)


def rotated(triangles: Array, rotations: Array) -> Array:
    """T C Tᵀ [M,P] of covariances C [M,P] and matrices T [M,K,K], or one T [K,K]."""
    matrices = unpacked(triangles, rotations.shape[-1])
    return np.asarray(packed(rotations @ matrices @ np.swapaxes(rotations, -1, -2)))


def error_sums(errors: Array, channels: int = 3) -> tuple[Array, Array]:
    """Σ e_k e_l [n,P] and Σ e² [n,C] of errors [n,m,K,…·C], summed over all other axes."""
    n, many, count, width = errors.shape
    by_harmonic = errors.transpose(0, 2, 1, 3).reshape(n, count, many * width)
    squares = (errors**2).sum(axis=(1, 2)).reshape(n, width // channels, channels).sum(axis=1)
    return np.asarray(packed(by_harmonic @ by_harmonic.transpose(0, 2, 1))), squares


def residual_sums(residuals: Array, products: Array) -> tuple[Array, Array]:
    """`error_sums` [M,P] and [M,C] of each bin, estimated from the residuals [M,D,C] of its fit; `products` [D,P] are
    the `weight_products` of the fit.
    """
    squares = residuals**2
    return squares.sum(axis=2) @ products, squares.sum(axis=1)


def normalised_covariance(
    covariance: Array, channels: Array, apart: NDArray[np.floating], count: int
) -> ErrorCovariance:
    """Normalises sums [n,P] and [n,C]. `apart` [n,2] are the independent fractions of the variance of bins and
    vertices, or [n] of bins alone if vertices are independent.

    Without a finite, positive error the harmonics are uncorrelated and the channels equal.
    """
    size, total = trace(covariance, count), channels.sum(axis=1)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        known = (size > TINY) & (total > TINY) & np.isfinite(size) & np.isfinite(total)
        known &= np.isfinite(covariance).all(axis=1) & np.isfinite(channels).all(axis=1)
        scaled = np.where(known[:, None], covariance * (count / size)[:, None], packed(np.eye(count)))
        shares = np.where(known[:, None], channels * (channels.shape[1] / total)[:, None], 1.0)
    apart = np.where(np.isfinite(apart), np.clip(apart, 0.0, 1.0), 0.0)
    each = np.column_stack([apart, np.ones(len(apart))]) if apart.ndim == 1 else apart
    return ErrorCovariance(scaled.astype(np.float32), shares.astype(np.float32), each.astype(np.float32))


def unknown_covariance(n: int, count: int, channels: int = 3) -> ErrorCovariance:
    """Covariance of n vertices of which only the variance is known: bins and vertices are fully correlated, the
    conservative choice.
    """
    errors = normalised_covariance(np.zeros((n, pairs(count))), np.zeros((n, channels)), np.zeros(n), count)
    return ErrorCovariance(errors.covariance, errors.channels, np.zeros_like(errors.apart))


def clustered(errors: ErrorCovariance, size: Array) -> ErrorCovariance:
    """Clusters the covariances of V vertices into a few rows: means of similar ones, weighted by the mean variance
    `size` [V] of each vertex.
    """
    from scipy.cluster.vq import vq

    size = size if size.any() else np.ones(len(size))
    known = np.flatnonzero(size > 0.0)
    some = known[:: max(1, len(known) // MOST_TRAINING_VERTICES)]
    centres = _centres(
        _features(errors.at_vertices(some)), int(np.clip(len(known) // VERTICES_PER_CLUSTER, 1, MOST_CLUSTERS))
    )
    row, sums, total = np.zeros(len(size), np.int64), np.zeros_like(centres), np.zeros(len(centres))
    for first in range(0, len(size), MOST_TRAINING_VERTICES):
        block = np.arange(first, min(first + MOST_TRAINING_VERTICES, len(size)))
        features = _features(errors.at_vertices(block))
        row[block] = vq(features, centres)[0]
        weight = csr_array((size[block], (row[block], np.arange(len(block)))), shape=(len(centres), len(block)))
        sums, total = sums + weight @ features, total + weight.sum(axis=1)
    used, row = np.unique(row, return_inverse=True)
    means = np.divide(sums, total[:, None], out=centres, where=total[:, None] > 0.0)[used]
    widths = errors.covariance.shape[1], errors.channels.shape[1]
    covariance, channels, apart = np.split(means, np.cumsum(widths), axis=1)
    covariance = (covariance / _scale(errors)).astype(np.float32)
    return ErrorCovariance(covariance, channels.astype(np.float32), apart.astype(np.float32), row)


def _features(errors: ErrorCovariance) -> Array:
    """Feature vectors for the clustering, a row per vertex."""
    return np.column_stack([errors.covariance * _scale(errors), errors.channels, errors.apart]).astype(np.float64)


def _scale(errors: ErrorCovariance) -> Array:
    """Scale of each entry of a lower triangle, so that distances equal those of matrices of trace 1."""
    count = _count(errors.covariance)
    rows, columns = triangle(count)
    return np.asarray(np.where(rows == columns, 1.0, np.sqrt(2.0)) / count, np.float64)


def _count(triangles: NDArray[np.floating]) -> int:
    """K of lower triangles [...,P]."""
    return (math.isqrt(8 * triangles.shape[-1] + 1) - 1) // 2


def _centres(features: Array, most: int) -> Array:
    """Cluster centres of the rows, at most `most`."""
    from scipy.cluster.vq import kmeans2

    distinct = np.unique(features, axis=0)
    if len(distinct) <= most:
        return distinct
    with warnings.catch_warnings(action="ignore", category=UserWarning):  # warning about an empty cluster
        return np.asarray(kmeans2(distinct, most, minit="++", seed=0)[0])


def added_covariance(first: ErrorCovariance, size: Array, covariance: Array, channels: Array) -> ErrorCovariance:
    """Covariance of two independent errors. The first, normalised, has the mean variance `size` [V]; the second, given
    by sums [V,P] and [V,C] over as many bins and channels, is common to all bins and vertices.
    """
    count = _count(covariance)
    added = trace(covariance, count) / count
    apart = first.apart * np.divide(size, size + added, out=np.zeros_like(size), where=size > 0.0)[:, None]
    summed = first.covariance * size[:, None] + covariance, first.channels * size[:, None] + channels
    return normalised_covariance(*summed, apart, count)
