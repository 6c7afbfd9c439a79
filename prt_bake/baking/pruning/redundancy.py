"""How much coefficients differ between views, bands and channels, measured by a pilot at a few vertices."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bakers.adaptive.view_levels import view_levels
from bakers.evaluation import values_at
from formats.mesh import Mesh
from prt_bake.baking.job.lattices import pair_rotations, sample_without_replacement
from prt_bake.baking.job.views import Views
from prt_bake.mathematics import sh, sphere

Array = NDArray[np.float64]
Index = NDArray[np.int64]

WORST = 4.0
"""A single vertex may deviate this many times as much as the object may."""
DIRECTIONS, VIEWS = 128, 11
FEWEST_VERTICES, MOST_VERTICES, VERTEX_SHARE = 3, 24, 64
"""The pilot takes one of `VERTEX_SHARE` vertices, within these limits."""
_PILOT_STREAM = 5


class Deviation(NamedTuple):
    """A difference over the root mean square coefficient, of all vertices and of the worst vertex."""

    total: float
    worst: float

    def within(self, tolerated: float) -> bool:
        """Whether coefficients that differ by this may be merged."""
        return self.total <= tolerated and self.worst <= WORST * tolerated

    def reason(self, what: str) -> str:
        """The measurement in words, for differences between `what`."""
        return f"{what} differ by {self.total:.2g} of the coefficients, {self.worst:.2g} at the worst vertex of a pilot"


@dataclass(frozen=True)
class Redundancy:
    """What the pilot measured."""

    views: Deviation
    """Of single views from the mean over views."""
    bands: list[Deviation]
    """For each degree, the bands above it."""
    channels: Deviation
    """Of single channels from the mean over channels."""
    by_band: Array
    """Norm of each band [L+1,3], mean over vertices and views."""
    signal: float
    """Mean square coefficient."""
    evaluations: int


@np.errstate(invalid="ignore", over="ignore")
def measure_redundancy(
    transport: Any, mesh: Mesh, vertices: Index, degree: int, outgoing: Views, bins: Index, seed: int
) -> Redundancy:
    """Projects Ŝ at a few of `vertices` and at the view bins `bins` [b]; bins of a vertex use the same directions."""
    size = directions_for(degree)
    chosen = vertices[np.sort(sample_without_replacement(seed + 4, len(vertices), pilot_size(vertices)))]
    towards = outgoing(chosen)[0][:, bins]
    directions = sphere.fibonacci(size)
    harmonics = sh.evaluate(directions, degree)
    fit = np.linalg.solve(harmonics.T @ harmonics, harmonics.T)
    incident = directions @ pair_rotations(seed, size, _PILOT_STREAM, chosen).transpose(0, 2, 1)
    rows = np.repeat(np.arange(len(chosen)), len(bins))
    values = values_at(transport, incident, rows, mesh.positions[chosen][rows], towards.reshape(-1, 3))
    a = (fit @ values.astype(np.float64)).reshape(len(chosen), len(bins), -1, 3)
    a = a[np.isfinite(a).all(axis=(1, 2, 3))]
    evaluations = len(rows) * size
    if not len(a):
        none = Deviation(np.inf, np.inf)
        return Redundancy(none, [none] * (degree + 1), none, np.ones((degree + 1, 3)), 0.0, evaluations)
    squares = (a**2).sum(axis=(1, 2, 3))
    above = [a[:, :, (d + 1) ** 2 :] for d in range(degree + 1)]
    by_band = [np.sqrt((a[:, :, d**2 : (d + 1) ** 2] ** 2).sum(axis=2).mean(axis=(0, 1))) for d in range(degree + 1)]
    return Redundancy(
        views=_deviation(a - a.mean(axis=1, keepdims=True), squares),
        bands=[_deviation(band, squares) for band in above],
        channels=_deviation(a - a.mean(axis=3, keepdims=True), squares),
        by_band=np.array(by_band),
        signal=float((a**2).mean()),
        evaluations=evaluations,
    )


def directions_for(degree: int) -> int:
    """Directions of the pilot at each view bin."""
    return max(DIRECTIONS, 6 * sh.count(degree))


def pilot_size(vertices: Index) -> int:
    """Vertices of the pilot."""
    return min(int(np.clip(len(vertices) // VERTEX_SHARE, FEWEST_VERTICES, MOST_VERTICES)), len(vertices))


def pilot_bins(local: Array) -> Index:
    """At most `VIEWS` view bins, spread over all of `local` [B,3]."""
    levels = view_levels(local)
    return np.sort(np.concatenate([level.bins for level in levels])[:VIEWS])


def _deviation(difference: Array, squares: Array) -> Deviation:
    """The root of Σ difference² over Σ squares, of all vertices and of the worst one."""
    each = (difference**2).sum(axis=(1, 2, 3))
    if not squares.sum() > 0.0:
        return Deviation(0.0, 0.0)
    worst = np.divide(each, squares, out=np.zeros_like(each), where=squares > 0.0)
    return Deviation(float(np.sqrt(each.sum() / squares.sum())), float(np.sqrt(worst.max())))
