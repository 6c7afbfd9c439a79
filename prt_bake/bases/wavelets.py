"""Haar wavelets on the equal-area octahedron: the largest coefficients of each query (Ng et al. 2003)."""

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def haar(values: Array) -> Array:
    """Orthonormal coefficients [N,M,C] of values [N,M,C] over M = n² cells, n a power of two."""
    return _levels(values, inverse=False)


def inverse_haar(coefficients: Array) -> Array:
    """The inverse of `haar`."""
    return _levels(coefficients, inverse=True)


def keep_largest(values: Array, count: int, light: Array | float = 1.0) -> Array:
    """Values [N,M,3] by the `count` wavelets of each query that are largest over all channels.

    light [M,1]: root mean square of the light's coefficients, which the wavelets are weighted with.
    """
    coefficients = haar(values)
    size = ((coefficients * light) ** 2).sum(axis=2)
    dropped = np.argpartition(-size, count - 1, axis=1)[:, count:]
    np.put_along_axis(coefficients, dropped[..., None], 0.0, axis=1)
    return inverse_haar(coefficients)


def _levels(values: Array, inverse: bool) -> Array:
    side = math.isqrt(values.shape[1])
    grid = values.reshape(len(values), side, side, -1).copy()
    sizes = [side >> level for level in range(side.bit_length() - 1)]
    for size in reversed(sizes) if inverse else sizes:
        for axis in (1, 2):
            part = np.moveaxis(grid[:, :size, :size], axis, 1)
            half = size // 2
            if inverse:
                low, high = part[:, :half].copy(), part[:, half:].copy()
                part[:, ::2], part[:, 1::2] = (low + high) / math.sqrt(2.0), (low - high) / math.sqrt(2.0)
            else:
                even, odd = part[:, ::2].copy(), part[:, 1::2].copy()
                part[:, :half], part[:, half:] = (even + odd) / math.sqrt(2.0), (even - odd) / math.sqrt(2.0)
    return grid.reshape(values.shape)
