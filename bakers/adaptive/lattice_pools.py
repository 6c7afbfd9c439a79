"""Lattices of any size, each in a few rotated copies. Single bins are integrated over a copy.

A lattice made for its size has a smaller error than a nested one, especially for smooth Ŝ (with 256 directions a half
to a third, measured on six trained networks). Bins over different copies have independent errors, so an interpolation
of several bins has a smaller error than each of them.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bakers.error_covariance import weight_products

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True)
class Pool:
    """R rotated copies of a lattice of D directions, and the least-squares fit over each."""

    directions: Array
    """[D,3], before the rotation."""
    incident: Array
    """[R,D,3]"""
    to_world: Array
    """[R,K,K], from coefficients in a copy's frame to the world frame."""
    harmonics: Array
    """Y [D,K] at `directions`."""
    weights: Array
    """(YᵀY)⁻¹Yᵀ [K,D]"""

    @cached_property
    def products(self) -> Array:
        """[D,P], see `bakers.error_covariance.weight_products`."""
        return weight_products(self.weights)

    def fitted(self, values: NDArray[np.floating], copies: Index) -> tuple[Array, Array, Array]:
        """Coefficients [M,K,3] of values [M,D,3] in the directions of these copies [M]; the residuals [M,D,3]; and
        their mean square [M] per degree of freedom, mean over channels.
        """
        exact = values.astype(np.float64)
        local = self.weights @ exact
        freedom = self.harmonics.shape[0] - self.harmonics.shape[1]
        residuals = exact - self.harmonics @ local
        return self.to_world[copies] @ local, residuals, np.asarray((residuals**2).sum(axis=1).mean(axis=1) / freedom)


class Pools:
    """Pools of a sequence of sizes, each made on first use."""

    def __init__(
        self, sizes: tuple[int, ...], make: Callable[[int], Pool], copy_of: Callable[[Index, Index, int], Index]
    ) -> None:
        """`make` makes the pool of a size, with at least four copies; `copy_of` (vertices [M], bins [M], which) → [M]
        is a number whose remainder selects the copy.
        """
        self.sizes = sizes
        self._make, self._copy_of = make, copy_of
        self.of = lru_cache(maxsize=None)(make)

    def __reduce__(self) -> tuple[Any, ...]:
        """Copies in other processes make their own pools."""
        return Pools, (self.sizes, self._make, self._copy_of)

    def copies(self, size: int, vertices: Index, bins: Index, which: int) -> Index:
        """Copies [M] for these bins: which = 0 selects from the first half, 1 and 2 select different ones from the
        second.

        Interpolated bins depend on copies that other bins used; validation uses copies that no bin used.
        """
        count = len(self.of(size).incident)
        half = count // 2
        if which == 0:
            return np.asarray(self._copy_of(vertices, bins, 0) % half)
        one, rest = self._copy_of(vertices, bins, 1), count - half
        step = 1 + self._copy_of(vertices, bins, 2) % (rest - 1)
        return np.asarray(half + (one + (which - 1) * step) % rest)
