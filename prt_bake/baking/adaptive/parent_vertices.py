"""Chooses the vertices from which all others are interpolated: one per cell, with the largest usable cells."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bakers.adaptive.records import RefinementSettings
from bakers.adaptive.vertex_interpolation import PARENTS, Parents, VertexInterpolator, one_per_cell, rotated_with_normal
from bakers.evaluation import values_at
from prt_bake.baking.adaptive.adaptive_job import MANY, AdaptiveJob
from prt_bake.baking.job.lattices import sample_without_replacement
from prt_bake.mathematics import sphere
from prt_bake.mathematics.random import hashed

Array = NDArray[np.float64]
Index = NDArray[np.int64]

FEWEST_VERTICES, FEWEST_SECTORS = 1500, 32
"""Objects of fewer vertices or sectors are not interpolated: frames are rotated, and few sectors do not determine the
values between them.
"""
SPACINGS = 2.0, 3.0, 4.0, 6.0, 8.0
"""Cell sizes that are tried, in distances to the nearest vertex."""
TRIAL_VERTICES, TRIAL_BINS, TRIAL_DIRECTIONS, TRIAL_SHARE = 48, 8, (64, 512), 0.03
"""Vertices, bins and range of directions of the trials of cell sizes; the number of directions is chosen such that all
trials cost this share of the bake.
"""
TESTED_BINS, TESTED_SHARE = 4, 0.06
"""Most bins at which an interpolated vertex is compared with the transport, and largest cost of that test over the cost
of evaluating the vertex.
"""
INTERPOLATION_TIME, WORTH = 2.0, 0.5
"""Time to interpolate a bin, in network evaluations; and largest cost with interpolation over the cost without."""
TOLERANCE = 0.8
"""Largest error of an interpolated vertex at its tested bins, over the requested error."""
TRIAL_TOLERANCE, ELSEWHERE = 0.85, 0.7
"""Limits in trials, which have no noise, over that error: on the error at the tested bins of a vertex, and on the rms
error at other bins of all vertices that pass. Noise of the parents adds to both; its variance at other bins is a third
of that at the tested bins.
"""
_CELL_STREAM, _TEST_STREAM = 41, 42


@dataclass(frozen=True)
class Interpolation:
    """The vertices that are evaluated, and how the others are interpolated.

    Attributes:
        spacing: size of the cells; one vertex of each is evaluated.
        error: largest relative error of an interpolated vertex.
        bins: number of bins at which an interpolated vertex is compared with the transport.
        per_bin: directions at each of these bins, about, of both lattices together.
        passing: predicted share of interpolated vertices that pass this test.
        per_vertex: predicted evaluations of an evaluated vertex, without validation samples.
        evaluated: mask [n] of the baked vertices.
        numbers: [C], indices of the evaluated vertices.
    """

    spacing: float
    error: float
    bins: int
    per_bin: float
    passing: float
    per_vertex: float
    evaluated: NDArray[np.bool_]
    numbers: Index
    interpolator: VertexInterpolator

    @property
    def mean_evaluations(self) -> float:
        """Mean evaluations of a vertex, without validation samples."""
        interpolated = self.bins * self.per_bin + (1.0 - self.passing) * self.per_vertex
        return self.share * self.per_vertex + (1.0 - self.share) * interpolated

    @property
    def ahead(self) -> float:
        """Share of the work that is done when all vertices to interpolate from are evaluated."""
        return self.share * self.per_vertex / self.mean_evaluations

    @property
    def share(self) -> float:
        """Share of the vertices that are evaluated first."""
        return float(self.evaluated.mean())

    def parents(self, job: AdaptiveJob, vertices: Index) -> Parents:
        """The vertices from which these are interpolated."""
        normals = job.mesh.normals[vertices]
        return self.interpolator.parents(job.mesh.positions[vertices], normals, sphere.tangent_frame(normals))


def choose_interpolation(
    job: AdaptiveJob, refinement: RefinementSettings, error: float, per_vertex: float, per_bin: float
) -> tuple[Interpolation | None, int]:
    """The cheapest interpolation for that error, from trials at a few vertices, and the evaluations of the trials. None
    if it saves too little over evaluating all vertices with `per_vertex` evaluations each.

    per_bin: directions of a comparison with the transport, of two lattices together.
    """
    few = len(job.vertices) < FEWEST_VERTICES or job.many < MANY
    if few or job.grid is None or job.grid[1] < FEWEST_SECTORS:
        return None, 0
    bins = int(np.clip(TESTED_SHARE * per_vertex / max(per_bin, 1.0), 1, min(TESTED_BINS, job.bins)))
    bins_of_trials = len(SPACINGS) * TRIAL_VERTICES * TRIAL_BINS * (PARENTS + 1)
    directions = int(np.clip(TRIAL_SHARE * per_vertex * len(job.vertices) / bins_of_trials, *TRIAL_DIRECTIONS))
    distance, usable, evaluations, most = _vertex_distance(job), list[Interpolation](), 0, 1.0
    for spacing in SPACINGS if distance > 0.0 else ():
        interpolation = cell_interpolation(job, spacing * distance, TOLERANCE * error, bins, per_bin, per_vertex)
        # With all vertices passing it would have to be cheap enough.
        if _cost(job, interpolation) < WORTH * per_vertex:
            passing, accurate, more = _trial(job, refinement, interpolation, directions)
            # Fewer vertices pass with larger cells; the opposite is chance.
            most, evaluations = min(most, passing), evaluations + more
            if accurate:
                usable.append(replace(interpolation, passing=most))
    best = min(usable, key=lambda interpolation: _cost(job, interpolation), default=None)
    return (best if best is not None and _cost(job, best) < WORTH * per_vertex else None), evaluations


def _cost(job: AdaptiveJob, interpolation: Interpolation) -> float:
    """Mean cost of a vertex in evaluations, including the time of the interpolation."""
    return interpolation.mean_evaluations + INTERPOLATION_TIME * job.bins * (1.0 - interpolation.share)


def cell_interpolation(
    job: AdaptiveJob, spacing: float, error: float, bins: int, per_bin: float, per_vertex: float
) -> Interpolation:
    """Interpolation from one vertex per cell of that size; all others are assumed to pass."""
    vertices = job.vertices
    positions, normals = job.mesh.positions[vertices], job.mesh.normals[vertices]
    evaluated = one_per_cell(positions, normals, spacing, hashed(_CELL_STREAM, job.seed, vertices))
    interpolator = VertexInterpolator(
        positions[evaluated], normals[evaluated], sphere.tangent_frame(normals[evaluated])
    )
    return Interpolation(spacing, error, bins, per_bin, 1.0, per_vertex, evaluated, vertices[evaluated], interpolator)


def _vertex_distance(job: AdaptiveJob) -> float:
    """Median distance between neighbouring vertices."""
    from scipy.spatial import cKDTree

    positions = job.mesh.positions[job.vertices]
    chosen = sample_without_replacement(job.seed + 6, len(positions), 256)
    return float(np.median(cKDTree(positions).query(positions[chosen], 2)[0][:, 1]))


def _trial(
    job: AdaptiveJob, refinement: RefinementSettings, interpolation: Interpolation, directions: int
) -> tuple[float, bool, int]:
    """Interpolates a few vertices. Returns the share that passes at the tested bins, less one sigma; whether these are
    accurate at other bins too; and evaluations.
    """
    rest = job.vertices[~interpolation.evaluated]
    chosen = rest[sample_without_replacement(job.seed + 7, len(rest), min(TRIAL_VERTICES, len(rest)))]
    parents = interpolation.parents(job, chosen)
    errors, evaluations = _interpolation_errors(job, refinement, interpolation, parents, chosen, directions)
    passing = (errors[:, : interpolation.bins] ** 2).mean(axis=1) <= (TRIAL_TOLERANCE * interpolation.error) ** 2
    elsewhere = errors[passing, interpolation.bins :]
    accurate = elsewhere.size > 0 and bool(np.sqrt((elsewhere**2).mean()) <= ELSEWHERE * interpolation.error)
    share = float(passing.sum() / len(chosen))
    return max(share - float(np.sqrt(share * (1.0 - share) / len(chosen))), 0.0), accurate, evaluations


def _interpolation_errors(
    job: AdaptiveJob,
    refinement: RefinementSettings,
    interpolation: Interpolation,
    parents: Parents,
    vertices: Index,
    directions: int,
) -> tuple[Array, int]:
    """Relative errors [m,bins] at random bins of those vertices that have usable parents, and evaluations. Vertex and
    parents are evaluated in the same directions, so that the errors have no noise of the light.
    """
    few, rows = min(directions, len(refinement.lattice.directions)), np.flatnonzero(parents.usable)
    lattice, fit = refinement.lattice.directions[:few], np.linalg.pinv(refinement.lattice.harmonics[:few])
    errors, normals, evaluations = np.zeros((len(rows), TRIAL_BINS)), job.mesh.normals, 0
    for number, row in enumerate(rows):
        vertex, used = vertices[row], np.flatnonzero(parents.weights[row] != 0.0)
        outgoing = job.views(vertices[row : row + 1])[0][0, tested_bins(job, vertex, TRIAL_BINS)]
        sources = interpolation.numbers[parents.indices[row][used]]
        rotated = rotated_with_normal(outgoing[None], normals[vertex][None, None], normals[sources][:, None])
        towards = np.concatenate([rotated, outgoing[None]]).reshape(-1, 3)
        positions = np.repeat(job.mesh.positions[np.append(sources, vertex)], TRIAL_BINS, axis=0)
        values = values_at(job.transport, lattice[None], np.zeros(len(towards), np.int64), positions, towards)
        a = (fit @ values.astype(np.float64)).reshape(len(sources) + 1, TRIAL_BINS, -1)
        with np.errstate(invalid="ignore", over="ignore"):
            difference = np.tensordot(parents.weights[row][used], a[:-1], axes=1) - a[-1]
            scale = np.maximum((a**2).mean(), refinement.floor**2)
            errors[number] = np.sqrt((difference**2).mean(axis=-1) / scale)
        evaluations += len(towards) * few
    return errors, evaluations


def tested_bins(job: AdaptiveJob, vertices: NDArray[np.integer], bins: int) -> Index:
    """The bins [...,bins] at which interpolated vertices [...] are compared with the transport."""
    keys = hashed(_TEST_STREAM, job.seed, np.asarray(vertices)[..., None], np.arange(bins))
    return np.asarray((keys % np.uint64(job.bins)).astype(np.int64))
