"""Principal components of Ŝ as functions of ωi, several for each lattice, and least-squares fits of bins to them."""

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import qr

from bakers.adaptive.lattice_pools import Pool

Array = NDArray[np.float64]
Index = NDArray[np.int64]

PROBE_STAGES = (8, 4), (16, 8)
"""Number of probe directions, and of the newest components that are fitted there: in the first stage, and in the second
where the first is not accurate enough.
"""
MOST_COMPONENTS = PROBE_STAGES[-1][1]
"""Most components of a lattice; further ones replace the oldest."""
COEFFICIENT_SHARE = 0.5
"""Fraction of the residual energy of a fit that may be in the coefficients."""
ROUNDING = 2.0**-20
"""Relative rounding error of the values."""
LEAST_NEW_ENERGY = 0.02
"""Least fraction of the new energy that a further component must have."""
LEAST_VISIBILITY = 0.1
"""Least visibility of every combination of components at the probes, relative to its rms value over the lattice. The
amplitude of a combination that is not visible there is unknown.
"""


class LightComponents:
    """Orthonormal components of each of n lattices over D directions; zeros for unused ones."""

    def __init__(self, pool: Pool, frames: Array) -> None:
        """Starts without components over the lattice of `pool`; `frames` [n,K,K] rotate its coefficients to the vertex
        frame.
        """
        n, (size, count) = len(frames), pool.harmonics.shape
        self._pool, self.frames = pool, frames
        self.probes = np.zeros((n, PROBE_STAGES[-1][0]), np.int64)
        """Probe directions [n,F] of the lattices: those that distinguish the first components, then directions in
        between.
        """
        self.values = np.zeros((n, size, MOST_COMPONENTS))
        """[n,D,R], the newest first"""
        self.counts = np.zeros(n, np.int64)
        """Number of components."""
        self._coefficients = np.zeros((n, count, MOST_COMPONENTS))
        self._residual_gram = np.zeros((n, MOST_COMPONENTS, MOST_COMPONENTS))
        self._fits = [np.zeros((n, most, directions)) for directions, most in PROBE_STAGES]
        self._variance_factors = [np.full(n, COEFFICIENT_SHARE * 4.0 * np.pi / count) for _stage in PROBE_STAGES]

    def fit(self, rows: Index, values: Array, stage: int) -> tuple[Array, Array]:
        """Amplitudes [M,R,3] of the components of these lattices [M] in values [M,F,3] at the probes, and the variance
        [M], mean over K and channels, of coefficients made of them.
        """
        directions, most = PROBE_STAGES[stage]
        probed = values[:, :directions]
        amplitudes = self._fits[stage][rows] @ probed
        functions = self.values[rows[:, None], self.probes[rows, :directions], :most]
        residual = ((probed - functions @ amplitudes) ** 2).sum(axis=1).mean(axis=1)
        freedom = directions - np.minimum(self.counts[rows], most)
        variance = residual / freedom + ROUNDING**2 * (probed**2).mean(axis=(1, 2))
        return amplitudes, variance * self._variance_factors[stage][rows]

    def coefficients(self, rows: Index, amplitudes: Array) -> Array:
        """Coefficients [M,K·3] of amplitudes [M,r,3] of the newest components."""
        found = self._coefficients[rows, :, : amplitudes.shape[1]] @ amplitudes
        return found.reshape(len(rows), self._coefficients.shape[1] * 3)

    def residual_variance(self, rows: Index, amplitudes: Array) -> Array:
        """Mean square residual [M] per degree of freedom of fitting harmonics to these amplitudes."""
        most = amplitudes.shape[1]
        return np.asarray(
            np.einsum("mrc,mrs,msc->m", amplitudes, self._residual_gram[rows, :most, :most], amplitudes) / 3.0
        )

    def to_vertex_frame(self, rows: Index, plain: Array) -> Array:
        """Coefficients [M,K·3] in the vertex frame, from those in the lattice's own frame [M,K,3]."""
        return (self.frames[rows] @ plain).reshape(len(rows), plain.shape[1] * 3)

    def learn(self, rows: Index, values: Array) -> None:
        """Adds what is new in values [m,D,3], one set for each of these lattices; a lattice may occur several times."""
        for row, found in zip(rows, values, strict=True):
            old = self.values[row]
            sides, sizes, _channels = np.linalg.svd(found - old @ (old.T @ found), full_matrices=False)
            new = sides[:, sizes**2 > max(LEAST_NEW_ENERGY * (sizes**2).sum(), ROUNDING**2 * (found**2).sum())]
            self.values[row] = np.column_stack([new, old])[:, :MOST_COMPONENTS]
            self.counts[row] = min(self.counts[row] + new.shape[1], MOST_COMPONENTS)
        self._prepare(np.unique(rows))

    def choose_probes(self, rows: Index) -> None:
        """Chooses the probe directions of these lattices again."""
        for row in rows:
            functions = self.values[row, :, : self.counts[row]]
            self.probes[row] = _probe_directions(functions, self._pool.directions)
        self._prepare(rows)

    def _prepare(self, rows: Index) -> None:
        functions, (size, count) = self.values[rows], self._pool.harmonics.shape
        plain = self._pool.weights @ functions
        self._coefficients[rows] = self.frames[rows] @ plain
        residuals = functions - self._pool.harmonics @ plain
        self._residual_gram[rows] = residuals.transpose(0, 2, 1) @ residuals / (size - count)
        for (directions, most), fits, factors in zip(PROBE_STAGES, self._fits, self._variance_factors, strict=True):
            values = np.take_along_axis(functions[:, :, :most], self.probes[rows, :directions, None], axis=1)
            sizes = np.linalg.svd(values, compute_uv=False)
            used = np.minimum(self.counts[rows], most)
            least = np.take_along_axis(sizes, np.maximum(used - 1, 0)[:, None], axis=1)[:, 0]
            fits[rows] = np.linalg.pinv(values, rcond=1e-6)
            amplification = ((self._coefficients[rows, :, :most] @ fits[rows]) ** 2).sum(axis=(1, 2))
            visible = (used == 0) | (least >= LEAST_VISIBILITY * np.sqrt(directions / size))
            factors[rows] = np.where(visible, (COEFFICIENT_SHARE * 4.0 * np.pi + amplification) / count, np.inf)


def _probe_directions(functions: Array, directions: Array) -> Index:
    """Indices of F of the directions [D,3]: those that distinguish the functions [D,R], and others far from these."""
    probes = np.empty(PROBE_STAGES[-1][0], np.int64)
    first = min(functions.shape[1], PROBE_STAGES[0][1])
    if first:
        probes[:first] = qr(functions[:, :first].T, mode="r", pivoting=True)[1][:first]
    else:
        probes[0], first = 0, 1
    nearest = (directions @ directions[probes[:first]].T).max(axis=1)
    for place in range(first, len(probes)):
        probes[place] = int(np.argmin(nearest))
        nearest = np.maximum(nearest, directions @ directions[probes[place]])
    return probes
