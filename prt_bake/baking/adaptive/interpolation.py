"""Interpolates vertices from their neighbours, on meshes that are finer than the detail of the transport.

One vertex per cell is evaluated first. The others are interpolated from these (`bakers.adaptive.vertex_interpolation`)
and compared with the transport at a few bins; those that fail are evaluated.
"""

from dataclasses import replace
from threading import Lock
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bakers.adaptive.records import FROM_VERTICES, RefinedBlock, RefinementSettings, ValidationSamples, joined
from bakers.adaptive.refinement import refine
from bakers.adaptive.vertex_interpolation import Parents
from bakers.adaptive.vertex_validation import validation_errors, validation_samples
from bakers.error_covariance import concatenated
from bakers.workers import Workers
from formats.asset.error_covariance import ErrorCovariance
from prt_bake.baking.adaptive.adaptive_job import AdaptiveJob
from prt_bake.baking.adaptive.checkpoints import ClampedBlock, PassCheckpoints
from prt_bake.baking.adaptive.interpolation_kernel import interpolated_from
from prt_bake.baking.adaptive.parent_vertices import Interpolation, tested_bins

_MOST_BYTES = 1 << 28
"""Of coefficients of evaluated vertices in memory."""
Array = NDArray[np.float64]
Index = NDArray[np.int64]


class Known(NamedTuple):
    """Evaluated vertices: places [G] among all evaluated ones, coefficients [G,B,K,3] and error covariances [G]."""

    places: Index
    coefficients: NDArray[np.float32]
    covariance: ErrorCovariance


class EvaluatedVertices:
    """The evaluated vertices of all blocks, read from the checkpoints when they are needed."""

    def __init__(self, job: AdaptiveJob, interpolation: Interpolation, checkpoints: PassCheckpoints) -> None:
        self._checkpoints, self._lock = checkpoints, Lock()
        places = np.flatnonzero(interpolation.evaluated)
        block = places // job.block_vertices
        self._first = block * job.block_vertices
        self._row = np.arange(len(places)) - np.searchsorted(block, block)
        self._blocks: dict[int, RefinedBlock] = {}

    def of(self, places: Index) -> Known:
        """The vertices at these places [G] among the evaluated ones."""
        blocks = [(self._block(int(self._first[place])), self._row[place]) for place in places]
        covariances = [block.error_covariance.at_vertices(np.array([row])) for block, row in blocks]
        return Known(places, np.stack([block.coefficients[row] for block, row in blocks]), concatenated(covariances))

    def _block(self, first: int) -> RefinedBlock:
        with self._lock:
            if first in self._blocks:
                self._blocks[first] = self._blocks.pop(first)
                return self._blocks[first]
        found = self._checkpoints.require_evaluated(first)
        with self._lock:
            self._blocks[first] = found[0]
            while self._bytes() > _MOST_BYTES and len(self._blocks) > 1:
                del self._blocks[next(iter(self._blocks))]
            return found[0]

    def _bytes(self) -> int:
        return sum(block.coefficients.nbytes for block in self._blocks.values())


def interpolated_block(
    job: AdaptiveJob,
    refinement: RefinementSettings,
    interpolation: Interpolation,
    workers: Workers,
    checkpoints: PassCheckpoints,
    evaluated_vertices: EvaluatedVertices,
    first: int,
) -> ClampedBlock:
    """A block: evaluated vertices from the checkpoints; the others interpolated, or evaluated if that fails."""
    vertices = job.block(first)
    evaluated = interpolation.evaluated[first : first + len(vertices)]
    parts, clamped = list[tuple[Index, RefinedBlock]](), 0
    if evaluated.any():
        found = checkpoints.require_evaluated(first)
        parts, clamped = [(np.flatnonzero(evaluated), found[0])], found[1]
    rest = np.flatnonzero(~evaluated)
    if len(rest):
        parents = interpolation.parents(job, vertices[rest])
        places = np.unique(parents.indices[np.flatnonzero(parents.usable)])
        known = evaluated_vertices.of(places) if len(places) else None
        shared = job, refinement, interpolation
        block, more = workers.do(_interpolate_or_evaluate, shared, vertices[rest], parents, known)
        parts.append((rest, block))
        clamped += more
    return joined(len(vertices), parts), clamped


def _interpolate_or_evaluate(
    job: AdaptiveJob,
    refinement: RefinementSettings,
    interpolation: Interpolation,
    vertices: Index,
    parents: Parents,
    known: Known | None,
) -> ClampedBlock:
    outgoing, clamped = job.views(vertices)
    positions, transport = job.mesh.positions[vertices], job.transport
    rows, evaluations, parts = np.zeros(0, np.int64), 0, list[tuple[Index, RefinedBlock]]()
    if known is not None:
        rows, coefficients, variance = _interpolate(job, refinement, interpolation, parents, known)
        if len(rows):
            bins = tested_bins(job, vertices[rows], interpolation.bins)
            at = vertices[rows], positions[rows], outgoing[rows]
            squared, evaluations = validation_errors(transport, refinement, *at, coefficients, bins)
            good = squared.mean(axis=1) <= interpolation.error**2
            rows, coefficients, variance = rows[good], coefficients[good], variance[good]
        if len(rows):
            at = vertices[rows], positions[rows], outgoing[rows]
            samples = validation_samples(transport, refinement, *at, coefficients, variance)
            covariance = _mean_covariance(parents, rows, known)
            parts.append((rows, _as_block(coefficients, variance, covariance, samples)))
    if len(others := np.setdiff1d(np.arange(len(vertices)), rows)):
        at = vertices[others], positions[others], outgoing[others]
        parts.append((others, refine(transport, refinement, *at)))
    block = joined(len(vertices), parts)
    return replace(block, evaluations=block.evaluations + evaluations), clamped


def _interpolate(
    job: AdaptiveJob, refinement: RefinementSettings, interpolation: Interpolation, parents: Parents, known: Known
) -> tuple[Index, Array, Array]:
    """Rows [m] of vertices with small residuals, their coefficients [m,B,K,C] and variances [m,B]."""
    assert job.grid is not None
    by_view = np.ascontiguousarray(known.coefficients).reshape(len(known.places), *job.grid, -1)
    rows, coefficients, variances = list[int](), list[Array](), list[Array]()
    for row in np.flatnonzero(parents.usable):
        indices = np.searchsorted(known.places, parents.indices[row])
        values, variance = interpolated_from(by_view, indices, parents, int(row))
        scale = max(float((values**2).mean()), refinement.floor**2)
        if variance.mean() <= interpolation.error**2 * scale:
            rows.append(int(row))
            coefficients.append(values.reshape(job.bins, -1, 3))
            variances.append(variance)
    if not rows:
        return np.zeros(0, np.int64), np.zeros((0, job.bins, 0, 3)), np.zeros((0, job.bins))
    return np.array(rows), np.stack(coefficients), np.stack(variances)


def _mean_covariance(parents: Parents, rows: Index, known: Known) -> ErrorCovariance:
    """The mean error covariance of each vertex's parents; all its bins err together."""
    places = [np.searchsorted(known.places, parents.indices[row]) for row in rows]
    covariance, channels = (
        np.stack([each[some].mean(axis=0) for some in places]).astype(np.float64)
        for each in (known.covariance.covariance, known.covariance.channels)
    )
    apart = np.zeros((len(rows), 2), np.float32)
    return ErrorCovariance(covariance.astype(np.float32), channels.astype(np.float32), apart)


def _as_block(
    coefficients: Array, variance: Array, covariance: ErrorCovariance, samples: ValidationSamples
) -> RefinedBlock:
    return RefinedBlock(
        coefficients.astype(np.float32),
        np.sqrt(variance).astype(np.float32),
        np.zeros(variance.shape, np.uint16),
        np.full(variance.shape, FROM_VERTICES, np.uint8),
        np.ones(len(variance), np.float32),
        covariance.covariance,
        covariance.channels,
        covariance.apart,
        samples.evaluations,
        0,
        samples,
    )
