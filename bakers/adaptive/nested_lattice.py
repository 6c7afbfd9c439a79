"""A nested lattice of directions: each size is a lattice that contains all smaller ones."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from bakers.error_covariance import residual_sums, weight_products

Array = NDArray[np.float64]


@dataclass(frozen=True)
class NestedLattice:
    """Directions in nested order, and the least-squares fit over each size."""

    directions: Array
    """Unit vectors [D,3]; the first sizes[s] of them are a lattice."""
    sizes: tuple[int, ...]
    harmonics: Array
    """Y [D,K]"""
    weights: tuple[Array, ...]
    """(YᵀY)⁻¹Yᵀ [K,D] of each size."""
    variance_shares: tuple[float, ...]
    """Mean over K of the variance of a coefficient per unit variance of a value, for values with independent errors."""

    @property
    def count(self) -> int:
        """K"""
        return int(self.harmonics.shape[1])

    @cached_property
    def products(self) -> tuple[Array, ...]:
        """[D,P] of each size, see `bakers.error_covariance.weight_products`."""
        return tuple(weight_products(weights) for weights in self.weights)

    def fitted(self, values: NDArray[np.floating], step: int) -> tuple[Array, Array]:
        """Coefficients [M,K·3] of values [M,D,3] in the directions of size number `step`, and the mean square residual
        [M] per degree of freedom, mean over channels.
        """
        exact = values.astype(np.float64)
        coefficients = self.weights[step] @ exact
        residuals = self._residuals(exact, coefficients, step)
        variance = (residuals**2).sum(axis=1).mean(axis=1) / (self.sizes[step] - self.count)
        return coefficients.reshape(len(values), -1), np.asarray(variance)

    def error_sums(self, values: NDArray[np.floating], step: int) -> tuple[Array, Array]:
        """Error covariance [M,P] and channels [M,3] of the fit to values [M,D,3], up to a factor
        (`bakers.error_covariance.residual_sums`).
        """
        exact = values.astype(np.float64)
        return residual_sums(self._residuals(exact, self.weights[step] @ exact, step), self.products[step])

    def _residuals(self, exact: Array, coefficients: Array, step: int) -> Array:
        return np.asarray(exact - self.harmonics[: self.sizes[step]] @ coefficients)


def nested_lattice(directions: Array, harmonics: Array, sizes: tuple[int, ...]) -> NestedLattice:
    """The lattice of points `directions` [D,3] with the basis at them, harmonics [D,K]; all sizes exceed K."""
    weights, shares = list[Array](), list[float]()
    for size in sizes:
        y = harmonics[:size]
        gram = y.T @ y
        weights.append(np.asarray(np.linalg.solve(gram, y.T), np.float64))
        shares.append(float(np.trace(np.linalg.inv(gram))) / y.shape[1])
    return NestedLattice(directions, sizes, harmonics, tuple(weights), tuple(shares))
