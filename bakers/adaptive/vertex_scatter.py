"""Distribution of vertices' errors about their stated values, which determines the 95th percentile over vertices.

Bins that share a lattice have common errors, so the squared error of their vertex is a sum of few independent numbers;
bins with their own lattices have independent errors. The relative variance is measured where several bins of a vertex
are validated: their squared errors have the covariance of the errors.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

Array = NDArray[np.float64]

CORRELATED_VARIANCE, INDEPENDENT_VARIANCE = 0.6, 0.04
"""Relative variance of the squared error of a vertex whose error is that of one lattice, and of a vertex whose bins are
independent, as measured on spheres.
"""
LEAST_VARIANCE, MOST_VARIANCE = 0.01, 2.0
PRIOR_UNCERTAINTY = 0.1
"""Least uncertainty of the default."""
MOST_RATIO = 10.0
"""Bound on the ratio of a bin's squared error to its stated variance."""
QUANTILES = 1 << 17
"""Approximate total number of quantiles."""


@dataclass(frozen=True)
class Scatter:
    """Relative variance of the squared errors of vertices, as measured by validation samples."""

    measured: float = 0.0
    weight: float = 0.0
    """From 0 to 1, weight of the measurement against the default."""

    def variance(self, correlated: Array) -> Array:
        """Relative variance at vertices [V] whose bins have the fraction `correlated` of their error in common."""
        found = self.weight * self.measured + (1.0 - self.weight) * default_variance(correlated)
        return np.asarray(np.clip(found, LEAST_VARIANCE, MOST_VARIANCE))


UNKNOWN = Scatter()


def default_variance(correlated: Array) -> Array:
    """The default, without a measurement."""
    return np.asarray(INDEPENDENT_VARIANCE + CORRELATED_VARIANCE * correlated**2)


def measured_scatter(vertices: NDArray[np.integer], stated: Array, squared: Array, prior: float) -> Scatter:
    """Relative variance measured by validation samples [M] at these vertices with their stated variance and squared
    error, for a prior relative variance: from products of the bins of each vertex, whose samples are independent.
    """
    positive = stated > 0.0
    if not positive.any():
        return UNKNOWN
    of_vertex = np.unique(vertices[positive], return_inverse=True)[1]
    ratio = np.clip(squared[positive] / stated[positive], -MOST_RATIO, MOST_RATIO)
    many, sums, squares = (np.bincount(of_vertex, each) for each in (np.ones(len(ratio)), ratio, ratio**2))
    products, expected = sums**2 - squares, many * (many - 1.0) * ratio.mean() ** 2
    if not expected.sum() > 0.0:
        return UNKNOWN
    found = float(products.sum() / expected.sum())
    uncertain = float(((products - found * expected) ** 2).sum()) / float(expected.sum()) ** 2
    # Few vertices may agree by chance: this is the uncertainty of as many products of independent numbers.
    least = ((ratio**2).mean() ** 2 / ratio.mean() ** 4 - 1.0) / float((many * (many - 1.0)).sum() / 2.0)
    prior_variance = (PRIOR_UNCERTAINTY + prior) ** 2
    return Scatter(found - 1.0, float(prior_variance / (prior_variance + max(uncertain, least))))


def error_quantiles(errors: Array, variance: Array) -> Array:
    """Quantiles [V,Q] of the errors of vertices with the rms errors [V], evenly spaced in probability, as if their
    squared errors were χ² of that relative variance [V] (Wilson and Hilferty, "The distribution of chi-square", 1931).
    """
    many = int(np.clip(QUANTILES // max(1, len(errors)), 4, 32))
    ninth = (variance / 9.0)[:, None]
    cube = 1.0 - ninth + ndtri((np.arange(many) + 0.5) / many) * np.sqrt(ninth)
    return np.asarray(errors[:, None] * np.maximum(cube, 0.0) ** 1.5)
