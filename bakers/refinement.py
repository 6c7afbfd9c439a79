"""Bakes a block of vertices to a tolerance: few view bins first, finer ones where they are not foretold well enough,
and at each bin as many directions as it takes.

Level by level (`bakers.view_levels`) the bins of the next level are foretold from those that are known. Where those
beside one came as no surprise the prediction is kept; elsewhere Ŝ is evaluated. All bins of a vertex take their
directions from one lattice, each as long a beginning of it as it needs, so that what is foretold of a bin can be held
against it direction by direction: only the *difference* is integrated, which has far less detail than Ŝ itself and
needs far fewer directions (a multilevel Monte Carlo estimate: Heinrich, "Multilevel Monte Carlo methods", 2001). Where
Ŝ is rougher than its neighbours allow for, the bin is integrated on its own. The lattice is turned anew at every
vertex, and a fit by least squares over it is unbiased (`bakers.projection`).

A vertex's numbers depend on itself alone: not on the cut of the blocks, nor on what is baked beside it.
"""

from collections.abc import Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from bakers.lattice_pools import Pool, Pools
from bakers.light_noise import LightNoise
from bakers.refined import Checks, Refined, Refinement, noise_of_checks
from bakers.values import values_at
from bakers.view_levels import STENCIL, Level
from bakers.view_survey import ALWAYS, DECAY

Array = NDArray[np.float64]
Index = NDArray[np.int64]

VALUES_AT_ONCE = 1 << 17
ATTEMPTS = 6
ALONE, NEARLY = 3, 1.5
"""How often a bin's own lattice is tried, and times the variance allowed that is let pass."""
DECAY_BEFORE = 8.0
"""How many bins' worth the usual decay of errors of prediction counts."""
LEAST_DECAY, MOST_DECAY = 0.15, 1.0
LEVEL_SHARES = (0.4, 0.5, 0.6, 0.75, 0.9, 1.0)
"""Of the tolerated variance, what may have been used up at a level: errors of the coarse ones are carried to all."""
ROUNDING = 2.0**-23
"""Relative error of a coefficient that is never held to be smaller: values and coefficients are kept in float32."""
LEAST_SHARE = 0.15
"""Of the tolerated variance, what a bin may always have of its own."""


def refine(transport: object, refinement: Refinement, vertices: Index, positions: Array, outgoing: Array) -> Refined:
    """Bakes the vertices of these numbers [n] at positions [n,3] seen along outgoing [n,B,3].

    A vertex at which the transport answers something that is not finite has coefficients that are not finite.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        work = Work(transport, refinement, vertices, positions, outgoing)
        for number, level in enumerate(refinement.levels):
            work.add(number, level)
        return work.finished()


class Work:
    """The state of a block between levels: arrays [B,n,…]; coefficients are those in the lattice's own frame."""

    def __init__(
        self, transport: object, refinement: Refinement, vertices: Index, positions: Array, outgoing: Array
    ) -> None:
        n, bins = outgoing.shape[:2]
        self.transport, self.how, self.positions, self.outgoing = transport, refinement, positions, outgoing
        self.lattice, self.vertices = refinement.lattice, vertices
        self.evaluations = self.recalled = 0
        """What it took, and how much of that was known from before."""
        self.rotations = refinement.rotations(vertices)
        self.coefficients = np.zeros((bins, n, self.lattice.count * 3))
        self.noise, self.surprise, self.rough = np.zeros((3, bins, n))
        self.known = np.zeros((bins, n), np.int64)
        """How many sizes of the lattice a bin has values for, evaluated or foretold."""
        self.evaluated = np.zeros((bins, n), np.int64)
        """The same, evaluated alone."""
        self.values: list[NDArray[np.float32]] = []
        self.scale, self.decay = np.full(n, refinement.floor**2), np.full(n, DECAY**2)
        self.unit = _unit(refinement.noise, self.lattice.variance_shares, self.lattice.sizes)
        self.pool_unit = _pool_unit(refinement.pool_noise, refinement.pools)
        self.turn = refinement.rotate(self.rotations)
        self.alone = np.zeros((bins, n))
        """What of the noise is a bin's own, and no other's."""
        self.spent = np.zeros((bins, n), np.int64)
        """Directions that a bin was evaluated in."""
        self.apart = np.zeros((bins, n), bool)
        """Whether a bin was integrated over a lattice of its own."""
        self.of_differences = refinement.noise.of_differences
        self.fewest = int(np.searchsorted(refinement.pools.sizes, self.lattice.sizes[refinement.begin - 1]))
        self.fewest = min(self.fewest, len(self.pool_unit) - 1)
        """The smallest of the lattices of their own that do not miss what there is."""
        if refinement.lattices == "own":
            return
        beginning = np.concatenate([level.bins for level in refinement.levels[: refinement.always + 1]])
        bins_, rows = (axis.ravel() for axis in np.meshgrid(beginning, np.arange(n), indexing="ij"))
        self._grow(rows, bins_, np.full(len(rows), self.how.begin))

    def add(self, number: int, level: Level) -> None:
        """Foretells the bins of a level, and evaluates those that this is not good enough for."""
        tolerated = self.how.light**2 * LEVEL_SHARES[min(number, len(LEVEL_SHARES) - 1)]
        if number == 0:
            self._begin(level, tolerated)
            return
        self._foretell(level)
        wanted = np.isfinite(self.scale) & np.ones((len(level.bins), 1), bool)
        if number > self.how.always:
            wanted &= ~(self.surprise[level.bins] <= self.how.view**2 * self.scale)
        places, rows = np.nonzero(wanted)
        bins = level.bins[places]
        foretold, carried, expected = (part[bins, rows] for part in (self.coefficients, self.noise, self.surprise))
        if self.how.lattices == "own":
            self.integrate(rows, bins, tolerated * self.scale[rows])
        else:
            self._grow(rows, bins, np.full(len(rows), self.how.begin))
            self._foretell_values(rows, level.parents[places], number)
            self._settle(rows, bins, (level.parents[places], level.weights[places], foretold, carried), tolerated)
        off = ((self.coefficients[bins, rows] - foretold) ** 2).mean(axis=1)
        noise, alone = self.noise[bins, rows], self.alone[bins, rows]
        # What is foretold errs apart from a bin that was integrated alone, and together with others.
        noisy = np.where(alone > 0.0, noise + carried, np.maximum(noise - carried, 0.0))
        self.surprise[bins, rows] = np.maximum(off - noisy, 0.0)
        if number > ALWAYS:
            self._learn_decay(rows, expected, self.surprise[bins, rows])
        if number == ALWAYS:
            # The first levels were hardly foretold: they take after the last of them.
            for before in self.how.levels[:number]:
                self.surprise[before.bins] = self.surprise[level.bins].mean(axis=0)
        if number < ALWAYS:
            self._measure(number)

    def _begin(self, level: Level, tolerated: float) -> None:
        """Evaluates the coarsest bins, which nothing foretells and no scale is known for."""
        places, rows = np.nonzero(np.ones((len(level.bins), len(self.positions)), bool))
        bins = level.bins[places]
        if self.how.lattices != "own":
            self.coefficients[bins, rows] = self._direct(rows, bins)[0]
            self._measure(0)
            self._settle(rows, bins, None, tolerated)
            return
        self.integrate(rows, bins, np.full(len(rows), np.inf))
        self._measure(0)
        noisy = np.flatnonzero(self.noise[bins, rows] > tolerated * self.scale[rows])
        self.integrate(rows[noisy], bins[noisy], tolerated * self.scale[rows[noisy]])

    def finished(self) -> Refined:
        """What came of it all, a few bins held against independent directions."""
        variance = self.noise + np.where(self.spent > 0, 0.0, self.surprise) + ROUNDING**2 * self.scale
        variance = np.ascontiguousarray(variance.T)
        n, bins = variance.shape
        own = self.coefficients.transpose(1, 0, 2).reshape(n, bins, -1, 3)
        turned = self.turn[:, None] @ own
        checks = self.check(variance, turned)
        rounded = turned.astype(np.float32), np.sqrt(variance).astype(np.float32)
        shared = 0.0 if self.how.lattices == "own" else np.maximum(self.noise - self.alone, 0.0).sum(axis=0)
        together = (shared / variance.sum(axis=1)).astype(np.float32)
        spent = self.spent.T.astype(np.uint16)
        return Refined(*rounded, spent, self._way().T, together, self.evaluations, self.recalled, checks)

    def _way(self) -> NDArray[np.uint8]:
        """How each bin [B,n] was come by: places in `bakers.refined.WAYS`."""
        return ((self.spent > 0).astype(np.uint8) + self.apart).astype(np.uint8)

    def _measure(self, number: int) -> None:
        """The mean square coefficient of each vertex, by the levels up to this one."""
        known = np.concatenate([level.bins for level in self.how.levels[: number + 1]])
        self.scale = np.maximum((self.coefficients[known] ** 2).mean(axis=(0, 2)), self.how.floor**2)

    def _learn_decay(self, rows: Index, expected: Array, found: Array) -> None:
        """How much smaller each vertex's surprises were at the bins of a level than beside them one level below."""
        many, n = np.bincount(rows, minlength=len(self.decay)), len(self.decay)
        before, after = (np.bincount(rows, np.nan_to_num(part), n) for part in (expected, found))
        usual = DECAY_BEFORE * before / np.maximum(many, 1)
        ratio = (after + DECAY**2 / self.decay * usual) / np.maximum(before + usual, 1e-300)
        self.decay = np.where(before > 0.0, np.clip(self.decay * ratio, LEAST_DECAY**2, MOST_DECAY**2), self.decay)

    def _foretell(self, level: Level) -> None:
        """Coefficients of a level's bins, their noise, roughness and the surprise to be expected, from its parents'."""
        count, n, width = self.coefficients.shape
        own, near = level.combining, level.nearest
        self.coefficients[level.bins] = (own @ self.coefficients.reshape(count, -1)).reshape(-1, n, width)
        together = (own @ np.sqrt(np.maximum(self.noise - self.alone, 0.0))) ** 2
        self.noise[level.bins] = together + level.combining_squares @ self.alone
        self.surprise[level.bins] = self.decay * (near @ self.surprise)
        self.rough[level.bins] = near @ self.rough

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
            for some in _lots(wanted[below], self.lattice.sizes[0] * STENCIL):
                at, row = np.divmod(some, width)
                place = level.place[at]
                values = self.values[0][level.parents[place], row[:, None]]
                self.values[0][at, row] = _combined(level.weights[place], values)
                self.known[at, row] = 1

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
            alone = lacking & ~better & (self.how.lattices == "both")
            further = lacking & ~alone
            self.integrate(r[alone], b[alone], allowed[alone])
            here = here[further]
            self._grow(rows[here], bins[here], grown[further])

    def integrate(self, rows: Index, bins: Index, allowed: Array) -> None:
        """Integrates bins over lattices of their own, as large as it takes for the variance allowed [M]."""
        rough, least = self.rough[bins, rows], np.full(len(rows), self.fewest)
        self.apart[bins, rows] = True
        for _attempt in range(ALONE):
            if not len(rows):
                return
            enough = ~(rough[:, None] * self.pool_unit > allowed[:, None])
            steps = np.where(enough.any(axis=1), enough.argmax(axis=1), len(self.pool_unit) - 1)
            steps = np.maximum(steps, least)
            found, rough = self.fit_alone(rows, bins, steps, 0)
            self.coefficients[bins, rows] = (self.turn[rows].transpose(0, 2, 1) @ found).reshape(len(rows), -1)
            noise = rough * self.pool_unit[steps]
            self.noise[bins, rows] = self.alone[bins, rows] = noise
            self.rough[bins, rows] = rough
            # Rougher than it seemed: once more, unless it is nearly good enough.
            again = (noise > NEARLY * allowed) & (steps < len(self.pool_unit) - 1)
            rows, bins, least = rows[again], bins[again], steps[again] + 1
            allowed, rough = allowed[again], rough[again]

    def fit_alone(self, rows: Index, bins: Index, steps: Index, which: int) -> tuple[Array, Array]:
        """Coefficients [M,K,3], in the world's frame, of bins over lattices of their own, and squared roughness."""
        found, rough = np.empty((len(rows), self.lattice.count, 3)), np.empty(len(rows))
        pools = self.how.pools
        for step in np.unique(steps):
            size = pools.sizes[step]
            pool = pools.of(size)
            for some in _lots(np.flatnonzero(steps == step), size):
                r, b = rows[some], bins[some]
                ask = partial(self._fit_alone, pool, r, b, pools.copies(size, self.vertices[r], b, which))
                fits, known = self.how.answers.given((size, which), self.vertices[r], b, ask)
                found[some], rough[some] = fits[:, :-1].reshape(len(some), -1, 3), fits[:, -1]
                self.recalled += known * size
        taken = np.array(pools.sizes, np.int64)[steps]
        self.evaluations += int(taken.sum())
        if which == 0:
            self.spent[bins, rows] += taken
        return found, rough

    def _fit_alone(self, pool: Pool, rows: Index, bins: Index, copies: Index, some: Index) -> Array:
        """Some of these bins: coefficients and squared roughness [m,K·3+1]."""
        r, b = rows[some], bins[some]
        values = values_at(self.transport, pool.incident, copies[some], self.positions[r], self.outgoing[r, b])
        found, rough = pool.fitted(values, copies[some])
        return np.column_stack([found.reshape(len(some), -1), rough])

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
            for some in _lots(which, self.lattice.sizes[size - 1]):
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
            for some in _lots(which, self.lattice.sizes[size - 1] * parents.shape[1]):
                values = self._values(size, rows[some], bins[some])
                of_parents = self._values(size, rows[some][:, None], parents[some])
                values -= _combined(weights[some], of_parents)
                found[some], rough[some] = self.lattice.fitted(values, size - 1)
        rough *= self.of_differences
        return found, rough * self.unit[common - 1], rough

    def _values(self, size: int, rows: Index, bins: Index) -> NDArray[np.float32]:
        """Values [..., D, 3] of bins in the first `size` sizes of the lattice."""
        return np.concatenate([part[bins, rows] for part in self.values[:size]], axis=-2)

    def _grow(self, rows: Index, bins: Index, sizes: Index) -> None:
        """Evaluates bins up to `sizes` [M] sizes of the lattice."""
        all_bins, n = self.known.shape
        for size in range(1, int(sizes.max(initial=0)) + 1):
            begin, end = ([0, *self.lattice.sizes])[size - 1 : size + 1]
            if len(self.values) < size:
                self.values.append(np.empty((all_bins, n, end - begin, 3), np.float32))
            missing = np.flatnonzero((sizes >= size) & (self.evaluated[bins, rows] < size))
            incident = self.lattice.directions[begin:end] @ self.rotations.transpose(0, 2, 1)
            for some in _lots(missing, end - begin):
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

    def check(self, variance: Array, turned: Array) -> Checks:
        """Holds some bins against two lattices of their own each."""
        rows, bins = np.nonzero(self.how.checks(self.vertices) & np.isfinite(self.scale)[:, None])
        before = self.evaluations
        one, other = self.held(rows, bins, turned)
        squared, noise = (one * other).mean(axis=(1, 2)), noise_of_checks(rows, one, other)
        way, taken = self._way()[bins, rows], self.evaluations - before
        return Checks(rows, way, variance[rows, bins], squared, noise, evaluations=taken)

    def held(self, rows: Index, bins: Index, turned: Array) -> tuple[Array, Array]:
        """What two lattices, which none of the coefficients `turned` [n,B,K,3] were fitted over, say that bins are off
        [M,K,3]: one times the other has the squared error for a mean, however noisy they are.
        """
        # A bin that seems smoother than its vertex may have missed what others have seen.
        rough = np.maximum(self.rough[bins, rows], self.rough.mean(axis=0)[rows])
        allowed = self.how.checked**2 * self.scale[rows]
        enough = ~(rough[:, None] * self.pool_unit > allowed[:, None])
        steps = np.where(enough.any(axis=1), enough.argmax(axis=1), len(self.pool_unit) - 1)
        steps = np.maximum(steps, self.fewest)
        one, other = (self.fit_alone(rows, bins, steps, which)[0] - turned[rows, bins] for which in (1, 2))
        return one, other


def _unit(noise: LightNoise, shares: Sequence[float], sizes: Sequence[int]) -> Array:
    """Variance of a coefficient per squared roughness, for lattices of these sizes."""
    return np.array([noise.variance(share, size) for share, size in zip(shares, sizes, strict=True)])


def _pool_unit(noise: LightNoise, pools: Pools) -> Array:
    # (YᵀY)⁻¹ of a lattice is 4π/D of the identity, to a thousandth: none need be made to know it.
    return _unit(noise, [4.0 * np.pi / size for size in pools.sizes], pools.sizes)


def _combined(weights: Array, values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Σ_s weights [M,s] · values [M,s,...]."""
    flat = values.reshape(*values.shape[:2], -1)
    return np.asarray((weights.astype(values.dtype)[:, None] @ flat)[:, 0]).reshape(len(values), *values.shape[2:])


def _lots(which: Index, width: int) -> list[Index]:
    """`which` in lots of at most VALUES_AT_ONCE values of `width` each."""
    size = max(1, VALUES_AT_ONCE // width)
    return [which[begin : begin + size] for begin in range(0, len(which), size)]
