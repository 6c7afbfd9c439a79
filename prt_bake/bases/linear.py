"""Linear bases over the cells of the sphere: harmonics, and functions learned from the object itself.

Learned functions are principal components (Nowrouzezahrai et al. 2007, "Eigentransport for efficient and accurate
all-frequency relighting") of Ŝ at other queries, of each channel apart or of the three together.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from prt_bake.mathematics import sh

Array = NDArray[np.float64]

_OVERSAMPLED, _ITERATIONS = 16, 3
WHITE = 0.1
"""Share of light from single directions, each as likely, in the norm that is weighted by skies."""


class Harmonics:
    """Harmonics up to a degree over the cells [M,3]."""

    def __init__(self, directions: Array, degree: int) -> None:
        """Make them orthonormal over the cells."""
        self._functions = np.linalg.qr(sh.evaluate(directions, degree))[0]

    def approximate(self, values: Array) -> Array:
        """The best approximation of values [N,M,3]."""
        coefficients = np.tensordot(values, self._functions, axes=(1, 0))
        return np.ascontiguousarray(np.moveaxis(coefficients @ self._functions.T, 2, 1))


class SkyNorm(NamedTuple):
    """The root of the covariance of skies over the cells: floor·I + axes·diag(gains)·axesᵀ."""

    floor: float
    axes: Array
    gains: Array

    def weigh(self, rows: Array) -> Array:
        """Rows [N,M] whose norm is that of radiance under the skies."""
        return np.asarray(self.floor * rows + ((rows @ self.axes) * self.gains) @ self.axes.T)

    def restore(self, rows: Array) -> Array:
        """The inverse of `weigh`."""
        share = self.gains / (self.floor + self.gains)
        return np.asarray((rows - ((rows @ self.axes) * share) @ self.axes.T) / self.floor)


def sky_norm(skies: Array) -> SkyNorm:
    """The norm of radiance under skies [S,M,3] of equal power, and a share `WHITE` of light from one direction."""
    rows = np.moveaxis(skies, 2, 1).reshape(-1, skies.shape[1])
    lengths = np.linalg.norm(rows, axis=1, keepdims=True)
    rows = rows[lengths[:, 0] > 0.0] / lengths[lengths[:, 0] > 0.0]  # a channel may be black
    _, size, axes = np.linalg.svd(rows / math.sqrt(len(rows)), full_matrices=False)
    white = math.sqrt(WHITE / rows.shape[1])
    return SkyNorm(white, axes.T, np.sqrt(white**2 + (1.0 - WHITE) * size**2) - white)


class LearnedBasis:
    """Principal functions of Ŝ [N,M,3] at the queries of a training set.

    together: whether a function has three channels, or one that serves all of them. norm: that of the fit; None counts
    all directions alike.
    """

    def __init__(self, training: Array, most: int, together: bool, norm: SkyNorm | None = None) -> None:
        self._together, self._norm = together, norm
        self._functions = _principal(self._rows(training), most)

    def of(self, count: int) -> Callable[[Array], Array]:
        """`approximate` with `count` functions."""
        return lambda values: self.approximate(values, count)

    def approximate(self, values: Array, count: int) -> Array:
        """The best approximation of values [N,M,3] by the first `count` functions."""
        functions = self._functions[:, :count]
        rows = (self._rows(values) @ functions) @ functions.T
        if self._together:
            rows = np.moveaxis(rows.reshape(len(values), 3, -1), 1, 0).reshape(3 * len(values), -1)
        if self._norm is not None:
            rows = self._norm.restore(rows)
        return np.asarray(np.moveaxis(rows.reshape(3, len(values), -1), 0, 2))

    def _rows(self, values: Array) -> Array:
        rows = np.moveaxis(values, 2, 0).reshape(-1, values.shape[1])
        if self._norm is not None:
            rows = self._norm.weigh(rows)
        if self._together:
            rows = np.moveaxis(rows.reshape(3, len(values), -1), 0, 1).reshape(len(values), -1)
        return rows


def _principal(rows: Array, count: int) -> Array:
    """The `count` leading right singular vectors of rows [N,M] as columns, by subspace iteration."""
    count = min(count, *rows.shape)
    start = np.random.default_rng(0).normal(size=(min(count + _OVERSAMPLED, *rows.shape), rows.shape[0]))
    found = start @ rows
    for _ in range(_ITERATIONS):
        found = np.linalg.qr(found.T)[0].T
        found = (rows @ found.T).T @ rows
    space = np.linalg.qr(found.T)[0]
    return np.asarray(space @ np.linalg.svd(rows @ space, full_matrices=False)[2].T[:, :count])
