"""A lattice of directions that grows: each of its sizes is a lattice whose points all later ones keep."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from bakers.error_covariance import of_residuals, products

Array = NDArray[np.float64]


@dataclass(frozen=True)
class NestedLattice:
    """Directions in the order in which they are added, and the fit by least squares over each size."""

    directions: Array
    """Unit vectors [D,3]; the first sizes[s] of them are a lattice of their own."""
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
        """[D,P] of each size, see `bakers.error_covariance`."""
        return tuple(products(weights) for weights in self.weights)

    def fitted(self, values: NDArray[np.floating], step: int) -> tuple[Array, Array]:
        """Coefficients [M,K·3] of values [M,D,3] in the directions of size number `step`, and the mean square [M] of
        what they leave over, per degree of freedom, mean over channels.
        """
        exact = values.astype(np.float64)
        coefficients = self.weights[step] @ exact
        left = self._left_over(exact, coefficients, step)
        rough = (left**2).sum(axis=1).mean(axis=1) / (self.sizes[step] - self.count)
        return coefficients.reshape(len(values), -1), np.asarray(rough)

    def shape(self, values: NDArray[np.floating], step: int) -> tuple[Array, Array]:
        """How the errors of such a fit hang together: covariance [M,P] and channels [M,3] of any size
        (`bakers.error_covariance.of_residuals`).
        """
        exact = values.astype(np.float64)
        return of_residuals(self._left_over(exact, self.weights[step] @ exact, step), self.products[step])

    def _left_over(self, exact: Array, coefficients: Array, step: int) -> Array:
        return np.asarray(exact - self.harmonics[: self.sizes[step]] @ coefficients)


def nested_lattice(directions: Array, harmonics: Array, sizes: tuple[int, ...]) -> NestedLattice:
    """The lattice whose points are `directions` [D,3], with the basis on them, harmonics [D,K]; sizes exceed K."""
    weights, shares = list[Array](), list[float]()
    for size in sizes:
        y = harmonics[:size]
        gram = y.T @ y
        weights.append(np.asarray(np.linalg.solve(gram, y.T), np.float64))
        shares.append(float(np.trace(np.linalg.inv(gram))) / y.shape[1])
    return NestedLattice(directions, sizes, harmonics, tuple(weights), tuple(shares))
