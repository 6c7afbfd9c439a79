"""Settings, validation samples and results of an adaptive bake."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from bakers.adaptive.evaluation_cache import NO_CACHE, EvaluationCache
from bakers.adaptive.lattice_noise import LatticeNoise
from bakers.adaptive.lattice_pools import Pools
from bakers.adaptive.nested_lattice import NestedLattice
from bakers.adaptive.view_levels import Level
from bakers.adaptive.view_survey import ViewSurvey
from bakers.error_covariance import ViewFrames
from formats.asset.error_covariance import ErrorCovariance

Array = NDArray[np.float64]
Index = NDArray[np.int64]

METHODS = "interpolated", "shared", "alone", "nearby"
"""Keys, in an asset's provenance, of the methods by which bins are computed: interpolation between bins, the vertex's
shared or learned lattices, the bin's own lattice, and interpolation between vertices.
"""
FROM_VERTICES = METHODS.index("nearby")
SAMPLE_FIELDS = "method", "stated", "squared", "noise"
"""Fields of a validation sample."""
VERTEX_FIELDS = (
    "coefficients", "standard_error", "directions", "method", "correlated", "covariance", "channels", "apart",
)  # fmt: skip
"""Fields of a vertex."""
MISSED_SHARE = 0.3
Lattices = Literal["own", "shared", "learned"]


@dataclass(frozen=True)
class RefinementSettings:
    """Tolerances and lattices of a refinement."""

    levels: list[Level]
    lattice: NestedLattice
    rotations: Callable[[Index], Array]
    """Vertices [n] → rotations [n,3,3] of the lattice, uniform on SO(3)."""
    rotate: Callable[[Array], Array]
    """Rotations [n,3,3] → their matrices on coefficients [n,K,K]."""
    noise: LatticeNoise
    """Noise of the nested lattice that the bins of a vertex share."""
    pools: Pools
    pool_noise: LatticeNoise
    lattices: Lattices
    """Lattices that bins are integrated over. "own": each bin has its own. "shared": the bins of a vertex share a
    nested one, so that finer bins can be compared with coarser ones direction by direction; bins that need more
    directions have their own. "learned": the bins are fitted to components of their vertex's light over a few lattices.
    """
    relative_residual: float
    """Average mean square residual over the mean square coefficient."""
    light_tolerance: float
    """Tolerated integration error of a bin, relative to the rms coefficient of its vertex."""
    view_tolerance: float
    """Tolerated prediction error of a bin, relative to the same."""
    validation_noise: float
    """Noise of each of the two estimates of a validation sample, relative to the same."""
    floor: float
    """Least rms coefficient that the errors of a vertex are relative to."""
    initial_sizes: int
    """Number of lattice sizes that every evaluated bin starts with: enough to resolve the narrowest features."""
    full_levels: int
    """All bins of levels up to this one are evaluated."""
    survey: ViewSurvey | None
    """All bins of a few vertices; None once `full_levels` accounts for it, or if all bins are evaluated anyway."""
    finest_error: float
    """Relative error of the bins evaluated in the most directions, at half of these directions."""
    missed_error: Array
    """Undetected error of each lattice size, relative to the rms coefficient."""
    validation_bins: Callable[[Index], NDArray[np.bool_]]
    """Vertices [n] → bins [n,B] that are validated against independent directions."""
    frames: ViewFrames
    """View frames in which the error covariance is expressed."""
    cache: EvaluationCache = NO_CACHE
    """Values of earlier evaluations."""

    def initial_sizes_for(self, error: float) -> int:
        """The number of initial lattice sizes with which hardly any of that error stays undetected."""
        missing = np.flatnonzero(self.missed_error > MISSED_SHARE * error)
        if not len(missing):
            return 1
        # Most bins are resolved at the first size after the last undetected error, nearly all at the next.
        return min(int(missing[-1]) + 3, len(self.missed_error))

    def with_full_levels(self, error: float, view: float) -> "RefinementSettings":
        """The same settings with as many fully evaluated levels as keep undetected errors well below `error`, where a
        prediction error `view` is tolerated.
        """
        if self.survey is None:
            return self
        return replace(self, full_levels=self.survey.full_levels_for(error, view), survey=None)


@dataclass(frozen=True)
class ValidationSamples:
    """Validation of bins against independent estimates; each [M]."""

    rows: Index
    """Index of the bin's vertex in the block."""
    method: NDArray[np.uint8]
    """Method of the bin: indices into METHODS."""
    stated: Array
    """Variance stated by the estimate."""
    squared: Array
    """Squared error, mean over K and channels; an unbiased estimate that may be negative."""
    noise: Array
    """Numbers of zero mean with the variance of the noise of `squared`."""
    evaluations: int
    """Evaluations for these samples."""

    def with_rows(self, rows: Index, other: "ValidationSamples") -> "ValidationSamples":
        """These samples, with those of the vertices `rows` [m] replaced by `other`."""
        kept = ~np.isin(self.rows, rows)
        merged = np.concatenate([self.rows[kept], rows[other.rows]])
        order = np.argsort(merged, kind="stable")
        parts = {name: (getattr(self, name)[kept], getattr(other, name)) for name in SAMPLE_FIELDS}
        fields = {name: np.concatenate(each)[order] for name, each in parts.items()}
        return ValidationSamples(rows=merged[order], evaluations=other.evaluations, **fields)


def validation_noise(rows: Index, one: Array, other: Array) -> Array:
    """Numbers [M] of zero mean with the variance of the noise of one times other, each [M,K,3]; rows ascend.

    The sum of the two at a bin is multiplied by their difference at the next bin of the vertex. At the same bin the
    product would also contain the difference in accuracy of the two lattices.
    """
    following = np.arange(1, len(rows) + 1)
    ends = np.flatnonzero(np.append(rows[1:], -1) != rows) if len(rows) else following
    following[ends] = np.searchsorted(rows, rows[ends])
    return np.asarray(((one + other) * (one - other)[following]).mean(axis=(1, 2)) / 2.0)


@dataclass(frozen=True)
class RefinedBlock:
    """Refined coefficients of a block of n vertices."""

    coefficients: NDArray[np.float32]
    """[n,B,K,3]"""
    standard_error: NDArray[np.float32]
    """[n,B], one sigma, rms over K and channels, before the calibration."""
    directions: NDArray[np.uint16]
    """[n,B], number of directions that each bin was evaluated in; 0 for interpolated bins."""
    method: NDArray[np.uint8]
    """[n,B], method of each bin: indices into METHODS."""
    correlated: NDArray[np.float32]
    """[n], fraction of the stated variance that the bins of a vertex have in common, from shared lattices."""
    covariance: NDArray[np.float32]
    """[n,P], error covariance of each vertex."""
    channels: NDArray[np.float32]
    """[n,3], error share of each channel."""
    apart: NDArray[np.float32]
    """[n,2], independent fractions of the error (`formats.asset.error_covariance`)."""
    evaluations: int
    recalled: int
    """Evaluations that came from the cache."""
    validation: ValidationSamples

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Vertices [n] at which all values are finite."""
        return np.asarray(
            np.isfinite(self.coefficients).all(axis=(1, 2, 3)) & np.isfinite(self.standard_error).all(axis=1)
        )

    @property
    def error_covariance(self) -> ErrorCovariance:
        """Error covariance of each vertex."""
        return ErrorCovariance(self.covariance, self.channels, self.apart)

    def as_arrays(self) -> dict[str, NDArray[Any]]:
        """All fields as arrays for a checkpoint."""
        own = {name: np.asarray(values) for name, values in vars(self).items() if name != "validation"}
        samples = {f"validation_{name}": np.asarray(values) for name, values in vars(self.validation).items()}
        return own | samples

    @classmethod
    def from_arrays(cls, arrays: dict[str, NDArray[Any]]) -> "RefinedBlock":
        """Inverse of `as_arrays`."""
        own = {name: arrays[name] for name in VERTEX_FIELDS}
        samples = {name: arrays[f"validation_{name}"] for name in ("rows", *SAMPLE_FIELDS)}
        validation = ValidationSamples(evaluations=int(arrays["validation_evaluations"]), **samples)
        evaluations, recalled = int(arrays["evaluations"]), int(arrays["recalled"])
        return cls(**own, evaluations=evaluations, recalled=recalled, validation=validation)

    def without_cost(self) -> "RefinedBlock":
        """The same block from an earlier pass, with no evaluations counted."""
        return replace(self, evaluations=0, recalled=0, validation=replace(self.validation, evaluations=0))

    def with_rows(self, rows: Index, other: "RefinedBlock") -> "RefinedBlock":
        """This block with the vertices in places `rows` [m] replaced by those of `other`, and the evaluations of
        `other`.
        """
        parts = dict[str, NDArray[Any]]()
        for name in VERTEX_FIELDS:
            merged = getattr(self, name).copy()
            merged[rows] = getattr(other, name)
            parts[name] = merged
        validation = self.validation.with_rows(rows, other.validation)
        return RefinedBlock(**parts, evaluations=other.evaluations, recalled=other.recalled, validation=validation)


def joined(count: int, parts: Sequence[tuple[Index, RefinedBlock]]) -> RefinedBlock:
    """A block of `count` vertices from its parts, each with the places [m] of its vertices."""
    some = parts[0][1]
    arrays = dict[str, NDArray[Any]]()
    for name in VERTEX_FIELDS:
        merged = np.zeros((count, *getattr(some, name).shape[1:]), getattr(some, name).dtype)
        for rows, part in parts:
            merged[rows] = getattr(part, name)
        arrays[name] = merged
    rows = np.concatenate([rows[part.validation.rows] for rows, part in parts])
    order = np.argsort(rows, kind="stable")
    samples = {name: [getattr(part.validation, name) for _rows, part in parts] for name in SAMPLE_FIELDS}
    fields = {name: np.concatenate(each)[order] for name, each in samples.items()}
    sample_evaluations = sum(part.validation.evaluations for _rows, part in parts)
    validation = ValidationSamples(rows=rows[order], evaluations=sample_evaluations, **fields)
    taken, recalled = (sum(getattr(part, name) for _rows, part in parts) for name in ("evaluations", "recalled"))
    return RefinedBlock(**arrays, evaluations=taken, recalled=recalled, validation=validation)
