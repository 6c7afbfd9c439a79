"""Integrates bins by fitting them to principal components of their vertex's light, in few directions.

A few bins are evaluated in all directions of a lattice; their principal components as functions of ωi are fitted to
every other bin by least squares at a few probe directions of the same lattice, and the residual of the fit gives its
error. That suffices where Ŝ is a sum of a few products of light and view, such as a kink or a shadow that does not move
with the view. Bins that the components do not explain are integrated over their own lattices. A vertex has as many
lattices as are cheap, each with its own components, so that not all of its bins have the same error.

Sources: regression estimators with control variates (Owen, "Monte Carlo theory, methods and examples", 8.9); components
found as in reduced bases (Maday et al., "A general multipurpose interpolation procedure", 2009).
"""

from collections.abc import Hashable
from functools import partial

import numpy as np
from numpy.typing import NDArray

from bakers.adaptive.block_state import LEAST_OWN_SHARE, BlockState, batches
from bakers.adaptive.covariance_sums import SHARED
from bakers.adaptive.principal_components import PROBE_STAGES, LightComponents
from bakers.adaptive.records import RefinementSettings
from bakers.adaptive.view_levels import Level
from bakers.error_covariance import residual_sums, rotated
from bakers.evaluation import values_at

Array = NDArray[np.float64]
Index = NDArray[np.int64]

LEARNING_ROUNDS = 4
"""Most bins of a level that one lattice learns from."""
LATTICE_SHARE = 0.5
"""Fraction of the tolerated variance for the lattices, since many bins share it."""
MOST_LATTICES, LATTICES_COST = 4, 1.0
"""Most lattices of a vertex, and the evaluations per bin that one view of each of them may cost."""
FEWEST_TRIED, MOST_UNEXPLAINED = 8, 0.7
"""A vertex's light is not learnable if more than this fraction is unexplained after that many bins of a level."""


class LightComponentState(BlockState):
    """State with light components for each lattice of a vertex."""

    def __init__(
        self, transport: object, settings: RefinementSettings, vertices: Index, positions: Array, outgoing: Array
    ) -> None:
        super().__init__(transport, settings, vertices, positions, outgoing)
        n, bins = outgoing.shape[:2]
        enough = np.flatnonzero(
            settings.relative_residual * self.pool_factors <= LATTICE_SHARE * settings.light_tolerance**2
        )
        step = max(int(enough[0]) if len(enough) else len(self.pool_factors) - 1, self.least_step)
        self.lattice_factor, self.size = self.pool_factors[step], settings.pools.sizes[step]
        self.pool = settings.pools.of(self.size)
        self.lattices = int(np.clip(LATTICES_COST * bins // self.size, 1, MOST_LATTICES))
        order = np.concatenate([level.bins for level in settings.levels])
        self.lattice_of_bin = np.empty(bins, np.int64)
        self.lattice_of_bin[order] = np.arange(bins) % self.lattices
        """Index of the vertex's lattice that a bin uses."""
        keys = (vertices[:, None] * MOST_LATTICES + np.arange(self.lattices)).ravel()
        self.lattice_rotations = settings.rotations(keys)
        """[n·L,3,3], lattices of one vertex adjacent, as in all arrays over lattices."""
        to_vertex = np.repeat(self.to_world.transpose(0, 2, 1), self.lattices, axis=0)
        self.components = LightComponents(self.pool, to_vertex @ settings.rotate(self.lattice_rotations))
        self.incident = self.pool.directions @ self.lattice_rotations.transpose(0, 2, 1)
        """[n·L,D,3]"""
        self.unlearnable = np.zeros(n, bool)
        """Vertices whose bins are all integrated over their own lattices, since the components explain hardly any."""

    def start(self, level: Level, tolerated: float) -> None:
        """Evaluates the bins of level 0, after each lattice has learned from a few views and the scale is known."""
        self._learn_initial(level)
        bins, rows = (axis.ravel() for axis in np.meshgrid(level.bins, np.arange(len(self.positions)), indexing="ij"))
        sound = np.isfinite(self.scale[rows])
        self._fit_bins(rows[sound], bins[sound], tolerated)
        self.measure_scale(0)

    def _learn_initial(self, level: Level) -> None:
        """Every lattice learns from a view at the rim, one along the normal and one in between: the light varies with
        the slant, and few directions miss a small light.
        """
        n, squares = len(self.positions), np.zeros(len(self.positions))
        rows = np.arange(n)
        upright = np.einsum("nbi,ni->nb", self.outgoing, self.outgoing.mean(axis=1))
        order = np.argsort(upright, axis=1, kind="stable")
        taught = [np.full(n, level.bins[0]), order[:, -1], order[:, order.shape[1] // 2]]
        for lattice in range(self.lattices):
            cells = rows * self.lattices + lattice
            for view, bins in enumerate(taught):
                values = self._values(self.incident, ("taught", lattice, view), rows, bins, cells)
                finite = np.isfinite(values).all(axis=(1, 2))
                self.components.learn(cells[finite], values[finite].astype(np.float64))
                plain = self.pool.weights @ values.astype(np.float64)
                squares += (plain**2).mean(axis=(1, 2))
                residuals = values[finite] - self.pool.harmonics @ plain[finite]
                self._add_covariance(rows[finite], bins[finite], cells[finite], residuals)
        self.components.choose_probes(np.arange(n * self.lattices))
        self.scale = np.maximum(squares / (len(taught) * self.lattices), self.settings.floor**2)
        self.coefficients[level.bins] = np.where(np.isfinite(squares), 0.0, np.nan)[:, None]
        self.directions_used[:] = 0

    def evaluate(self, number: int, level: Level, places: Index, rows: Index, tolerated: float) -> None:
        """Evaluates bins of a level: places [M] in the level and rows [M] of the vertices."""
        bins, own = level.bins[places], self.unlearnable[rows]
        self.integrate(rows[own], bins[own], tolerated * self.scale[rows[own]])
        rows, bins = rows[~own], bins[~own]
        unexplained = self._fit_bins(rows, bins, tolerated)
        if number > self.settings.full_levels:
            tried, missed = (np.bincount(each, minlength=len(self.unlearnable)) for each in (rows, rows[unexplained]))
            self.unlearnable |= (tried >= FEWEST_TRIED) & (missed > MOST_UNEXPLAINED * tried)

    def noise_of_difference(self, rows: Index, bins: Index, predicted: Array, independent: Array) -> Array:
        """Noise of the difference; bins and predictions from one lattice have its noise in common."""
        own = self.own_lattice[bins, rows]
        return np.asarray(
            np.where(own, self.noise[bins, rows] + predicted, self.independent_noise[bins, rows] + independent)
        )

    def _fit_bins(self, rows: Index, bins: Index, tolerated: float) -> Index:
        """Fits bins (rows [M], bins [M]) to components, learns from some that they do not explain, and integrates the
        rest over their own lattices. Returns the places in M of the rest.
        """
        cells = rows * self.lattices + self.lattice_of_bin[bins]
        allowed, probed = tolerated * self.scale[rows], np.zeros((len(rows), PROBE_STAGES[-1][0], 3))
        here, begin = np.arange(len(rows)), 0
        for stage, (end, _most) in enumerate(PROBE_STAGES):
            probed[here, begin:end] = self._values(
                self._probe_directions(begin, end), (begin, end), rows[here], bins[here], cells[here]
            )
            here, begin = self._unexplained(here, stage, rows, bins, probed, allowed), end
        for _round in range(LEARNING_ROUNDS):
            worst = self._worst_fitted(cells[here], probed[here])
            self._learn_from(rows[here[worst]], bins[here[worst]])
            here = self._unexplained(np.delete(here, worst), stage, rows, bins, probed, allowed)
        self.integrate(rows[here], bins[here], allowed[here])
        return here

    def _unexplained(self, here: Index, stage: int, rows: Index, bins: Index, probed: Array, allowed: Array) -> Index:
        """The bins in places `here` that the components do not explain; stores the coefficients of the others."""
        r, b = rows[here], bins[here]
        cells = r * self.lattices + self.lattice_of_bin[b]
        amplitudes, fitted = self.components.fit(cells, probed[here], stage)
        residual = self.components.residual_variance(cells, amplitudes)
        lattice = residual * self.lattice_factor
        explained = ~(fitted > np.maximum(allowed[here] - lattice, LEAST_OWN_SHARE * allowed[here]))
        r, b, cells = r[explained], b[explained], cells[explained]
        self.coefficients[b, r] = self.components.coefficients(cells, amplitudes[explained])
        self.residual_variance[b, r] = residual[explained]
        self._set_noise(r, b, lattice[explained], fitted[explained])
        return np.asarray(here[~explained])

    def _set_noise(self, rows: Index, bins: Index, lattice: Array, fitted: Array | float) -> None:
        """Sets the noise [M] of bins from their lattices and from a fit. Different lattices have independent errors."""
        self.noise[bins, rows] = lattice + fitted
        self.independent_noise[bins, rows] = (1.0 - 1.0 / self.lattices) * lattice + fitted

    def _worst_fitted(self, cells: Index, probed: Array) -> Index:
        """The place of the worst-fitted bin of each lattice."""
        _amplitudes, variance = self.components.fit(cells, probed, len(PROBE_STAGES) - 1)
        order = np.lexsort((-variance, cells))
        return np.sort(order[np.unique(cells[order], return_index=True)[1]])

    def _learn_from(self, rows: Index, bins: Index) -> None:
        """Evaluates one bin of each of some lattices in all directions, and adds its new components."""
        cells = rows * self.lattices + self.lattice_of_bin[bins]
        values = self._values(self.incident, "all", rows, bins, cells).astype(np.float64)
        plain = self.pool.weights @ values
        residuals = values - self.pool.harmonics @ plain
        residual = (residuals**2).sum(axis=1).mean(axis=1) / (self.size - self.lattice.count)
        finite = np.isfinite(residual)
        self.components.learn(cells[finite], values[finite])
        self.coefficients[bins, rows] = self.components.to_vertex_frame(cells, plain)
        self.residual_variance[bins, rows] = residual
        self._set_noise(rows, bins, residual * self.lattice_factor, 0.0)
        self._add_covariance(rows[finite], bins[finite], cells[finite], residuals[finite])

    def _add_covariance(self, rows: Index, bins: Index, cells: Index, residuals: Array) -> None:
        """Adds the error covariance of bins that share a lattice, from residuals of fits in all directions."""
        covariance, channels = residual_sums(residuals, self.pool.products)
        frames = self.view_matrices(rows, bins) @ self.to_world[rows] @ self.components.frames[cells]
        covariance = rotated(covariance, frames)
        self.covariance_sums.add(SHARED, rows, covariance, channels, (residuals**2).sum(axis=(1, 2)))

    def _probe_directions(self, begin: int, end: int) -> Array:
        """Some of the probe directions of each lattice [n·L,d,3]."""
        return np.take_along_axis(self.incident, self.components.probes[:, begin:end, None], axis=1)

    def _values(self, incident: Array, which: Hashable, rows: Index, bins: Index, cells: Index) -> NDArray[np.float32]:
        """Ŝ [M,d,3] of bins in directions [n·L,d,3] of the lattices `cells` [M]."""
        many = incident.shape[1]
        values = np.empty((len(rows), many, 3), np.float32)
        for some in batches(np.arange(len(rows)), many):
            r, b = rows[some], bins[some]
            evaluate = partial(self._evaluate_batch, incident, cells[some], r, b)
            name = "learned", self.size, self.lattices, which
            values[some], known = self.settings.cache.get(name, self.vertices[r], b, evaluate)
            self.recalled += known * many
        self.evaluations += len(rows) * many
        self.directions_used[bins, rows] += many
        return values

    def _evaluate_batch(
        self, incident: Array, cells: Index, rows: Index, bins: Index, some: Index
    ) -> NDArray[np.float32]:
        r, b = rows[some], bins[some]
        values = values_at(self.transport, incident, cells[some], self.positions[r], self.outgoing[r, b])
        return values.astype(np.float32, copy=False)
