"""What a refined bake's checks say of its error: how far the stated variances are off, and the error of it all.

Bins that were foretold, evaluated over the shared lattice and integrated alone are held against independent directions
each kind apart, since their errors come about in different ways. Checked bins are a random sample of all, so that the
ratio of what was seen to what was stated corrects the sum of what is stated without bias; a few bins' worth of what was
known before keeps it steady.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bakers.adaptive.records import HELD, WAYS, Checks, Refined
from bakers.adaptive.vertex_scatter import UNKNOWN, Scatter, measured, possible, usual

Array = NDArray[np.float64]

BEFORE = 6.0
"""How many checked bins weigh as much as what was known before."""
LEAST, MOST = 0.05, 1e4
BOUND, BOUND_BEFORE = 1.96, 20.0
"""Sigmas that 95 % of the errors lie within, and how many checks weigh as much as that being so already."""
FAINT = 0.01
"""Of the usual variance of its vertex, below which that of a bin is not held against what its check says: checks are as
noisy at all bins of a vertex.
"""
_CHECKED: dict[str, type] = {"rows": np.int64, "way": np.uint8, **dict.fromkeys(HELD[1:], np.float64)}


@dataclass(frozen=True)
class Correction:
    """Factors on stated variances."""

    foretold: float = 1.0
    shared: float = 1.0
    alone: float = 1.0
    nearby: float = 1.0
    bound: float = 1.0
    """Factor on standard errors beside: with it 1.96 of them hold the errors of 95 % of the bins."""
    scatter: Scatter = UNKNOWN

    @property
    def by_way(self) -> Array:
        """The factors [4], in the order of `bakers.adaptive.records.WAYS`."""
        return np.array([self.foretold, self.shared, self.alone, self.nearby])

    def standard_error(self, deviation: NDArray[np.floating], way: NDArray[np.integer]) -> Array:
        """Standard errors from stated ones [...], such that 1.96 of them are a 95 % bound."""
        return np.asarray(self.bound * np.sqrt(self.by_way[way]) * deviation)


class Tally:
    """Adds up blocks: sums [V] over the bins of each vertex, variances by way [4,V], and all checks, their rows being
    numbers of vertices.
    """

    def __init__(self, vertices: int) -> None:
        self.variance, self.signal = np.zeros((len(WAYS), vertices)), np.zeros(vertices)
        self.done, self.invalid = np.zeros(vertices, bool), np.zeros(vertices, bool)
        self.together = np.zeros(vertices)
        self.evaluations = self.recalled = self.check_evaluations = self.evaluated_bins = self.bins = 0
        self._checks: list[Checks] = []

    def add(self, rows: NDArray[np.int64], refined: Refined) -> None:
        """Takes in the vertices `rows` [n] of a block; those that are not finite count for nothing."""
        finite, was = refined.valid, refined.directions > 0
        variance = np.where(finite[:, None], refined.deviation.astype(np.float64) ** 2, 0.0)
        for way in range(len(WAYS)):
            self.variance[way, rows] = (variance * (refined.way == way)).sum(axis=1)
        self.together[rows] = np.where(finite, refined.together, 0.0)
        sound = np.where(finite[:, None, None, None], refined.coefficients.astype(np.float64), 0.0)
        self.signal[rows] = (sound**2).mean(axis=(2, 3)).sum(axis=1)
        self.done[rows], self.invalid[rows] = True, ~finite
        self.evaluated_bins, self.bins = self.evaluated_bins + int(was.sum()), self.bins + was.size
        self.evaluations += refined.evaluations
        self.recalled += refined.recalled
        self.check_evaluations += refined.checks.evaluations
        self._checks.append(replace(refined.checks, rows=rows[refined.checks.rows]))

    @property
    def asked(self) -> int:
        """Evaluations that were not known from before."""
        return self.evaluations - self.recalled

    @property
    def checked(self) -> int:
        """Bins that were held against independent directions."""
        return sum(len(checks.stated) for checks in self._checks)

    def correction(self, before: Correction) -> Correction:
        """What the checks say of the stated variances, `before` known."""
        vertices, way, stated, squared, noise = (self._all_checks(name) for name in ("rows", *HELD))
        sound = np.isfinite(stated) & np.isfinite(squared)
        vertices, way, stated, squared, noise = (each[sound] for each in (vertices, way, stated, squared, noise))
        factors = [_ratio(stated[way == w], squared[way == w], was) for w, was in enumerate(before.by_way)]
        found = Correction(factors[0], factors[1], factors[2], factors[3])
        corrected = found.by_way[way] * stated
        beforehand = float(usual(self.together[vertices]).mean()) if len(vertices) else 0.0
        scatter = measured(vertices, corrected, squared, beforehand)
        plain = corrected >= FAINT * self._usual(found)[vertices]
        independent = _independent(vertices[plain], self.together)
        bound = _bound(corrected[plain], squared[plain], noise[plain], independent)
        return replace(found, bound=bound, scatter=scatter)

    def _usual(self, correction: Correction) -> Array:
        """The mean variance [V] of the bins of each vertex."""
        return np.asarray(correction.by_way @ self.variance * (self.done.sum() / max(1, self.bins)))

    def relative(self, correction: Correction, smaller: Array | float = 1.0) -> tuple[float, float]:
        """Relative RMSE over everything done so far, and the 95th percentile over vertices of what it may be at one;
        as they would be if the errors of the vertices were `smaller` [V] times what they are.
        """
        error = correction.by_way @ self.variance
        error = (error * np.square(smaller))[self.done]
        signal = np.maximum(self.signal[self.done], 0.0)
        signal = np.maximum(signal - error, 0.5 * signal)
        by_vertex = np.sqrt(np.divide(error, signal, out=np.zeros_like(error), where=signal > 0.0))
        total = float(np.sqrt(error.sum() / signal.sum())) if signal.sum() > 0.0 else 0.0
        if not by_vertex.size:
            return total, 0.0
        scattered = possible(by_vertex, correction.scatter.variance(self.together[self.done]))
        return total, float(np.percentile(scattered, 95, method="higher"))

    def worst_first(self, correction: Correction) -> NDArray[np.int64]:
        """Finite vertices by their relative error, the largest first."""
        error = correction.by_way @ self.variance
        relative = np.divide(error, self.signal, out=np.zeros_like(error), where=self.signal > 0.0)
        order = np.argsort(-relative, kind="stable")
        return order[(relative > 0.0)[order]]

    def as_arrays(self) -> dict[str, NDArray[Any]]:
        """All of it, to be kept."""
        sums = {name: np.asarray(value) for name, value in vars(self).items() if name != "_checks"}
        checks = {f"checks_{name}": self._all_checks(name) for name in _CHECKED}
        return sums | checks

    @classmethod
    def of_arrays(cls, arrays: dict[str, NDArray[Any]]) -> "Tally":
        """What `as_arrays` was made of."""
        tally = cls(len(arrays["done"]))
        for name, was in list(vars(tally).items()):
            if name != "_checks":
                setattr(tally, name, int(arrays[name]) if isinstance(was, int) else arrays[name])
        tally._checks = [Checks(evaluations=0, **{name: arrays[f"checks_{name}"] for name in _CHECKED})]
        return tally

    def _all_checks(self, name: str) -> NDArray[Any]:
        return np.concatenate([np.zeros(0, _CHECKED[name]), *(getattr(check, name) for check in self._checks)])


def _independent(vertices: NDArray[np.int64], together: Array) -> float:
    """How many numbers checks of these vertices [M] are worth, which have such shares [V] of their error in common."""
    found, many = np.unique(vertices, return_counts=True)
    return float((many / (1.0 + (many - 1.0) * together[found] ** 2)).sum())


def _bound(variance: Array, squared: Array, noise: Array, independent: float) -> float:
    """The factor on sigma with which 1.96 of it holds 95 % of these errors, as far as so many independent ones tell.

    Their own noise spreads them. What as much of it once more makes of the percentile tells what it has made of it
    already (Cook and Stefanski, "Simulation-extrapolation estimation in parametric measurement error models", 1994).
    """
    known = variance > 0.0
    over, more = squared[known] / variance[known], noise[known] / variance[known]
    if not len(over):
        return 1.0
    seen, noisier = (float(np.percentile(each, 95.0)) for each in (over, np.concatenate([over + more, over - more])))
    factor = max(seen, 0.0) / np.sqrt(max(seen, noisier, 1e-300)) / BOUND
    weight = independent / (independent + BOUND_BEFORE)
    return float(np.clip(factor, 0.5, 2.0) ** weight)


def _ratio(stated: Array, squared: Array, before: float) -> float:
    """The factor on stated variances, nearer to what it was `before` the fewer and less certain the checks are."""
    if not len(stated) or not stated.sum() > 0.0:
        return before
    weight = BEFORE * float(stated.mean())
    found = (squared.sum() + before * weight) / (stated.sum() + weight)
    # Rare large errors make the sum uncertain, and a product of two noisy checks may even be negative.
    size = max(before * float(stated.sum()), float(squared.sum()))
    certain = size**2 / (size**2 + float((squared**2).sum()))
    return float(np.clip(certain * found + (1.0 - certain) * before, LEAST, MOST))
