"""Projects values of Ŝ in a set of directions on a basis: a_k = Σ_d W_kd Ŝ(ω_d).

Two kinds of weights W. `fitted`: least squares, (YᵀY)⁻¹Yᵀ, which reproduces every band-limited Ŝ exactly and is
unbiased over rotations uniform on SO(3) (the averaged operator commutes with rotations and is exact on the band).
Equal: 4π/D Yᵀ, plain Monte Carlo.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from formats.errors import QueryError

Array = NDArray[np.float64]
LARGEST_CONDITION = 1e8


@dataclass(frozen=True)
class DirectionPool:
    """R sets of D directions each, and the weights that project values on them."""

    incident: Array
    """Unit vectors [R,D,3]."""
    weights: Array
    """W [R,K,D]: coefficients = weights @ values."""
    harmonics: Array | None
    """Y [R,D,K] for fitted weights, None for equal ones."""
    variance_share: float
    """Mean over K of the variance of a coefficient per unit variance of a value, for values with independent errors."""
    condition: float
    """Condition number of the worst set's least-squares matrix Y; 1 for equal weights."""


def direction_pool(incident: Array, harmonics: Array, fitted: bool) -> DirectionPool:
    """Prepares direction sets [R,D,3] with the basis evaluated on them, harmonics [R,D,K].

    Raises QueryError for fitted weights if D < K or the directions do not determine the coefficients.
    """
    directions, count = harmonics.shape[1:]
    if not fitted:
        weights = np.asarray((4.0 * np.pi / directions) * harmonics.transpose(0, 2, 1), dtype=np.float64)
        return DirectionPool(incident, weights, None, 4.0 * np.pi / directions, 1.0)
    if directions < count:
        raise QueryError(
            f"{directions} directions cannot determine {count} coefficients: give at least {count}, better {2 * count}"
        )
    gram = harmonics.transpose(0, 2, 1) @ harmonics
    eigenvalues = np.linalg.eigvalsh(gram)
    condition = float(np.sqrt(eigenvalues[:, -1] / np.maximum(eigenvalues[:, 0], 1e-300)).max())
    if condition > LARGEST_CONDITION:
        raise QueryError(
            f"{directions} directions do not determine {count} coefficients (condition number {condition:.3g}); "
            f"give at least {2 * count}"
        )
    weights = np.asarray(np.linalg.solve(gram, harmonics.transpose(0, 2, 1)), dtype=np.float64)
    return DirectionPool(incident, weights, harmonics, float((1.0 / eigenvalues).mean()), condition)


def project(values: NDArray[np.floating], pool: DirectionPool, rotation: NDArray[np.int64]) -> Array:
    """Coefficients [n,B,K,3], float64, of values [n,B,D,3] on the sets of index `rotation` [n,B]."""
    return pool.weights[rotation] @ values


def residual_variance(
    values: NDArray[np.floating], coefficients: Array, pool: DirectionPool, rotation: NDArray[np.int64]
) -> Array:
    """Variance [n,B] of coefficients (mean over K and channels) from the residuals of the fit.

    The textbook estimate of a linear fit, s² (YᵀY)⁻¹ with s² = Σ r² / (D − K), which assumes independent residuals. A
    lattice has a smaller error, so the estimate is conservative. With D = K the residuals vanish and the error is
    unknown: the squared coefficients are returned. For plain sums the values themselves are the residuals.
    """
    if pool.harmonics is None:
        return np.asarray(np.square(values, dtype=np.float64).mean(axis=(-1, -2)) * pool.variance_share)
    directions, count = pool.harmonics.shape[1:]
    if directions == count:
        return np.asarray((coefficients**2).mean(axis=(-1, -2)))
    residual = residuals_of(values, coefficients, pool, rotation)
    mean_square = (residual**2).sum(axis=-2).mean(axis=-1) / (directions - count)
    return np.asarray(mean_square * pool.variance_share)


def residuals_of(
    values: NDArray[np.floating], coefficients: Array, pool: DirectionPool, rotation: NDArray[np.int64]
) -> Array:
    """Residuals of the fit to values [n,B,D,3]; for plain sums, the values."""
    if pool.harmonics is None:
        return np.asarray(values, np.float64)
    return np.asarray(values - pool.harmonics[rotation] @ coefficients)
