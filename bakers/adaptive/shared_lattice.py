"""Bins over one lattice that all of a vertex share, each as long a beginning of it as it needs.

What is foretold of a bin can then be held against it direction by direction: only the *difference* is integrated, which
has far less detail than Ŝ itself and needs far fewer directions (a multilevel Monte Carlo estimate: Heinrich,
"Multilevel Monte Carlo methods", 2001). Where Ŝ is rougher than its neighbours allow for, the bin is integrated on its
own. The lattice is turned anew at every vertex, and a fit by least squares over it is unbiased (`bakers.projection`).
"""

from functools import partial

import numpy as np
from numpy.typing import NDArray

from bakers.adaptive.block_state import LEAST_SHARE, Work, lots, unit
from bakers.adaptive.covariance_sums import SHARED
from bakers.adaptive.records import Refinement
from bakers.adaptive.view_levels import STENCIL, Level
from bakers.error_covariance import turned
from bakers.evaluation import values_at

Array = NDArray[np.float64]
Index = NDArray[np.int64]

ATTEMPTS = 6


class SharedWork(Work):
    """Work over the lattice that grows."""

    def __init__(
        self, transport: object, refinement: Refinement, vertices: Index, positions: Array, outgoing: Array
    ) -> None:
        super().__init__(transport, refinement, vertices, positions, outgoing)
        n, bins = outgoing.shape[:2]
        self.known = np.zeros((bins, n), np.int64)
        """How many sizes of the lattice a bin has values for, evaluated or foretold."""
        self.evaluated = np.zeros((bins, n), np.int64)
        """The same, evaluated alone."""
        self.values: list[NDArray[np.float32]] = []
        self.unit = unit(refinement.noise, self.lattice.variance_shares, self.lattice.sizes)
        self.of_differences = refinement.noise.of_differences
        beginning = np.concatenate([level.bins for level in refinement.levels[: refinement.always + 1]])
        bins_, rows = (axis.ravel() for axis in np.meshgrid(beginning, np.arange(n), indexing="ij"))
        self._grow(rows, bins_, np.full(len(rows), self.how.begin))

    def begin(self, level: Level, tolerated: float) -> None:
        """Evaluates the coarsest bins, which nothing foretells and no scale is known for."""
        places, rows = np.nonzero(np.ones((len(level.bins), len(self.positions)), bool))
        bins = level.bins[places]
        self.coefficients[bins, rows] = self._direct(rows, bins)[0]
        self.measure(0)
        self._settle(rows, bins, None, tolerated)

    def evaluate(self, number: int, level: Level, places: Index, rows: Index, tolerated: float) -> None:
        """Evaluates the bins of a level at these places [M] of the vertices in these rows [M]."""
        bins = level.bins[places]
        foretold, carried = self.coefficients[bins, rows], self.noise[bins, rows]
        self._grow(rows, bins, np.full(len(rows), self.how.begin))
        self._foretell_values(rows, level.parents[places], number)
        self._settle(rows, bins, (level.parents[places], level.weights[places], foretold, carried), tolerated)

    def noise_of_difference(self, rows: Index, bins: Index, foretold: Array, alone: Array) -> Array:
        """What is foretold of a bin errs apart from one that was integrated alone, and together with others."""
        noise = self.noise[bins, rows]
        return np.asarray(np.where(self.apart[bins, rows], noise + foretold, np.maximum(noise - foretold, 0.0)))

    def add_shapes(self) -> None:
        """Tells how errors hang together that bins have from the lattice, by what fits over it leave over."""
        bins, rows = np.nonzero((self.evaluated > 0) & ~self.apart)
        sizes = self.evaluated[bins, rows]
        for size in np.unique(sizes):
            for some in lots(np.flatnonzero(sizes == size), self.lattice.sizes[size - 1]):
                r, b = rows[some], bins[some]
                covariance, channels = self.lattice.shape(self._values(size, r, b), size - 1)
                covariance = turned(covariance, self.views(r, b) @ self.turn[r])
                self.shapes.add(SHARED, r, covariance, channels, self.noise[b, r])

    def _settle(
        self, rows: Index, bins: Index, foretold: tuple[Index, Array, Array, Array] | None, tolerated: float
    ) -> None:
        """Takes more directions at bins (rows [M], bins [M]) until their noise is tolerable, by the cheapest of three
        ways: integrating what they differ by from what was foretold of them, over as much of the shared lattice as that
        takes; integrating them over all of it that they have; or over more of it, or a lattice of their own.
        """
        here = np.arange(len(rows))
        for _attempt in range(ATTEMPTS):
            if not len(here):
                return
            r, b = rows[here], bins[here]
            allowed = tolerated * self.scale[r]
            coefficients, noise, rough = self._direct(r, b)
            grown = self._steps(rough, allowed)
            better = np.zeros(len(here), bool)
            if foretold is not None:
                parents, weights = foretold[0][here], foretold[1][here]
                before, carried = foretold[2][here], foretold[3][here]
                left = np.maximum(allowed - carried, LEAST_SHARE * allowed)
                difference, own, apart = self._difference(r, b, parents, weights)
                taken = np.minimum(self._steps(apart, left), len(self.unit))
                possible = self.unit[taken - 1] * apart <= left
                possible &= taken <= self.known[parents, r[:, None]].min(axis=1)
                better = possible & ((taken <= grown) | (taken <= self.evaluated[b, r]))
                # While neither is good enough, what is nearer to the truth is kept.
                use = better | (~possible & (own + carried < noise))
                coefficients = np.where(use[:, None], before + difference, coefficients)
                noise = np.where(use, own + carried, noise)
                grown = np.where(better, taken, grown)
            self.coefficients[b, r], self.noise[b, r], self.alone[b, r] = coefficients, noise, 0.0
            lacking = grown > self.evaluated[b, r]
            alone, further = lacking & ~better, lacking & better
            self.integrate(r[alone], b[alone], allowed[alone])
            here = here[further]
            self._grow(rows[here], bins[here], grown[further])

    def _steps(self, rough: Array, allowed: Array) -> Index:
        """How many sizes of the lattice it takes [M] until bins of this squared roughness have the variance allowed;
        one for what is not finite.
        """
        enough = ~(rough[:, None] * self.unit > allowed[:, None])
        return np.where(enough.any(axis=1), enough.argmax(axis=1) + 1, len(self.unit))

    def _direct(self, rows: Index, bins: Index) -> tuple[Array, Array, Array]:
        """Coefficients [M,K·3] of bins on their own, their noise and squared roughness [M]."""
        found, rough = np.empty((len(rows), self.coefficients.shape[2])), np.empty(len(rows))
        sizes = self.evaluated[bins, rows]
        for size in np.unique(sizes):
            which = np.flatnonzero(sizes == size)
            for some in lots(which, self.lattice.sizes[size - 1]):
                values = self._values(size, rows[some], bins[some])
                found[some], rough[some] = self.lattice.fitted(values, size - 1)
        self.rough[bins, rows] = rough
        return found, rough * self.unit[sizes - 1], rough

    def _difference(self, rows: Index, bins: Index, parents: Index, weights: Array) -> tuple[Array, Array, Array]:
        """What bins differ by from what is foretold of them: coefficients [M,K·3], noise, and the squared roughness
        [M] that Ŝ itself would have with that noise.
        """
        found, rough = np.empty((len(rows), self.coefficients.shape[2])), np.empty(len(rows))
        common = np.minimum(self.evaluated[bins, rows], self.known[parents, rows[:, None]].min(axis=1))
        for size in np.unique(common):
            which = np.flatnonzero(common == size)
            for some in lots(which, self.lattice.sizes[size - 1] * parents.shape[1]):
                values = self._values(size, rows[some], bins[some])
                of_parents = self._values(size, rows[some][:, None], parents[some])
                values -= combined(weights[some], of_parents)
                found[some], rough[some] = self.lattice.fitted(values, size - 1)
        rough *= self.of_differences
        return found, rough * self.unit[common - 1], rough

    def _values(self, size: int, rows: Index, bins: Index) -> NDArray[np.float32]:
        """Values [..., D, 3] of bins in the first `size` sizes of the lattice."""
        return np.concatenate([part[bins, rows] for part in self.values[:size]], axis=-2)

    def _foretell_values(self, rows: Index, parents: Index, number: int) -> None:
        """Values, in the first size of the lattice, of bins that were only foretold and are now parents themselves."""
        width, wanted = len(self.positions), [np.empty(0, np.int64)] * number
        missing = np.unique(parents * width + rows[:, None])
        for below in range(number - 1, self.how.always, -1):
            level = self.how.levels[below]
            at, row = np.divmod(missing, width)
            unknown = (level.place[at] >= 0) & (self.known[at, row] == 0)
            wanted[below] = missing[unknown]
            theirs = level.parents[level.place[at[unknown]]] * width + row[unknown][:, None]
            missing = np.union1d(missing, theirs)
        for below in range(self.how.always + 1, number):
            level = self.how.levels[below]
            for some in lots(wanted[below], self.lattice.sizes[0] * STENCIL):
                at, row = np.divmod(some, width)
                place = level.place[at]
                values = self.values[0][level.parents[place], row[:, None]]
                self.values[0][at, row] = combined(level.weights[place], values)
                self.known[at, row] = 1

    def _grow(self, rows: Index, bins: Index, sizes: Index) -> None:
        """Evaluates bins up to `sizes` [M] sizes of the lattice."""
        all_bins, n = self.known.shape
        for size in range(1, int(sizes.max(initial=0)) + 1):
            begin, end = ([0, *self.lattice.sizes])[size - 1 : size + 1]
            if len(self.values) < size:
                self.values.append(np.empty((all_bins, n, end - begin, 3), np.float32))
            missing = np.flatnonzero((sizes >= size) & (self.evaluated[bins, rows] < size))
            incident = self.lattice.directions[begin:end] @ self.rotations.transpose(0, 2, 1)
            for some in lots(missing, end - begin):
                r, b = rows[some], bins[some]
                ask = partial(self._values_of, incident, r, b)
                self.values[size - 1][b, r], known = self.how.answers.given(size, self.vertices[r], b, ask)
                self.recalled += known * (end - begin)
            r, b = rows[missing], bins[missing]
            self.evaluated[b, r], self.known[b, r] = size, np.maximum(self.known[b, r], size)
            self.spent[b, r] += end - begin
            self.evaluations += len(missing) * (end - begin)

    def _values_of(self, incident: Array, rows: Index, bins: Index, some: Index) -> NDArray[np.float32]:
        """Ŝ [m,D,3] at some of these bins, each in its vertex's directions [n,D,3]."""
        r, b = rows[some], bins[some]
        values = values_at(self.transport, incident, r, self.positions[r], self.outgoing[r, b])
        return values.astype(np.float32, copy=False)


def combined(weights: Array, values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Σ_s weights [M,s] · values [M,s,...]."""
    flat = values.reshape(*values.shape[:2], -1)
    return np.asarray((weights.astype(values.dtype)[:, None] @ flat)[:, 0]).reshape(len(values), *values.shape[2:])
