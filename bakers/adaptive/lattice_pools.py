"""Lattices of any size, each in a few copies that are turned on their own: what bins are integrated over alone.

A lattice made for its size has a smaller error than one that grew to it, the more so the smoother Ŝ is (with 256
directions half to a third of it, measured on six trained networks), and bins that take different copies err apart, so
that what is foretold from several of them errs less than each does.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bakers.error_covariance import products

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True)
class Pool:
    """R copies of a lattice of D directions, and the fit by least squares over each."""

    directions: Array
    """[D,3], before they are turned."""
    incident: Array
    """[R,D,3]"""
    back: Array
    """[R,K,K], from coefficients in a copy's own frame to the world's."""
    harmonics: Array
    """Y [D,K] at `directions`."""
    weights: Array
    """(YᵀY)⁻¹Yᵀ [K,D]"""

    @property
    def variance_share(self) -> float:
        """Mean over K of the variance of a coefficient per unit variance of a value with independent errors."""
        return float((self.weights**2).sum() / len(self.weights))

    @cached_property
    def products(self) -> Array:
        """[D,P], see `bakers.error_covariance`."""
        return products(self.weights)

    def fitted(self, values: NDArray[np.floating], copies: Index) -> tuple[Array, Array, Array]:
        """Coefficients [M,K,3] of values [M,D,3] in the directions of these copies [M]; what they leave over [M,D,3];
        and its mean square [M] per degree of freedom, mean over channels.
        """
        exact = values.astype(np.float64)
        own = self.weights @ exact
        freedom = self.harmonics.shape[0] - self.harmonics.shape[1]
        left = exact - self.harmonics @ own
        return self.back[copies] @ own, left, np.asarray((left**2).sum(axis=1).mean(axis=1) / freedom)


class Pools:
    """Pools of a ladder of sizes, each made when it is first asked for."""

    def __init__(
        self, sizes: tuple[int, ...], made: Callable[[int], Pool], taken: Callable[[Index, Index, int], Index]
    ) -> None:
        """`made` makes the pool of a size, of four copies or more; `taken` (vertices [M], bins [M], which) says what
        copy a bin takes, before it is divided by how many there are.
        """
        self.sizes = sizes
        self._made, self._taken = made, taken
        self.of = lru_cache(maxsize=None)(made)

    def __reduce__(self) -> tuple[Any, ...]:
        """Copies in other processes make their own pools."""
        return Pools, (self.sizes, self._made, self._taken)

    def copies(self, size: int, vertices: Index, bins: Index, which: int) -> Index:
        """The copies [M] that bins take: which = 0 of the first half of them, 1 and 2 different ones of the second.

        What is foretold of a bin is made of those that others took: it is held against copies that none has taken.
        """
        many = len(self.of(size).incident)
        half = many // 2
        if which == 0:
            return np.asarray(self._taken(vertices, bins, 0) % half)
        one, rest = self._taken(vertices, bins, 1), many - half
        step = 1 + self._taken(vertices, bins, 2) % (rest - 1)
        return np.asarray(half + (one + (which - 1) * step) % rest)
