"""Integrates bins over one nested lattice per vertex, each over as many of its sizes as it needs.

A bin can be compared with its prediction direction by direction, so only the *difference* is integrated. It has far
less detail than Ŝ and needs far fewer directions (a multilevel Monte Carlo estimate: Heinrich, "Multilevel Monte Carlo
methods", 2001). Bins that are rougher than the prediction from their neighbours are integrated over their own lattices.
Each vertex has its own rotation of the lattice, and a least-squares fit over it is unbiased (`bakers.projection`).
"""

from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bakers.adaptive.block_state import LEAST_OWN_SHARE, BlockState, batches, variance_factors
from bakers.adaptive.covariance_sums import SHARED
from bakers.adaptive.records import RefinementSettings
from bakers.adaptive.view_levels import STENCIL, Level
from bakers.error_covariance import rotated
from bakers.evaluation import values_at

Array = NDArray[np.float64]
Index = NDArray[np.int64]

ATTEMPTS = 6


class Prediction(NamedTuple):
    """Interpolation of M bins from their parents."""

    parents: Index
    """[M,S]"""
    weights: Array
    """[M,S]"""
    coefficients: Array
    """[M,K·3]"""
    noise: Array
    """[M]"""


class SharedLatticeState(BlockState):
    """State with a nested lattice for each vertex."""

    def __init__(
        self, transport: object, settings: RefinementSettings, vertices: Index, positions: Array, outgoing: Array
    ) -> None:
        super().__init__(transport, settings, vertices, positions, outgoing)
        n, bins = outgoing.shape[:2]
        self.sizes_known = np.zeros((bins, n), np.int64)
        """Number of lattice sizes for which a bin has values, evaluated or interpolated."""
        self.sizes_evaluated = np.zeros((bins, n), np.int64)
        """Number of lattice sizes for which a bin was evaluated."""
        self.values: list[NDArray[np.float32]] = []
        self.lattice_factors = variance_factors(settings.noise, self.lattice.variance_shares, self.lattice.sizes)
        self.difference_factor = settings.noise.of_differences
        beginning = np.concatenate([level.bins for level in settings.levels[: settings.full_levels + 1]])
        bins_, rows = (axis.ravel() for axis in np.meshgrid(beginning, np.arange(n), indexing="ij"))
        self._grow(rows, bins_, np.full(len(rows), self.settings.initial_sizes))

    def start(self, level: Level, tolerated: float) -> None:
        """Evaluates the bins of level 0, for which there is no prediction and no known scale."""
        places, rows = np.nonzero(np.ones((len(level.bins), len(self.positions)), bool))
        bins = level.bins[places]
        self.coefficients[bins, rows] = self._fit_values(rows, bins)[0]
        self.measure_scale(0)
        self._converge(rows, bins, None, tolerated)

    def evaluate(self, number: int, level: Level, places: Index, rows: Index, tolerated: float) -> None:
        """Evaluates bins of a level: places [M] in the level and rows [M] of the vertices."""
        bins = level.bins[places]
        parents, weights = level.parents[places], level.weights[places]
        prediction = Prediction(parents, weights, self.coefficients[bins, rows], self.noise[bins, rows])
        self._grow(rows, bins, np.full(len(rows), self.settings.initial_sizes))
        self._predict_values(rows, parents, number)
        self._converge(rows, bins, prediction, tolerated)

    def noise_of_difference(self, rows: Index, bins: Index, predicted: Array, independent: Array) -> Array:
        """Noise of the difference. Own lattices are independent of the prediction; the shared lattice's noise is
        common.
        """
        noise = self.noise[bins, rows]
        return np.asarray(np.where(self.own_lattice[bins, rows], noise + predicted, np.maximum(noise - predicted, 0.0)))

    def add_lattice_covariance(self) -> None:
        """Adds the error covariance of bins that share a lattice, from the residuals of their fits."""
        bins, rows = np.nonzero((self.sizes_evaluated > 0) & ~self.own_lattice)
        sizes = self.sizes_evaluated[bins, rows]
        for size in np.unique(sizes):
            for some in batches(np.flatnonzero(sizes == size), self.lattice.sizes[size - 1]):
                r, b = rows[some], bins[some]
                covariance, channels = self.lattice.error_sums(self._values(size, r, b), size - 1)
                covariance = rotated(covariance, self.view_matrices(r, b) @ self.to_world[r])
                self.covariance_sums.add(SHARED, r, covariance, channels, self.noise[b, r])

    def _converge(self, rows: Index, bins: Index, prediction: Prediction | None, tolerated: float) -> None:
        """Adds directions at bins (rows [M], bins [M]) until their noise is tolerable, by the cheapest of three
        methods: integrating the difference from the prediction over part of the shared lattice, integrating the values
        over all sizes that were evaluated, or evaluating more sizes or an own lattice.
        """
        here = np.arange(len(rows))
        for _attempt in range(ATTEMPTS):
            if not len(here):
                return
            r, b = rows[here], bins[here]
            allowed = tolerated * self.scale[r]
            coefficients, noise, residual = self._fit_values(r, b)
            grown = self._sizes_needed(residual, allowed)
            better = np.zeros(len(here), bool)
            if prediction is not None:
                parents, weights = prediction.parents[here], prediction.weights[here]
                predicted, carried = prediction.coefficients[here], prediction.noise[here]
                remaining = np.maximum(allowed - carried, LEAST_OWN_SHARE * allowed)
                difference, own, difference_residual = self._fit_differences(r, b, parents, weights)
                taken = np.minimum(self._sizes_needed(difference_residual, remaining), len(self.lattice_factors))
                possible = self.lattice_factors[taken - 1] * difference_residual <= remaining
                possible &= taken <= self.sizes_known[parents, r[:, None]].min(axis=1)
                better = possible & ((taken <= grown) | (taken <= self.sizes_evaluated[b, r]))
                # Until one is accurate enough, keep the estimate with the smaller noise.
                use = better | (~possible & (own + carried < noise))
                coefficients = np.where(use[:, None], predicted + difference, coefficients)
                noise = np.where(use, own + carried, noise)
                grown = np.where(better, taken, grown)
            self.coefficients[b, r], self.noise[b, r], self.independent_noise[b, r] = coefficients, noise, 0.0
            missing = grown > self.sizes_evaluated[b, r]
            own_lattice, further = missing & ~better, missing & better
            self.integrate(r[own_lattice], b[own_lattice], allowed[own_lattice])
            here = here[further]
            self._grow(rows[here], bins[here], grown[further])

    def _sizes_needed(self, residual: Array, allowed: Array) -> Index:
        """Number of lattice sizes [M] after which bins of this residual variance have the allowed variance; 1 if not
        finite.
        """
        enough = ~(residual[:, None] * self.lattice_factors > allowed[:, None])
        return np.where(enough.any(axis=1), enough.argmax(axis=1) + 1, len(self.lattice_factors))

    def _fit_values(self, rows: Index, bins: Index) -> tuple[Array, Array, Array]:
        """Coefficients [M,K·3] from the bins' values, their noise and residual variance [M]."""
        found, residual = np.empty((len(rows), self.coefficients.shape[2])), np.empty(len(rows))
        sizes = self.sizes_evaluated[bins, rows]
        for size in np.unique(sizes):
            which = np.flatnonzero(sizes == size)
            for some in batches(which, self.lattice.sizes[size - 1]):
                values = self._values(size, rows[some], bins[some])
                found[some], residual[some] = self.lattice.fitted(values, size - 1)
        self.residual_variance[bins, rows] = residual
        return found, residual * self.lattice_factors[sizes - 1], residual

    def _fit_differences(self, rows: Index, bins: Index, parents: Index, weights: Array) -> tuple[Array, Array, Array]:
        """Coefficients [M,K·3] of the difference of bins from their predictions, its noise, and the residual variance
        [M] with which Ŝ itself would have that noise.
        """
        found, residual = np.empty((len(rows), self.coefficients.shape[2])), np.empty(len(rows))
        common = np.minimum(self.sizes_evaluated[bins, rows], self.sizes_known[parents, rows[:, None]].min(axis=1))
        for size in np.unique(common):
            which = np.flatnonzero(common == size)
            for some in batches(which, self.lattice.sizes[size - 1] * parents.shape[1]):
                values = self._values(size, rows[some], bins[some])
                of_parents = self._values(size, rows[some][:, None], parents[some])
                values -= weighted_sum(weights[some], of_parents)
                found[some], residual[some] = self.lattice.fitted(values, size - 1)
        residual *= self.difference_factor
        return found, residual * self.lattice_factors[common - 1], residual

    def _values(self, size: int, rows: Index, bins: Index) -> NDArray[np.float32]:
        """Values [..., D, 3] of bins in the first `size` sizes of the lattice."""
        return np.concatenate([part[bins, rows] for part in self.values[:size]], axis=-2)

    def _predict_values(self, rows: Index, parents: Index, number: int) -> None:
        """Interpolates values, in the first lattice size, of interpolated bins that are now parents."""
        width, wanted = len(self.positions), [np.empty(0, np.int64)] * number
        missing = np.unique(parents * width + rows[:, None])
        for below in range(number - 1, self.settings.full_levels, -1):
            level = self.settings.levels[below]
            at, row = np.divmod(missing, width)
            unknown = (level.place[at] >= 0) & (self.sizes_known[at, row] == 0)
            wanted[below] = missing[unknown]
            theirs = level.parents[level.place[at[unknown]]] * width + row[unknown][:, None]
            missing = np.union1d(missing, theirs)
        for below in range(self.settings.full_levels + 1, number):
            level = self.settings.levels[below]
            for some in batches(wanted[below], self.lattice.sizes[0] * STENCIL):
                at, row = np.divmod(some, width)
                place = level.place[at]
                values = self.values[0][level.parents[place], row[:, None]]
                self.values[0][at, row] = weighted_sum(level.weights[place], values)
                self.sizes_known[at, row] = 1

    def _grow(self, rows: Index, bins: Index, sizes: Index) -> None:
        """Evaluates bins up to `sizes` [M] sizes of the lattice."""
        all_bins, n = self.sizes_known.shape
        for size in range(1, int(sizes.max(initial=0)) + 1):
            begin, end = ([0, *self.lattice.sizes])[size - 1 : size + 1]
            if len(self.values) < size:
                self.values.append(np.empty((all_bins, n, end - begin, 3), np.float32))
            missing = np.flatnonzero((sizes >= size) & (self.sizes_evaluated[bins, rows] < size))
            incident = self.lattice.directions[begin:end] @ self.rotations.transpose(0, 2, 1)
            for some in batches(missing, end - begin):
                r, b = rows[some], bins[some]
                evaluate = partial(self._evaluate_batch, incident, r, b)
                self.values[size - 1][b, r], known = self.settings.cache.get(size, self.vertices[r], b, evaluate)
                self.recalled += known * (end - begin)
            r, b = rows[missing], bins[missing]
            self.sizes_evaluated[b, r], self.sizes_known[b, r] = size, np.maximum(self.sizes_known[b, r], size)
            self.directions_used[b, r] += end - begin
            self.evaluations += len(missing) * (end - begin)

    def _evaluate_batch(self, incident: Array, rows: Index, bins: Index, some: Index) -> NDArray[np.float32]:
        """Ŝ [m,D,3] at some of these bins, each in its vertex's directions [n,D,3]."""
        r, b = rows[some], bins[some]
        values = values_at(self.transport, incident, r, self.positions[r], self.outgoing[r, b])
        return values.astype(np.float32, copy=False)


def weighted_sum(weights: Array, values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Σ_s weights [M,s] · values [M,s,...]."""
    flat = values.reshape(*values.shape[:2], -1)
    return np.asarray((weights.astype(values.dtype)[:, None] @ flat)[:, 0]).reshape(len(values), *values.shape[2:])
