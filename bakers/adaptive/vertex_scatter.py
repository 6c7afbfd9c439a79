"""How much vertices' errors scatter about what is stated of them: what their 95th percentile is made of.

Bins that share a lattice err together, so that the squared error of their vertex is made of few independent numbers;
bins that have one each do not. How much it scatters is seen where several bins of a vertex were held against
independent directions: what these say has the covariance that the errors have.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

Array = NDArray[np.float64]

TOGETHER, APART = 0.6, 0.04
"""Relative variance of the squared error of a vertex all of whose error is that of one lattice, and of one whose bins
err apart, as they were seen on spheres.
"""
LEAST, MOST = 0.01, 2.0
DOUBT = 0.1
"""How far off what is usual may be at least."""
FARTHEST = 10.0
"""Times its stated variance, which the squared error of one bin counts for at most."""
QUANTILES = 1 << 17
"""About how many errors that vertices may have there are in all."""


@dataclass(frozen=True)
class Scatter:
    """Relative variance of the squared errors of vertices, as far as checks tell of it."""

    measured: float = 0.0
    trust: float = 0.0
    """From 0 to 1, what the measurement counts beside what is usual."""

    def variance(self, together: Array) -> Array:
        """That of vertices [V] whose bins have such a share of their error in common."""
        found = self.trust * self.measured + (1.0 - self.trust) * usual(together)
        return np.asarray(np.clip(found, LEAST, MOST))


UNKNOWN = Scatter()


def usual(together: Array) -> Array:
    """The same where nothing has been measured."""
    return np.asarray(APART + TOGETHER * together**2)


def measured(vertices: NDArray[np.integer], stated: Array, squared: Array, beforehand: float) -> Scatter:
    """What checked bins [M] of these vertices, of that stated variance and squared error, tell, where a relative
    variance `beforehand` is expected: from products of the bins of each vertex, whose checks are independent.
    """
    sound = stated > 0.0
    if not sound.any():
        return UNKNOWN
    of_vertex = np.unique(vertices[sound], return_inverse=True)[1]
    over = np.clip(squared[sound] / stated[sound], -FARTHEST, FARTHEST)
    many, sums, squares = (np.bincount(of_vertex, each) for each in (np.ones(len(over)), over, over**2))
    products, expected = sums**2 - squares, many * (many - 1.0) * over.mean() ** 2
    if not expected.sum() > 0.0:
        return UNKNOWN
    found = float(products.sum() / expected.sum())
    uncertain = float(((products - found * expected) ** 2).sum()) / float(expected.sum()) ** 2
    # Few vertices may agree by chance: so many products of independent numbers know no better than this.
    least = ((over**2).mean() ** 2 / over.mean() ** 4 - 1.0) / float((many * (many - 1.0)).sum() / 2.0)
    doubt = (DOUBT + beforehand) ** 2
    return Scatter(found - 1.0, float(doubt / (doubt + max(uncertain, least))))


def possible(errors: Array, variance: Array) -> Array:
    """Errors [V,Q] that vertices may have whose usual ones are `errors` [V]: evenly spaced quantiles, as if squared
    errors of that relative variance [V] were χ² (Wilson and Hilferty, "The distribution of chi-square", 1931).
    """
    many = int(np.clip(QUANTILES // max(1, len(errors)), 4, 32))
    ninth = (variance / 9.0)[:, None]
    cube = 1.0 - ninth + ndtri((np.arange(many) + 0.5) / many) * np.sqrt(ninth)
    return np.asarray(errors[:, None] * np.maximum(cube, 0.0) ** 1.5)
