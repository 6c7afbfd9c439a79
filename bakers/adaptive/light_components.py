"""Bins that are made of what was learned of a vertex's light: some are evaluated in many directions, others in few,
by what they have in common with those.

The principal functions of ωi that a few bins show are fitted to every other bin by least squares, in a few of the
directions of the same lattice; what the fit leaves over tells its error. Where Ŝ is a sum of a few products of light
and view (a kink or a shadow that stays where it is, whatever the view does) that is all that it takes; bins that are
made of something else are integrated over lattices of their own. A vertex has as many lattices as cost little, each
with functions of its own, so that not all of its bins err together.

Sources: regression estimators with control variates (Owen, "Monte Carlo theory, methods and examples", 8.9), of
functions that are found out as in reduced bases (Maday et al., "A general multipurpose interpolation procedure", 2009).
"""

from collections.abc import Hashable
from functools import partial

import numpy as np
from numpy.typing import NDArray

from bakers.adaptive.block_state import LEAST_SHARE, Work, lots
from bakers.adaptive.component_fit import LOOKS, LightFunctions
from bakers.adaptive.covariance_sums import SHARED
from bakers.adaptive.records import Refinement
from bakers.adaptive.view_levels import Level
from bakers.error_covariance import of_residuals, turned
from bakers.evaluation import values_at

Array = NDArray[np.float64]
Index = NDArray[np.int64]

ROUNDS = 4
"""Bins of a level that one lattice learns from."""
LATTICE_SHARE = 0.5
"""Of the variance tolerated, what the lattices may have: many bins have it in common."""
MOST_LATTICES, LATTICES_COST = 4, 1.0
"""Of a vertex; and the evaluations a bin that one view of each of them may come to."""
FEWEST_TRIED, MOST_LOST = 8, 0.7
"""Bins of a level, and the share of them that are not recognised, from which on a vertex is foreign."""


class LearnedWork(Work):
    """Work with functions of the light that each lattice of a vertex learns."""

    def __init__(
        self, transport: object, refinement: Refinement, vertices: Index, positions: Array, outgoing: Array
    ) -> None:
        super().__init__(transport, refinement, vertices, positions, outgoing)
        n, bins = outgoing.shape[:2]
        enough = np.flatnonzero(refinement.roughness * self.pool_unit <= LATTICE_SHARE * refinement.light**2)
        step = max(int(enough[0]) if len(enough) else len(self.pool_unit) - 1, self.fewest)
        self.unit, self.size = self.pool_unit[step], refinement.pools.sizes[step]
        self.pool = refinement.pools.of(self.size)
        self.lattices = int(np.clip(LATTICES_COST * bins // self.size, 1, MOST_LATTICES))
        order = np.concatenate([level.bins for level in refinement.levels])
        self.of_bin = np.empty(bins, np.int64)
        self.of_bin[order] = np.arange(bins) % self.lattices
        """Which of the lattices of its vertex a bin has."""
        keys = (vertices[:, None] * MOST_LATTICES + np.arange(self.lattices)).ravel()
        self.turns = refinement.rotations(keys)
        """[n·L,3,3], those of one vertex beside each other, as in all that follows."""
        back = np.repeat(self.turn.transpose(0, 2, 1), self.lattices, axis=0)
        self.functions = LightFunctions(self.pool, back @ refinement.rotate(self.turns))
        self.incident = self.pool.directions @ self.turns.transpose(0, 2, 1)
        """[n·L,D,3]"""
        self.foreign = np.zeros(n, bool)
        """Vertices whose bins are all integrated on their own: hardly any is recognised."""

    def begin(self, level: Level, tolerated: float) -> None:
        """Evaluates the coarsest bins, once each lattice has learned from a few views and a scale is known."""
        self._teach(level)
        bins, rows = (axis.ravel() for axis in np.meshgrid(level.bins, np.arange(len(self.positions)), indexing="ij"))
        sound = np.isfinite(self.scale[rows])
        self._settle(rows[sound], bins[sound], tolerated)
        self.measure(0)

    def _teach(self, level: Level) -> None:
        """Every lattice learns from a view at the rim, one along the normal and one between: what is lit changes with
        the slant, and in few directions a small light is not seen.
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
                self.functions.learn(cells[finite], values[finite].astype(np.float64))
                plain = self.pool.weights @ values.astype(np.float64)
                squares += (plain**2).mean(axis=(1, 2))
                left = values[finite] - self.pool.harmonics @ plain[finite]
                self._shaped(rows[finite], bins[finite], cells[finite], left)
        self.functions.look_for(np.arange(n * self.lattices))
        self.scale = np.maximum(squares / (len(taught) * self.lattices), self.how.floor**2)
        self.coefficients[level.bins] = np.where(np.isfinite(squares), 0.0, np.nan)[:, None]
        self.spent[:] = 0

    def evaluate(self, number: int, level: Level, places: Index, rows: Index, tolerated: float) -> None:
        """Evaluates the bins of a level at these places [M] of the vertices in these rows [M]."""
        bins, apart = level.bins[places], self.foreign[rows]
        self.integrate(rows[apart], bins[apart], tolerated * self.scale[rows[apart]])
        rows, bins = rows[~apart], bins[~apart]
        lost = self._settle(rows, bins, tolerated)
        if number > self.how.always:
            tried, missed = (np.bincount(each, minlength=len(self.foreign)) for each in (rows, rows[lost]))
            self.foreign |= (tried >= FEWEST_TRIED) & (missed > MOST_LOST * tried)

    def noise_of_difference(self, rows: Index, bins: Index, foretold: Array, alone: Array) -> Array:
        """What bins and what was foretold of them have from one lattice is the same."""
        apart = self.apart[bins, rows]
        return np.asarray(np.where(apart, self.noise[bins, rows] + foretold, self.alone[bins, rows] + alone))

    def _settle(self, rows: Index, bins: Index, tolerated: float) -> Index:
        """Recognises bins (rows [M], bins [M]), learns from some of those that it does not recognise, and integrates
        what is left on its own. Places in M of the latter.
        """
        cells = rows * self.lattices + self.of_bin[bins]
        allowed, seen = tolerated * self.scale[rows], np.zeros((len(rows), LOOKS[-1][0], 3))
        here, begin = np.arange(len(rows)), 0
        for look, (end, _most) in enumerate(LOOKS):
            seen[here, begin:end] = self._values(
                self._looks(begin, end), (begin, end), rows[here], bins[here], cells[here]
            )
            here, begin = self._not_recognised(here, look, rows, bins, seen, allowed), end
        for _round in range(ROUNDS):
            worst = self._worst(cells[here], seen[here])
            self._learn(rows[here[worst]], bins[here[worst]])
            here = self._not_recognised(np.delete(here, worst), look, rows, bins, seen, allowed)
        self.integrate(rows[here], bins[here], allowed[here])
        return here

    def _not_recognised(self, here: Index, look: int, rows: Index, bins: Index, seen: Array, allowed: Array) -> Index:
        """Which of the bins in places `here` are not made of what their lattices know; those that are, are settled."""
        r, b = rows[here], bins[here]
        cells = r * self.lattices + self.of_bin[b]
        amounts, fitted = self.functions.fitted(cells, seen[here], look)
        rough = self.functions.roughness(cells, amounts)
        lattice = rough * self.unit
        good = ~(fitted > np.maximum(allowed[here] - lattice, LEAST_SHARE * allowed[here]))
        r, b, cells = r[good], b[good], cells[good]
        self.coefficients[b, r] = self.functions.coefficients(cells, amounts[good])
        self.rough[b, r] = rough[good]
        self._noisy(r, b, lattice[good], fitted[good])
        return np.asarray(here[~good])

    def _noisy(self, rows: Index, bins: Index, lattice: Array, fitted: Array | float) -> None:
        """Notes noise [M] that bins have from their lattices, and from a fit. Over other lattices bins err apart."""
        self.noise[bins, rows] = lattice + fitted
        self.alone[bins, rows] = (1.0 - 1.0 / self.lattices) * lattice + fitted

    def _worst(self, cells: Index, seen: Array) -> Index:
        """Of each lattice the place of the bin that its functions leave most of."""
        _amounts, left = self.functions.fitted(cells, seen, len(LOOKS) - 1)
        order = np.lexsort((-left, cells))
        return np.sort(order[np.unique(cells[order], return_index=True)[1]])

    def _learn(self, rows: Index, bins: Index) -> None:
        """Evaluates a bin of each of some lattices in all directions; what is new of it are functions from now on."""
        cells = rows * self.lattices + self.of_bin[bins]
        values = self._values(self.incident, "all", rows, bins, cells).astype(np.float64)
        plain = self.pool.weights @ values
        left = values - self.pool.harmonics @ plain
        rough = (left**2).sum(axis=1).mean(axis=1) / (self.size - self.lattice.count)
        finite = np.isfinite(rough)
        self.functions.learn(cells[finite], values[finite])
        self.coefficients[bins, rows] = self.functions.home(cells, plain)
        self.rough[bins, rows] = rough
        self._noisy(rows, bins, rough * self.unit, 0.0)
        self._shaped(rows[finite], bins[finite], cells[finite], left[finite])

    def _shaped(self, rows: Index, bins: Index, cells: Index, left: Array) -> None:
        """Tells how errors hang together that bins have from their lattices, by what fits of whole views leave over."""
        covariance, channels = of_residuals(left, self.pool.products)
        frames = self.views(rows, bins) @ self.turn[rows] @ self.functions.frames[cells]
        covariance = turned(covariance, frames)
        self.shapes.add(SHARED, rows, covariance, channels, (left**2).sum(axis=(1, 2)))

    def _looks(self, begin: int, end: int) -> Array:
        """Some of the few directions of each lattice [n·L,d,3]."""
        return np.take_along_axis(self.incident, self.functions.picked[:, begin:end, None], axis=1)

    def _values(self, incident: Array, which: Hashable, rows: Index, bins: Index, cells: Index) -> NDArray[np.float32]:
        """Ŝ [M,d,3] of bins in directions [n·L,d,3] of these lattices."""
        many = incident.shape[1]
        values = np.empty((len(rows), many, 3), np.float32)
        for some in lots(np.arange(len(rows)), many):
            r, b = rows[some], bins[some]
            ask = partial(self._ask, incident, cells[some], r, b)
            name = "learned", self.size, self.lattices, which
            values[some], known = self.how.answers.given(name, self.vertices[r], b, ask)
            self.recalled += known * many
        self.evaluations += len(rows) * many
        self.spent[bins, rows] += many
        return values

    def _ask(self, incident: Array, cells: Index, rows: Index, bins: Index, some: Index) -> NDArray[np.float32]:
        r, b = rows[some], bins[some]
        values = values_at(self.transport, incident, cells[some], self.positions[r], self.outgoing[r, b])
        return values.astype(np.float32, copy=False)
