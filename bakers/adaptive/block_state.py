"""State of a block of vertices while it is refined level by level. This base class integrates every bin that is not
interpolated over its own lattice.
"""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bakers.adaptive.covariance_sums import OWN, PREDICTED, CovarianceSums
from bakers.adaptive.lattice_noise import LatticeNoise
from bakers.adaptive.lattice_pools import Pool, Pools
from bakers.adaptive.records import RefinedBlock, RefinementSettings, ValidationSamples, validation_noise
from bakers.adaptive.view_levels import Level
from bakers.adaptive.view_survey import DECAY, FULL_LEVELS
from bakers.error_covariance import residual_sums, rotated
from bakers.error_estimate import ROUNDING
from bakers.evaluation import values_at
from formats.asset.error_covariance import ErrorCovariance, pairs

Array = NDArray[np.float64]
Index = NDArray[np.int64]

VALUES_AT_ONCE = 1 << 17
MOST_ATTEMPTS, ACCEPTED_EXCESS = 3, 1.5
"""Attempts at choosing the size of a bin's own lattice, and the excess over the allowed variance that is accepted."""
PRIOR_DECAY_BINS = 8.0
"""Weight of the prior decay of prediction errors, in bins."""
LEAST_DECAY, MOST_DECAY = 0.15, 1.0
LEVEL_SHARES = (0.4, 0.5, 0.6, 0.75, 0.9, 1.0)
"""Fraction of the tolerated variance that may be used at each level: errors of coarse levels propagate to all finer
ones.
"""
LEAST_OWN_SHARE = 0.15
"""Fraction of the tolerated variance that a bin's own noise may always use."""


class Fits(NamedTuple):
    """Fits of M bins over their own lattices, in the world frame."""

    coefficients: Array
    """[M,K,3]"""
    residual_variance: Array
    """[M], mean square residual per degree of freedom."""
    covariance: Array
    """[M,P], error covariance up to a factor."""
    channels: Array
    """[M,3], share of each channel up to a factor."""


class BlockState:
    """State of a block between levels: arrays [B,n,…]. Coefficients are in the frame of the vertex's lattice."""

    def __init__(
        self, transport: object, settings: RefinementSettings, vertices: Index, positions: Array, outgoing: Array
    ) -> None:
        n, bins = outgoing.shape[:2]
        self.transport, self.settings, self.positions, self.outgoing = transport, settings, positions, outgoing
        self.lattice, self.vertices = settings.lattice, vertices
        self.evaluations = self.recalled = 0
        """Evaluations so far, and how many of them came from the cache."""
        self.rotations = settings.rotations(vertices)
        self.coefficients = np.zeros((bins, n, self.lattice.count * 3))
        self.noise, self.prediction_variance, self.residual_variance = np.zeros((3, bins, n))
        self.scale, self.decay = np.full(n, settings.floor**2), np.full(n, DECAY**2)
        self.pool_factors = pool_variance_factors(settings.pool_noise, settings.pools)
        self.to_world = settings.rotate(self.rotations)
        self.independent_noise = np.zeros((bins, n))
        """Part of `noise` that is independent of all other bins."""
        self.directions_used = np.zeros((bins, n), np.int64)
        """Number of directions that a bin was evaluated in."""
        self.own_lattice = np.zeros((bins, n), bool)
        """Whether a bin was integrated over its own lattice."""
        self.least_step = int(np.searchsorted(settings.pools.sizes, self.lattice.sizes[settings.initial_sizes - 1]))
        self.least_step = min(self.least_step, len(self.pool_factors) - 1)
        """Index of the smallest own lattice that resolves the narrowest features."""
        self.covariance_sums = CovarianceSums(n, self.lattice.count)

    def add_level(self, number: int, level: Level) -> None:
        """Interpolates the bins of a level, and evaluates those whose expected prediction error is too large."""
        tolerated = self.settings.light_tolerance**2 * LEVEL_SHARES[min(number, len(LEVEL_SHARES) - 1)]
        if number == 0:
            self.start(level, tolerated)
            return
        self.predict(level)
        evaluated = np.isfinite(self.scale) & np.ones((len(level.bins), 1), bool)
        if number > self.settings.full_levels:
            evaluated &= ~(self.prediction_variance[level.bins] <= self.settings.view_tolerance**2 * self.scale)
        places, rows = np.nonzero(evaluated)
        bins = level.bins[places]
        predicted, noise, independent, expected = (
            part[bins, rows].copy()
            for part in (self.coefficients, self.noise, self.independent_noise, self.prediction_variance)
        )
        self.evaluate(number, level, places, rows, tolerated)
        difference = self.coefficients[bins, rows] - predicted
        in_world = self.to_world[rows] @ difference.reshape(len(rows), self.lattice.count, 3)
        self.covariance_sums.add_errors(PREDICTED, rows, self.in_view(rows, bins, in_world))
        squared = (difference**2).mean(axis=1)
        noise = self.noise_of_difference(rows, bins, noise, independent)
        self.prediction_variance[bins, rows] = np.maximum(squared - noise, 0.0)
        if number > FULL_LEVELS:
            self._update_decay(rows, expected, self.prediction_variance[bins, rows])
        if number == FULL_LEVELS:
            # The first levels had hardly any prediction: use the error of the last of them.
            for before in self.settings.levels[:number]:
                self.prediction_variance[before.bins] = self.prediction_variance[level.bins].mean(axis=0)
        if number < FULL_LEVELS:
            self.measure_scale(number)

    def start(self, level: Level, tolerated: float) -> None:
        """Evaluates the bins of level 0, for which there is no prediction and no known scale."""
        places, rows = np.nonzero(np.ones((len(level.bins), len(self.positions)), bool))
        bins = level.bins[places]
        self.integrate(rows, bins, np.full(len(rows), np.inf))
        self.measure_scale(0)
        noisy = np.flatnonzero(self.noise[bins, rows] > tolerated * self.scale[rows])
        self.integrate(rows[noisy], bins[noisy], tolerated * self.scale[rows[noisy]])

    def evaluate(self, number: int, level: Level, places: Index, rows: Index, tolerated: float) -> None:
        """Evaluates bins of level `number`: places [M] in the level and rows [M] of the vertices. `tolerated` is the
        variance that a coefficient may have, over the mean square coefficient of its vertex.
        """
        self.integrate(rows, level.bins[places], tolerated * self.scale[rows])

    def noise_of_difference(self, rows: Index, bins: Index, predicted: Array, independent: Array) -> Array:
        """Variance [M] of the difference between bins and their predictions that is due to noise; `predicted` and
        `independent` [M] are the predictions' noise and its independent part.
        """
        return np.asarray(self.noise[bins, rows] + predicted)

    def integrate(self, rows: Index, bins: Index, allowed: Array) -> None:
        """Integrates bins over their own lattices, with as many directions as the allowed variance [M] requires."""
        residual, least = self.residual_variance[bins, rows], np.full(len(rows), self.least_step)
        self.own_lattice[bins, rows] = True
        for attempt in range(MOST_ATTEMPTS):
            if not len(rows):
                return
            steps = np.maximum(self._steps(residual, allowed), least)
            fits = self.fit_own_lattice(rows, bins, steps, 0)
            found, residual = fits.coefficients, fits.residual_variance
            self.coefficients[bins, rows] = (self.to_world[rows].transpose(0, 2, 1) @ found).reshape(len(rows), -1)
            noise = residual * self.pool_factors[steps]
            self.noise[bins, rows] = self.independent_noise[bins, rows] = noise
            self.residual_variance[bins, rows] = residual
            # The residual was larger than expected: repeat with more directions, unless the excess is small.
            again = (noise > ACCEPTED_EXCESS * allowed) & (steps < len(self.pool_factors) - 1)
            again &= attempt < MOST_ATTEMPTS - 1
            done = ~again
            matrices = self.view_matrices(rows[done], bins[done])
            covariance = rotated(fits.covariance[done], matrices)
            self.covariance_sums.add(OWN, rows[done], covariance, fits.channels[done], noise[done])
            rows, bins, least = rows[again], bins[again], steps[again] + 1
            allowed, residual = allowed[again], residual[again]

    def _steps(self, residual: Array, allowed: Array) -> Index:
        """Index of the smallest own lattice [M] whose noise is at most the allowed variance, or of the largest; 0 where
        the residual variance is not finite.
        """
        enough = ~(residual[:, None] * self.pool_factors > allowed[:, None])
        return np.where(enough.any(axis=1), enough.argmax(axis=1), len(self.pool_factors) - 1)

    def result(self) -> RefinedBlock:
        """The refined block, with validation samples at a few bins."""
        prediction = np.where(self.directions_used > 0, 0.0, self.prediction_variance)
        variance = np.ascontiguousarray((self.noise + prediction + ROUNDING**2 * self.scale).T)
        n, bins = variance.shape
        own = self.coefficients.transpose(1, 0, 2).reshape(n, bins, -1, 3)
        in_world = self.to_world[:, None] @ own
        samples = self.validate(variance, in_world)
        shared: Array | float = 0.0
        if self.settings.lattices != "own":
            shared = np.maximum(self.noise - self.independent_noise, 0.0).sum(axis=0)
        errors = self._error_covariance(variance)
        return RefinedBlock(
            in_world.astype(np.float32),
            np.sqrt(variance).astype(np.float32),
            self.directions_used.T.astype(np.uint16),
            self._methods().T,
            _fraction(shared, variance.sum(axis=1)).astype(np.float32),
            errors.covariance,
            errors.channels,
            errors.apart,
            self.evaluations,
            self.recalled,
            samples,
        )

    def _error_covariance(self, variance: Array) -> ErrorCovariance:
        """Error covariance for the variance [n,B]. Interpolated bins inherit the errors of the bins they are
        interpolated from, which neighbouring bins share, and add the prediction error.
        """
        self.add_lattice_covariance()
        predicted = self.directions_used == 0
        independent = _fraction(np.where(predicted, 0.0, self.independent_noise).sum(axis=0), variance.sum(axis=1))
        shared, own = (np.where(self.own_lattice == which, self.noise, 0.0) for which in (False, True))
        shared, own = (np.where(predicted, 0.0, each).sum(axis=0) for each in (shared, own))
        carried = self.noise.sum(axis=0) / np.maximum(shared + own, 1e-300)
        prediction = np.where(predicted, self.prediction_variance, 0.0).sum(axis=0)
        return self.covariance_sums.finished(np.stack([prediction, carried * shared, carried * own]), independent)

    def in_view(self, rows: Index, bins: Index, coefficients: Array) -> Array:
        """Coefficients [M,K,3] rotated from the world frame into the view frames of these bins."""
        return self.settings.frames.in_view(self.vertices[rows], self.outgoing[rows, bins], coefficients)

    def view_matrices(self, rows: Index, bins: Index) -> Array:
        """Matrices [M,K,K] of the rotation that `in_view` applies."""
        return self.settings.frames.matrices(self.vertices[rows], self.outgoing[rows, bins], self.lattice.count)

    def add_lattice_covariance(self) -> None:
        """Adds the error covariance of bins that share a lattice."""

    def _methods(self) -> NDArray[np.uint8]:
        """Method of each bin [B,n]: indices into `bakers.adaptive.records.METHODS`."""
        return ((self.directions_used > 0).astype(np.uint8) + self.own_lattice).astype(np.uint8)

    def fit_own_lattice(self, rows: Index, bins: Index, steps: Index, which: int) -> Fits:
        """Fits bins over their own lattices of these sizes; `which` selects independent copies."""
        count = self.lattice.count
        cuts = np.cumsum([count * 3, 1, pairs(count)])
        found, pools = np.empty((len(rows), int(cuts[-1]) + 3)), self.settings.pools
        for step in np.unique(steps):
            size = pools.sizes[step]
            pool = pools.of(size)
            for some in batches(np.flatnonzero(steps == step), size):
                r, b = rows[some], bins[some]
                evaluate = partial(self._fit_batch, pool, r, b, pools.copies(size, self.vertices[r], b, which))
                found[some], known = self.settings.cache.get((size, which), self.vertices[r], b, evaluate)
                self.recalled += known * size
        taken = np.array(pools.sizes, np.int64)[steps]
        self.evaluations += int(taken.sum())
        if which == 0:
            self.directions_used[bins, rows] += taken
        coefficients, residual, covariance, channels = np.split(found, cuts, axis=1)
        return Fits(coefficients.reshape(len(rows), count, 3), residual[:, 0], covariance, channels)

    def _fit_batch(self, pool: Pool, rows: Index, bins: Index, copies: Index, some: Index) -> Array:
        """Fits some of these bins: coefficients, residual variance, covariance and channels [m,K·3+1+P+3]."""
        r, b = rows[some], bins[some]
        values = values_at(self.transport, pool.incident, copies[some], self.positions[r], self.outgoing[r, b])
        found, residuals, residual = pool.fitted(values, copies[some])
        covariance, channels = residual_sums(residuals, pool.products)
        covariance = rotated(covariance, pool.to_world[copies[some]])
        return np.column_stack([found.reshape(len(some), -1), residual, covariance, channels])

    def validate(self, variance: Array, coefficients: Array) -> ValidationSamples:
        """Validates some bins against two independent lattices each."""
        rows, bins = np.nonzero(self.settings.validation_bins(self.vertices) & np.isfinite(self.scale)[:, None])
        before = self.evaluations
        one, other = self.validation_errors(rows, bins, coefficients)
        squared, noise = (one * other).mean(axis=(1, 2)), validation_noise(rows, one, other)
        method, taken = self._methods()[bins, rows], self.evaluations - before
        return ValidationSamples(rows, method, variance[rows, bins], squared, noise, evaluations=taken)

    def validation_errors(self, rows: Index, bins: Index, coefficients: Array) -> tuple[Array, Array]:
        """Differences [M,K,3] of two independent estimates from the coefficients [n,B,K,3]. Neither lattice contributed
        to the coefficients, so the product of the two is an unbiased estimate of the squared error, whatever their
        noise.
        """
        # A bin with a small residual may have missed features that other bins of the vertex resolve.
        residual = np.maximum(self.residual_variance[bins, rows], self.residual_variance.mean(axis=0)[rows])
        allowed = self.settings.validation_noise**2 * self.scale[rows]
        steps, estimate = np.maximum(self._steps(residual, allowed), self.least_step), coefficients[rows, bins]
        one, other = (self.fit_own_lattice(rows, bins, steps, which).coefficients - estimate for which in (1, 2))
        return one, other

    def measure_scale(self, number: int) -> None:
        """Measures the mean square coefficient of each vertex on the levels up to this one."""
        known = np.concatenate([level.bins for level in self.settings.levels[: number + 1]])
        self.scale = np.maximum((self.coefficients[known] ** 2).mean(axis=(0, 2)), self.settings.floor**2)

    def _update_decay(self, rows: Index, expected: Array, found: Array) -> None:
        """Updates each vertex's decay: the ratio of prediction errors at a level to those one level below."""
        counts, n = np.bincount(rows, minlength=len(self.decay)), len(self.decay)
        before, after = (np.bincount(rows, np.nan_to_num(part), n) for part in (expected, found))
        prior = PRIOR_DECAY_BINS * before / np.maximum(counts, 1)
        ratio = (after + DECAY**2 / self.decay * prior) / np.maximum(before + prior, 1e-300)
        self.decay = np.where(before > 0.0, np.clip(self.decay * ratio, LEAST_DECAY**2, MOST_DECAY**2), self.decay)

    def predict(self, level: Level) -> None:
        """Interpolates a level's bins from its parents: coefficients, noise, residual variance and the expected
        prediction error.
        """
        count, n, width = self.coefficients.shape
        weights, near = level.interpolation, level.nearest_mean
        self.coefficients[level.bins] = (weights @ self.coefficients.reshape(count, -1)).reshape(-1, n, width)
        common = (weights @ np.sqrt(np.maximum(self.noise - self.independent_noise, 0.0))) ** 2
        self.noise[level.bins] = common + level.squared_weights @ self.independent_noise
        self.prediction_variance[level.bins] = self.decay * (near @ self.prediction_variance)
        self.residual_variance[level.bins] = near @ self.residual_variance


def _fraction(part: Array | float, total: Array) -> Array:
    """part / total [n]; 0 at vertices without any error, such as black ones."""
    return np.asarray(np.divide(part, total, out=np.zeros_like(total), where=total > 0.0))


def variance_factors(noise: LatticeNoise, shares: Sequence[float], sizes: Sequence[int]) -> Array:
    """Variance of a coefficient per residual variance, for lattices of these sizes."""
    return np.array([noise.variance(share, size) for share, size in zip(shares, sizes, strict=True)])


def pool_variance_factors(noise: LatticeNoise, pools: Pools) -> Array:
    """`variance_factors` of the pools' lattices. Makes no pool: (YᵀY)⁻¹ of a lattice is 4π/D times the identity, to a
    thousandth.
    """
    return variance_factors(noise, [4.0 * np.pi / size for size in pools.sizes], pools.sizes)


def batches(which: Index, width: int) -> list[Index]:
    """`which` in batches of at most VALUES_AT_ONCE values, `width` per entry."""
    size = max(1, VALUES_AT_ONCE // width)
    return [which[begin : begin + size] for begin in range(0, len(which), size)]
