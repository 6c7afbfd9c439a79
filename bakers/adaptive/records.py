"""What a refined bake is told, and what comes of it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from bakers.adaptive.evaluation_cache import NOTHING, Answers
from bakers.adaptive.fit_residual import LightNoise
from bakers.adaptive.lattice_pools import Pools
from bakers.adaptive.nested_lattice import NestedLattice
from bakers.adaptive.view_levels import Level
from bakers.adaptive.view_survey import ViewSurvey
from bakers.error_covariance import Frames
from formats.asset.error_covariance import ErrorShape

Array = NDArray[np.float64]
Index = NDArray[np.int64]

WAYS = "foretold", "shared", "alone", "nearby"
"""How bins are come by: from their neighbours; over the lattice that all of a vertex share; over one of their own; from
those of the vertices around.
"""
HELD = "way", "stated", "squared", "noise"
"""What there is of every bin that is held against others."""
OF_VERTICES = "coefficients", "deviation", "directions", "way", "together", "covariance", "channels", "apart"
"""What there is of every vertex of a block."""
MISSED_OF_ERROR = 0.3
Lattices = Literal["own", "shared", "learned"]


@dataclass(frozen=True)
class Refinement:
    """How far to go, and by what means."""

    levels: list[Level]
    lattice: NestedLattice
    rotations: Callable[[Index], Array]
    """Vertices [n] → rotations [n,3,3] of the lattice, uniform on SO(3)."""
    rotate: Callable[[Array], Array]
    """Rotations [n,3,3] → what they do to coefficients [n,K,K]."""
    noise: LightNoise
    """Of the lattice that all of a vertex share."""
    pools: Pools
    pool_noise: LightNoise
    lattices: Lattices
    """Which lattices bins are integrated over: "own", each over one of its own; "shared", all of a vertex over one that
    grows, so that finer bins can be held against coarser ones in as many directions, and those that need more over one
    of their own; "learned", in few directions, by what their vertex has learned of its light over a few lattices.
    """
    roughness: float
    """What a fit leaves over, over the mean square coefficient, as it is on average."""
    light: float
    """Error of directions tolerated at a bin, over the root mean square coefficient of its vertex."""
    view: float
    """Error of prediction tolerated at a bin, over the same."""
    checked: float
    """Noise of each half of a check, over the same."""
    floor: float
    """Least root mean square of a vertex's coefficients that errors are held against."""
    begin: int
    """Sizes of the lattice that every evaluated bin has to begin with: enough not to miss the narrowest detail."""
    always: int
    """Levels of view bins up to this one are evaluated whole."""
    survey: ViewSurvey | None
    """Of all bins of a few vertices; None once `always` allows for it, or where all bins are evaluated anyway."""
    finest: float
    """Relative error that half of the most directions that bins were looked at in leave there."""
    missed: Array
    """What each size of the lattice misses without telling so, over the root mean square coefficient."""
    checks: Callable[[Index], NDArray[np.bool_]]
    """Vertices [n] → bins [n,B] at which the truth is sought besides, to hold the estimate against."""
    frames: Frames
    """Of views, in which it is told how errors hang together."""
    answers: Answers = NOTHING
    """What was evaluated before."""

    def begin_for(self, error: float) -> int:
        """How many sizes to begin with so that hardly any of that error is missed without telling."""
        missing = np.flatnonzero(self.missed > MISSED_OF_ERROR * error)
        if not len(missing):
            return 1
        # The first size at which most bins see what there is; with the next one hardly any do not.
        return min(int(missing[-1]) + 3, len(self.missed))

    def for_views(self, error: float, view: float) -> "Refinement":
        """The same, with as many levels of view bins evaluated whole as it takes for hardly any of that error to be
        missed untold, where an error of prediction `view` is tolerated.
        """
        return self if self.survey is None else replace(self, always=self.survey.always_for(error, view), survey=None)


@dataclass(frozen=True)
class Checks:
    """Bins at which an estimate was held against an independent one; each [M]."""

    rows: Index
    """Whose bins they are: the place of the vertex in its block."""
    way: NDArray[np.uint8]
    """How the bin was come by: places in WAYS."""
    stated: Array
    """Variance as it was estimated."""
    squared: Array
    """Squared error, mean over K and channels, without bias for the noise of the check: at times negative."""
    noise: Array
    """Numbers of zero mean that vary as the noise in `squared` does."""
    evaluations: int
    """That these took."""

    def with_rows(self, rows: Index, other: "Checks") -> "Checks":
        """These checks, those of the vertices in these places [m] from `other`."""
        stay = ~np.isin(self.rows, rows)
        order = np.argsort(np.concatenate([self.rows[stay], rows[other.rows]]), kind="stable")
        held = [np.concatenate([getattr(self, name)[stay], getattr(other, name)])[order] for name in HELD]
        return Checks(
            np.concatenate([self.rows[stay], rows[other.rows]])[order],
            held[0],
            held[1],
            held[2],
            held[3],
            other.evaluations,
        )


def noise_of_checks(rows: Index, one: Array, other: Array) -> Array:
    """Numbers [M] of no mean that vary as the noise does of one times the other, each [M,K,3]; rows ascend.

    What both say of a bin times what they differ by at the next of its vertex: at the same bin that would tell as well
    how much nearer one of the two lattices is than the other.
    """
    following = np.arange(1, len(rows) + 1)
    ends = np.flatnonzero(np.append(rows[1:], -1) != rows) if len(rows) else following
    following[ends] = np.searchsorted(rows, rows[ends])
    return np.asarray(((one + other) * (one - other)[following]).mean(axis=(1, 2)) / 2.0)


@dataclass(frozen=True)
class Refined:
    """What came of a block of n vertices."""

    coefficients: NDArray[np.float32]
    """[n,B,K,3]"""
    deviation: NDArray[np.float32]
    """[n,B], one sigma, rms over K and channels, before it is held against the checks."""
    directions: NDArray[np.uint16]
    """[n,B], in how many each bin was evaluated; 0 where it is foretold from its neighbours."""
    way: NDArray[np.uint8]
    """[n,B], how each bin was come by: places in WAYS."""
    together: NDArray[np.float32]
    """[n], share of the stated variance that the bins of a vertex have from one lattice, and so in common."""
    covariance: NDArray[np.float32]
    """[n,P], and"""
    channels: NDArray[np.float32]
    """[n,3], and"""
    apart: NDArray[np.float32]
    """[n,2]: how the errors of each vertex hang together (`formats.asset.error_covariance`)."""
    evaluations: int
    recalled: int
    """Evaluations that were known from before."""
    checks: Checks

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Vertices [n] at which all is finite."""
        return np.asarray(np.isfinite(self.coefficients).all(axis=(1, 2, 3)) & np.isfinite(self.deviation).all(axis=1))

    @property
    def shape(self) -> ErrorShape:
        """How the errors of each vertex hang together."""
        return ErrorShape(self.covariance, self.channels, self.apart)

    def for_nothing(self) -> "Refined":
        """The same, from an earlier pass: it took nothing."""
        return replace(self, evaluations=0, recalled=0, checks=replace(self.checks, evaluations=0))

    def with_rows(self, rows: Index, other: "Refined") -> "Refined":
        """This block with the vertices in these places [m] as `other` has them; it took what `other` took."""
        parts = dict[str, NDArray[Any]]()
        for name in OF_VERTICES:
            whole = getattr(self, name).copy()
            whole[rows] = getattr(other, name)
            parts[name] = whole
        checks = self.checks.with_rows(rows, other.checks)
        return Refined(**parts, evaluations=other.evaluations, recalled=other.recalled, checks=checks)


def joined(count: int, parts: Sequence[tuple[Index, Refined]]) -> Refined:
    """A block of `count` vertices from parts of it, each with the places [m] of its vertices."""
    some = parts[0][1]
    arrays = dict[str, NDArray[Any]]()
    for name in OF_VERTICES:
        whole = np.zeros((count, *getattr(some, name).shape[1:]), getattr(some, name).dtype)
        for rows, part in parts:
            whole[rows] = getattr(part, name)
        arrays[name] = whole
    rows = np.concatenate([rows[part.checks.rows] for rows, part in parts])
    order = np.argsort(rows, kind="stable")
    held = [np.concatenate([getattr(part.checks, name) for _rows, part in parts])[order] for name in HELD]
    checked = sum(part.checks.evaluations for _rows, part in parts)
    checks = Checks(rows[order], held[0], held[1], held[2], held[3], checked)
    taken, recalled = (sum(getattr(part, name) for _rows, part in parts) for name in ("evaluations", "recalled"))
    return Refined(**arrays, evaluations=taken, recalled=recalled, checks=checks)
