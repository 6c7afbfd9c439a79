"""Calibrates the stated variances of a refined bake with validation samples, and estimates its total error.

Interpolated bins, bins over a shared lattice and bins over their own lattices are validated against independent
directions separately, since their errors have different causes. The validated bins are a random sample, so the ratio of
observed to stated variance corrects the sum of the stated variances without bias. A prior worth a few bins stabilises
it.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bakers.adaptive.records import METHODS, SAMPLE_FIELDS, RefinedBlock, ValidationSamples
from bakers.adaptive.vertex_scatter import UNKNOWN, Scatter, default_variance, error_quantiles, measured_scatter

Array = NDArray[np.float64]

PRIOR_SAMPLES = 6.0
"""Weight of the prior, in validation samples."""
LEAST_RATIO, MOST_RATIO = 0.05, 1e4
BOUND_SIGMAS, PRIOR_BOUND_SAMPLES = 1.96, 20.0
"""Number of sigmas that hold 95 % of the errors, and the weight of that prior in validation samples."""
FAINT = 0.01
"""Bins below this fraction of their vertex's mean variance do not contribute to the bound: the noise of validation
samples is the same at all bins of a vertex.
"""
_SAMPLE_TYPES: dict[str, type] = {"rows": np.int64, "method": np.uint8, **dict.fromkeys(SAMPLE_FIELDS[1:], np.float64)}


@dataclass(frozen=True)
class Correction:
    """Factors on stated variances, one per method, and the factor on standard errors."""

    interpolated: float = 1.0
    shared_lattice: float = 1.0
    own_lattice: float = 1.0
    from_vertices: float = 1.0
    bound: float = 1.0
    """Factor on standard errors, so that 1.96 of them hold the errors of 95 % of the bins."""
    scatter: Scatter = UNKNOWN

    @property
    def factors(self) -> Array:
        """The factors [4], in the order of `bakers.adaptive.records.METHODS`."""
        return np.array([self.interpolated, self.shared_lattice, self.own_lattice, self.from_vertices])

    def standard_error(self, stated: NDArray[np.floating], method: NDArray[np.integer]) -> Array:
        """Calibrated standard errors from stated ones [...], such that 1.96 of them are a 95 % bound."""
        return np.asarray(self.bound * np.sqrt(self.factors[method]) * stated)


class Tally:
    """Totals over blocks: sums [V] over the bins of each vertex, variances by method [4,V], and all validation samples,
    with vertex numbers as rows.
    """

    def __init__(self, vertices: int) -> None:
        self.variance, self.signal = np.zeros((len(METHODS), vertices)), np.zeros(vertices)
        self.done, self.invalid = np.zeros(vertices, bool), np.zeros(vertices, bool)
        self.correlated = np.zeros(vertices)
        self.evaluations = self.recalled = self.validation_evaluations = self.evaluated_bins = self.bins = 0
        self._samples: list[ValidationSamples] = []

    def add(self, rows: NDArray[np.int64], refined: RefinedBlock) -> None:
        """Adds the vertices `rows` [n] of a block; vertices that are not finite count as zero."""
        finite, evaluated = refined.valid, refined.directions > 0
        variance = np.where(finite[:, None], refined.standard_error.astype(np.float64) ** 2, 0.0)
        for method in range(len(METHODS)):
            self.variance[method, rows] = (variance * (refined.method == method)).sum(axis=1)
        self.correlated[rows] = np.where(finite, refined.correlated, 0.0)
        sound = np.where(finite[:, None, None, None], refined.coefficients.astype(np.float64), 0.0)
        self.signal[rows] = (sound**2).mean(axis=(2, 3)).sum(axis=1)
        self.done[rows], self.invalid[rows] = True, ~finite
        self.evaluated_bins, self.bins = self.evaluated_bins + int(evaluated.sum()), self.bins + evaluated.size
        self.evaluations += refined.evaluations
        self.recalled += refined.recalled
        self.validation_evaluations += refined.validation.evaluations
        self._samples.append(replace(refined.validation, rows=rows[refined.validation.rows]))

    @property
    def new_evaluations(self) -> int:
        """Evaluations that did not come from the cache."""
        return self.evaluations - self.recalled

    @property
    def validated_bins(self) -> int:
        """Number of validation samples."""
        return sum(len(samples.stated) for samples in self._samples)

    def correction(self, before: Correction) -> Correction:
        """Calibration from the validation samples and the prior `before`."""
        vertices, method, stated, squared, noise = (self._all_samples(name) for name in ("rows", *SAMPLE_FIELDS))
        sound = np.isfinite(stated) & np.isfinite(squared)
        vertices, method, stated, squared, noise = (each[sound] for each in (vertices, method, stated, squared, noise))
        factors = [_ratio(stated[method == m], squared[method == m], was) for m, was in enumerate(before.factors)]
        found = Correction(factors[0], factors[1], factors[2], factors[3])
        corrected = found.factors[method] * stated
        prior = float(default_variance(self.correlated[vertices]).mean()) if len(vertices) else 0.0
        scatter = measured_scatter(vertices, corrected, squared, prior)
        significant = corrected >= FAINT * self._mean_variance(found)[vertices]
        independent = _independent(vertices[significant], self.correlated)
        bound = _bound(corrected[significant], squared[significant], noise[significant], independent)
        return replace(found, bound=bound, scatter=scatter)

    def _mean_variance(self, correction: Correction) -> Array:
        """Mean variance [V] of the bins of each vertex."""
        return np.asarray(correction.factors @ self.variance * (self.done.sum() / max(1, self.bins)))

    def relative(self, correction: Correction, scale: Array | float = 1.0) -> tuple[float, float]:
        """Relative RMSE of all baked vertices, and the 95th percentile over vertices of the error of one. The errors of
        the vertices are multiplied by `scale` [V].
        """
        error = correction.factors @ self.variance
        error = (error * np.square(scale))[self.done]
        signal = np.maximum(self.signal[self.done], 0.0)
        signal = np.maximum(signal - error, 0.5 * signal)
        by_vertex = np.sqrt(np.divide(error, signal, out=np.zeros_like(error), where=signal > 0.0))
        total = float(np.sqrt(error.sum() / signal.sum())) if signal.sum() > 0.0 else 0.0
        if not by_vertex.size:
            return total, 0.0
        scattered = error_quantiles(by_vertex, correction.scatter.variance(self.correlated[self.done]))
        return total, float(np.percentile(scattered, 95, method="higher"))

    def worst_first(self, correction: Correction) -> NDArray[np.int64]:
        """Finite vertices by relative error, the largest first."""
        error = correction.factors @ self.variance
        relative = np.divide(error, self.signal, out=np.zeros_like(error), where=self.signal > 0.0)
        order = np.argsort(-relative, kind="stable")
        return order[(relative > 0.0)[order]]

    def as_arrays(self) -> dict[str, NDArray[Any]]:
        """All totals as arrays for a checkpoint."""
        sums = {name: np.asarray(value) for name, value in vars(self).items() if name != "_samples"}
        samples = {f"samples_{name}": self._all_samples(name) for name in _SAMPLE_TYPES}
        return sums | samples

    @classmethod
    def from_arrays(cls, arrays: dict[str, NDArray[Any]]) -> "Tally":
        """Inverse of `as_arrays`."""
        tally = cls(len(arrays["done"]))
        for name, was in list(vars(tally).items()):
            if name != "_samples":
                setattr(tally, name, int(arrays[name]) if isinstance(was, int) else arrays[name])
        samples = {name: arrays[f"samples_{name}"] for name in _SAMPLE_TYPES}
        tally._samples = [ValidationSamples(evaluations=0, **samples)]
        return tally

    def _all_samples(self, name: str) -> NDArray[Any]:
        return np.concatenate([np.zeros(0, _SAMPLE_TYPES[name]), *(getattr(each, name) for each in self._samples)])


def _independent(vertices: NDArray[np.int64], correlated: Array) -> float:
    """Effective number of independent validation samples at these vertices [M], whose bins have the fractions
    `correlated` [V] of their error in common.
    """
    found, many = np.unique(vertices, return_counts=True)
    return float((many / (1.0 + (many - 1.0) * correlated[found] ** 2)).sum())


def _bound(variance: Array, squared: Array, noise: Array, independent: float) -> float:
    """Factor on sigma with which 1.96 sigma hold 95 % of these errors, shrunk to 1 for few independent samples.

    The noise of the samples widens their distribution. Adding the same noise once more shows how much it changed the
    percentile (Cook and Stefanski, "Simulation-extrapolation estimation in parametric measurement error models", 1994).
    """
    known = variance > 0.0
    ratio, noise_ratio = squared[known] / variance[known], noise[known] / variance[known]
    if not len(ratio):
        return 1.0
    observed, noisier = (
        float(np.percentile(each, 95.0)) for each in (ratio, np.concatenate([ratio + noise_ratio, ratio - noise_ratio]))
    )
    factor = max(observed, 0.0) / np.sqrt(max(observed, noisier, 1e-300)) / BOUND_SIGMAS
    weight = independent / (independent + PRIOR_BOUND_SAMPLES)
    return float(np.clip(factor, 0.5, 2.0) ** weight)


def _ratio(stated: Array, squared: Array, before: float) -> float:
    """Factor on stated variances, shrunk towards `before` for few or uncertain samples."""
    if not len(stated) or not stated.sum() > 0.0:
        return before
    weight = PRIOR_SAMPLES * float(stated.mean())
    found = (squared.sum() + before * weight) / (stated.sum() + weight)
    # Rare large errors make the sum uncertain, and a product of two noisy differences may be negative.
    size = max(before * float(stated.sum()), float(squared.sum()))
    certain = size**2 / (size**2 + float((squared**2).sum()))
    return float(np.clip(certain * found + (1.0 - certain) * before, LEAST_RATIO, MOST_RATIO))
