"""The state of a block of vertices while it is baked to a tolerance, level by level of view bins; each bin that is not
foretold is integrated over a lattice of its own.
"""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bakers.adaptive.covariance_sums import ALONE, FORETOLD, ShapeSums
from bakers.adaptive.fit_residual import LightNoise
from bakers.adaptive.lattice_pools import Pool, Pools
from bakers.adaptive.records import Checks, Refined, Refinement, noise_of_checks
from bakers.adaptive.view_levels import Level
from bakers.adaptive.view_survey import ALWAYS, DECAY
from bakers.error_covariance import of_residuals, turned
from bakers.evaluation import values_at
from formats.asset.error_covariance import ErrorShape, pairs

Array = NDArray[np.float64]
Index = NDArray[np.int64]

VALUES_AT_ONCE = 1 << 17
MOST_ATTEMPTS, NEARLY = 3, 1.5
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


class Fits(NamedTuple):
    """Of M bins over lattices of their own, in the world's frame."""

    coefficients: Array
    """[M,K,3]"""
    rough: Array
    """[M], squared"""
    covariance: Array
    """[M,P], and"""
    channels: Array
    """[M,3]: how their errors hang together, of any size."""


class Work:
    """The state of a block between levels: arrays [B,n,…]; coefficients are those in the turned frame of the vertex."""

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
        self.scale, self.decay = np.full(n, refinement.floor**2), np.full(n, DECAY**2)
        self.pool_unit = pool_unit(refinement.pool_noise, refinement.pools)
        self.turn = refinement.rotate(self.rotations)
        self.alone = np.zeros((bins, n))
        """What of the noise is a bin's own, and no other's."""
        self.spent = np.zeros((bins, n), np.int64)
        """Directions that a bin was evaluated in."""
        self.apart = np.zeros((bins, n), bool)
        """Whether a bin was integrated over a lattice of its own."""
        self.fewest = int(np.searchsorted(refinement.pools.sizes, self.lattice.sizes[refinement.begin - 1]))
        self.fewest = min(self.fewest, len(self.pool_unit) - 1)
        """The smallest of the lattices of their own that do not miss what there is."""
        self.shapes = ShapeSums(n, self.lattice.count)

    def add(self, number: int, level: Level) -> None:
        """Foretells the bins of a level, and evaluates those that this is not good enough for."""
        tolerated = self.how.light**2 * LEVEL_SHARES[min(number, len(LEVEL_SHARES) - 1)]
        if number == 0:
            self.begin(level, tolerated)
            return
        self.foretell(level)
        wanted = np.isfinite(self.scale) & np.ones((len(level.bins), 1), bool)
        if number > self.how.always:
            wanted &= ~(self.surprise[level.bins] <= self.how.view**2 * self.scale)
        places, rows = np.nonzero(wanted)
        bins = level.bins[places]
        foretold, noise, alone, expected = (
            part[bins, rows].copy() for part in (self.coefficients, self.noise, self.alone, self.surprise)
        )
        self.evaluate(number, level, places, rows, tolerated)
        difference = self.coefficients[bins, rows] - foretold
        in_world = self.turn[rows] @ difference.reshape(len(rows), self.lattice.count, 3)
        self.shapes.add_errors(FORETOLD, rows, self.in_view(rows, bins, in_world))
        off = (difference**2).mean(axis=1)
        self.surprise[bins, rows] = np.maximum(off - self.noise_of_difference(rows, bins, noise, alone), 0.0)
        if number > ALWAYS:
            self._learn_decay(rows, expected, self.surprise[bins, rows])
        if number == ALWAYS:
            # The first levels were hardly foretold: they take after the last of them.
            for before in self.how.levels[:number]:
                self.surprise[before.bins] = self.surprise[level.bins].mean(axis=0)
        if number < ALWAYS:
            self.measure(number)

    def begin(self, level: Level, tolerated: float) -> None:
        """Evaluates the coarsest bins, which nothing foretells and no scale is known for."""
        places, rows = np.nonzero(np.ones((len(level.bins), len(self.positions)), bool))
        bins = level.bins[places]
        self.integrate(rows, bins, np.full(len(rows), np.inf))
        self.measure(0)
        noisy = np.flatnonzero(self.noise[bins, rows] > tolerated * self.scale[rows])
        self.integrate(rows[noisy], bins[noisy], tolerated * self.scale[rows[noisy]])

    def evaluate(self, number: int, level: Level, places: Index, rows: Index, tolerated: float) -> None:
        """Evaluates the bins of a level at these places [M] of the vertices in these rows [M]."""
        self.integrate(rows, level.bins[places], tolerated * self.scale[rows])

    def noise_of_difference(self, rows: Index, bins: Index, foretold: Array, alone: Array) -> Array:
        """The variance [M] that bins and what was foretold of them differ by for their noise alone; `foretold` and
        `alone` [M] are the noise of the latter, and what of it errs apart.
        """
        return np.asarray(self.noise[bins, rows] + foretold)

    def integrate(self, rows: Index, bins: Index, allowed: Array) -> None:
        """Integrates bins over lattices of their own, as large as it takes for the variance allowed [M]."""
        rough, least = self.rough[bins, rows], np.full(len(rows), self.fewest)
        self.apart[bins, rows] = True
        for attempt in range(MOST_ATTEMPTS):
            if not len(rows):
                return
            enough = ~(rough[:, None] * self.pool_unit > allowed[:, None])
            steps = np.where(enough.any(axis=1), enough.argmax(axis=1), len(self.pool_unit) - 1)
            steps = np.maximum(steps, least)
            fits = self.fit_alone(rows, bins, steps, 0)
            found, rough = fits.coefficients, fits.rough
            self.coefficients[bins, rows] = (self.turn[rows].transpose(0, 2, 1) @ found).reshape(len(rows), -1)
            noise = rough * self.pool_unit[steps]
            self.noise[bins, rows] = self.alone[bins, rows] = noise
            self.rough[bins, rows] = rough
            # Rougher than it seemed: once more, unless it is nearly good enough.
            again = (noise > NEARLY * allowed) & (steps < len(self.pool_unit) - 1) & (attempt < MOST_ATTEMPTS - 1)
            done = ~again
            seen = self.views(rows[done], bins[done])
            covariance = turned(fits.covariance[done], seen)
            self.shapes.add(ALONE, rows[done], covariance, fits.channels[done], noise[done])
            rows, bins, least = rows[again], bins[again], steps[again] + 1
            allowed, rough = allowed[again], rough[again]

    def finished(self) -> Refined:
        """What came of it all, a few bins held against independent directions."""
        variance = self.noise + np.where(self.spent > 0, 0.0, self.surprise) + ROUNDING**2 * self.scale
        variance = np.ascontiguousarray(variance.T)
        n, bins = variance.shape
        own = self.coefficients.transpose(1, 0, 2).reshape(n, bins, -1, 3)
        in_world = self.turn[:, None] @ own
        checks = self.check(variance, in_world)
        shared = 0.0 if self.how.lattices == "own" else np.maximum(self.noise - self.alone, 0.0).sum(axis=0)
        shape = self._shape(variance)
        return Refined(
            in_world.astype(np.float32),
            np.sqrt(variance).astype(np.float32),
            self.spent.T.astype(np.uint16),
            self._way().T,
            (shared / variance.sum(axis=1)).astype(np.float32),
            shape.covariance,
            shape.channels,
            shape.apart,
            self.evaluations,
            self.recalled,
            checks,
        )

    def _shape(self, variance: Array) -> ErrorShape:
        """How errors of this variance [n,B] hang together: what is foretold errs as what it was foretold from, which
        bins beside each other have in common, and by what was not foreseen.
        """
        self.add_shapes()
        foretold = self.spent == 0
        apart = np.where(foretold, 0.0, self.alone).sum(axis=0) / variance.sum(axis=1)
        shared, alone = (np.where(self.apart == which, self.noise, 0.0) for which in (False, True))
        shared, alone = (np.where(foretold, 0.0, each).sum(axis=0) for each in (shared, alone))
        carried = self.noise.sum(axis=0) / np.maximum(shared + alone, 1e-300)
        surprise = np.where(foretold, self.surprise, 0.0).sum(axis=0)
        return self.shapes.finished(np.stack([surprise, carried * shared, carried * alone]), apart)

    def in_view(self, rows: Index, bins: Index, coefficients: Array) -> Array:
        """Coefficients [M,K,3] of the world's frame in those of the views of these bins."""
        return self.how.frames.in_view(self.vertices[rows], self.outgoing[rows, bins], coefficients)

    def views(self, rows: Index, bins: Index) -> Array:
        """What takes coefficients there, [M,K,K]."""
        return self.how.frames.matrices(self.vertices[rows], self.outgoing[rows, bins], self.lattice.count)

    def add_shapes(self) -> None:
        """Tells how errors hang together that bins have from lattices that they share."""

    def _way(self) -> NDArray[np.uint8]:
        """How each bin [B,n] was come by: places in `bakers.adaptive.records.WAYS`."""
        return ((self.spent > 0).astype(np.uint8) + self.apart).astype(np.uint8)

    def fit_alone(self, rows: Index, bins: Index, steps: Index, which: int) -> Fits:
        """Fits of bins over lattices of their own."""
        count = self.lattice.count
        cuts = np.cumsum([count * 3, 1, pairs(count)])
        found, pools = np.empty((len(rows), int(cuts[-1]) + 3)), self.how.pools
        for step in np.unique(steps):
            size = pools.sizes[step]
            pool = pools.of(size)
            for some in lots(np.flatnonzero(steps == step), size):
                r, b = rows[some], bins[some]
                ask = partial(self._fit_alone, pool, r, b, pools.copies(size, self.vertices[r], b, which))
                found[some], known = self.how.answers.given((size, which), self.vertices[r], b, ask)
                self.recalled += known * size
        taken = np.array(pools.sizes, np.int64)[steps]
        self.evaluations += int(taken.sum())
        if which == 0:
            self.spent[bins, rows] += taken
        coefficients, rough, covariance, channels = np.split(found, cuts, axis=1)
        return Fits(coefficients.reshape(len(rows), count, 3), rough[:, 0], covariance, channels)

    def _fit_alone(self, pool: Pool, rows: Index, bins: Index, copies: Index, some: Index) -> Array:
        """Some of these bins: coefficients, squared roughness, covariance and channels [m,K·3+1+P+3]."""
        r, b = rows[some], bins[some]
        values = values_at(self.transport, pool.incident, copies[some], self.positions[r], self.outgoing[r, b])
        found, left, rough = pool.fitted(values, copies[some])
        covariance, channels = of_residuals(left, pool.products)
        covariance = turned(covariance, pool.back[copies[some]])
        return np.column_stack([found.reshape(len(some), -1), rough, covariance, channels])

    def check(self, variance: Array, coefficients: Array) -> Checks:
        """Holds some bins against two lattices of their own each."""
        rows, bins = np.nonzero(self.how.checks(self.vertices) & np.isfinite(self.scale)[:, None])
        before = self.evaluations
        one, other = self.held(rows, bins, coefficients)
        squared, noise = (one * other).mean(axis=(1, 2)), noise_of_checks(rows, one, other)
        way, taken = self._way()[bins, rows], self.evaluations - before
        return Checks(rows, way, variance[rows, bins], squared, noise, evaluations=taken)

    def held(self, rows: Index, bins: Index, coefficients: Array) -> tuple[Array, Array]:
        """What two lattices, which none of the coefficients [n,B,K,3] were fitted over, say that bins are off [M,K,3]:
        one times the other has the squared error for a mean, however noisy they are.
        """
        # A bin that seems smoother than its vertex may have missed what others have seen.
        rough = np.maximum(self.rough[bins, rows], self.rough.mean(axis=0)[rows])
        allowed = self.how.checked**2 * self.scale[rows]
        enough = ~(rough[:, None] * self.pool_unit > allowed[:, None])
        steps = np.where(enough.any(axis=1), enough.argmax(axis=1), len(self.pool_unit) - 1)
        steps, there = np.maximum(steps, self.fewest), coefficients[rows, bins]
        one, other = (self.fit_alone(rows, bins, steps, which).coefficients - there for which in (1, 2))
        return one, other

    def measure(self, number: int) -> None:
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

    def foretell(self, level: Level) -> None:
        """Coefficients of a level's bins, their noise, roughness and the surprise to be expected, from its parents'."""
        count, n, width = self.coefficients.shape
        own, near = level.combining, level.nearest
        self.coefficients[level.bins] = (own @ self.coefficients.reshape(count, -1)).reshape(-1, n, width)
        together = (own @ np.sqrt(np.maximum(self.noise - self.alone, 0.0))) ** 2
        self.noise[level.bins] = together + level.combining_squares @ self.alone
        self.surprise[level.bins] = self.decay * (near @ self.surprise)
        self.rough[level.bins] = near @ self.rough


def unit(noise: LightNoise, shares: Sequence[float], sizes: Sequence[int]) -> Array:
    """Variance of a coefficient per squared roughness, for lattices of these sizes."""
    return np.array([noise.variance(share, size) for share, size in zip(shares, sizes, strict=True)])


def pool_unit(noise: LightNoise, pools: Pools) -> Array:
    """The same of pools: (YᵀY)⁻¹ of a lattice is 4π/D of the identity, to a thousandth; none need be made for it."""
    return unit(noise, [4.0 * np.pi / size for size in pools.sizes], pools.sizes)


def lots(which: Index, width: int) -> list[Index]:
    """`which` in lots of at most VALUES_AT_ONCE values of `width` each."""
    size = max(1, VALUES_AT_ONCE // width)
    return [which[begin : begin + size] for begin in range(0, len(which), size)]
