"""Bakes a block of vertices with a fixed number of samples at every bin: coefficients and their standard errors.

A block's numbers depend on its vertices alone, not on the block boundaries or the number of workers.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bakers.error_covariance import ViewFrames, error_sums, normalised_covariance
from bakers.error_estimate import (
    ROUNDING,
    Estimator,
    half_buffer_variance,
    neighbour_errors,
    unreliable_vertices,
    validated_variance,
)
from bakers.evaluation import values_on_sets
from bakers.path_traced import Walks, WalkStatistics, vertices_walked_at_once, walk_block
from bakers.plan import vertices_at_once
from bakers.projection import DirectionPool, project, residual_variance, residuals_of
from formats.asset.error_covariance import ErrorCovariance

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Block:
    """Coefficients of consecutive vertices."""

    first_vertex: int
    coefficients: NDArray[np.float32]
    """[n,B,K,3]; zero at vertices that are not valid."""
    standard_error: NDArray[np.float32]
    """[n,B], one sigma, rms over K and channels."""
    valid: NDArray[np.bool_]
    """[n], false where the transport returned values that are not finite."""
    clamped: int
    """Number of bins whose direction was below the horizon and was clamped to it."""
    statistics: WalkStatistics | None = None
    """Statistics of the random walks, for path-traced coefficients."""
    extra_evaluations: int = 0
    """Evaluations beyond `samples` at every bin."""
    correlated: NDArray[np.float32] | None = None
    """[n], fraction of the squared error that all bins of a vertex have in common; None means all of it."""
    error_covariance: ErrorCovariance | None = None
    """Error covariance of each vertex, where it is known."""
    bound: float = 1.0
    """Factor from the rms error to `standard_error`, chosen so that 1.96 standard errors are a 95 % bound."""


@dataclass(frozen=True)
class Sampling:
    """How the incident directions are sampled at every bin."""

    pool: DirectionPool
    rotation: Callable[[int, int], NDArray[np.int64]]
    """(first vertex, last vertex) → index of the direction set that each bin uses, [n,B]."""
    second_rotation: Callable[[int, int], NDArray[np.int64]] | None
    """A second set for each bin, for estimators that compare two sets at all bins or at the validation bins."""
    estimator: Estimator
    validation_bins: Callable[[int, int], NDArray[np.int64]] | None = None
    """(first vertex, last vertex) → validation bins [n,m]. They are evaluated on the second set where the difference of
    neighbouring bins is no reliable estimate.
    """


@dataclass(frozen=True)
class Task:
    """A transport and the vertices and bins to bake it at."""

    transport: Any
    positions: Array
    """[V,3] in object space."""
    outgoing: Callable[[NDArray[np.int64]], tuple[Array, int]]
    """Vertices [n] → directions to the eye [n,B,3] and the number of them that were clamped to the horizon."""
    bins: int
    sectors: int
    sampling: Sampling | Walks
    frames: ViewFrames | None = None
    """View frames in which the error covariance is expressed; None: no covariance is computed."""


def cuts(task: Task, vertices: NDArray[np.int64]) -> list[tuple[int, int]]:
    """Ranges (first, last + 1) of the blocks that bake these vertices, which are in ascending order."""
    runs = np.split(vertices, np.flatnonzero(np.diff(vertices) > 1) + 1)
    size = block_size(task)
    spans = [(int(run[0]), int(run[-1]) + 1) for run in runs if len(run)]
    return [(first, min(first + size, end)) for start, end in spans for first in range(start, end, size)]


def block_size(task: Task) -> int:
    """Vertices per block."""
    if isinstance(task.sampling, Walks):
        return vertices_walked_at_once(task.bins, task.sampling.paths)
    return vertices_at_once(task.bins, task.sampling.pool.incident.shape[1])


def bake_block(task: Task, first: int, last: int) -> Block:
    """Bakes vertices first … last − 1."""
    vertices, statistics, extra = np.arange(first, last), None, 0
    outgoing, clamped = task.outgoing(vertices)
    if isinstance(task.sampling, Walks):
        positions = task.positions[first:last]
        coefficients, squares, statistics = walk_block(task.transport, task.sampling, positions, outgoing, first)
        variance, errors = squares.mean(axis=(2, 3)), _walk_errors(squares)
        sums = _covariance_sums(task, vertices, outgoing, errors)
        clamped += statistics.clamped
    else:
        coefficients, variance, sums, extra = _sample(task, task.sampling, outgoing, first, last)
    with np.errstate(over="ignore"):
        rounded = coefficients.astype(np.float32)
    valid = np.asarray(np.isfinite(rounded).all(axis=(1, 2, 3)) & np.isfinite(variance).all(axis=1))
    rounded[~valid] = 0.0
    least = ROUNDING**2 * np.square(rounded, dtype=np.float64).mean(axis=(2, 3))
    standard_error = np.sqrt(np.where(valid[:, None], np.maximum(variance, least), 0.0)).astype(np.float32)
    error_covariance = None
    if sums is not None:
        error_covariance = normalised_covariance(*sums, np.ones(len(valid)), coefficients.shape[2])
    return Block(first, rounded, standard_error, valid, clamped, statistics, extra, error_covariance=error_covariance)


def _walk_errors(squares: Array) -> Array:
    """Numbers [n,B,K,K·3] that have the variances [n,B,K,3]: the estimates of different harmonics are independent."""
    n, bins, count, channels = squares.shape
    each = np.sqrt(squares)[:, :, :, None] * np.eye(count)[:, :, None]
    return np.asarray(each.reshape(n, bins, count, count * channels))


def _covariance_sums(
    task: Task, vertices: NDArray[np.int64], outgoing: Array, errors: Array
) -> tuple[Array, Array] | None:
    """Sums [n,P] and [n,3] of error products (`bakers.error_covariance`) over errors [n,m,K,…·3] of vertices [n] seen
    along outgoing [n,m,3]; None if the task needs no covariance.
    """
    if task.frames is None:
        return None
    n, many, count, width = errors.shape
    each = errors.reshape(n * many, count, width)
    in_view = task.frames.in_view(np.repeat(vertices, many), outgoing.reshape(-1, 3), each)
    return error_sums(in_view.reshape(n, many, count, width))


def _sample(
    task: Task, sampling: Sampling, outgoing: Array, first: int, last: int
) -> tuple[Array, Array, tuple[Array, Array] | None, int]:
    """Coefficients and their variance from values of Ŝ, the sums for their error covariance, and the number of
    evaluations beyond one set per bin.
    """
    rotation, vertices = sampling.rotation(first, last), np.arange(first, last)
    values = values_on_sets(task.transport, sampling.pool.incident, rotation, task.positions[vertices], outgoing)
    # Values that are not finite propagate; the caller reports their vertices.
    with np.errstate(invalid="ignore", over="ignore"):
        coefficients = project(values, sampling.pool, rotation)
        residual = residual_variance(values, coefficients, sampling.pool, rotation)
        if sampling.estimator == "halves" and sampling.second_rotation is not None:
            again = sampling.second_rotation(first, last)
            second = values_on_sets(task.transport, sampling.pool.incident, again, task.positions[vertices], outgoing)
            other = project(second, sampling.pool, again)
            errors = (coefficients - other) / 2.0
            residual = residual + residual_variance(second, other, sampling.pool, again)
            variance = half_buffer_variance(errors, residual, task.sectors)
            return (coefficients + other) / 2.0, variance, _covariance_sums(task, vertices, outgoing, errors), 0
        if sampling.estimator == "residual":
            residuals = residuals_of(values, coefficients, sampling.pool, rotation)
            errors = _fit_errors(residuals, sampling.pool, rotation)
            return coefficients, residual, _covariance_sums(task, vertices, outgoing, errors), 0
        errors = neighbour_errors(coefficients, task.sectors)
        variance, sums = (errors**2).mean(axis=(2, 3)), _covariance_sums(task, vertices, outgoing, errors)
        rows = unreliable_vertices(variance, residual, 0 if sampling.pool.harmonics is None else values.shape[2])
        if not len(rows) or sampling.validation_bins is None or sampling.second_rotation is None:
            return coefficients, variance, sums, 0
        at, again = sampling.validation_bins(first, last)[rows], sampling.second_rotation(first, last)[rows]
        errors = _validation_errors(task, sampling.pool, again, outgoing[rows], vertices[rows], coefficients[rows], at)
        variance[rows] = validated_variance((errors**2).mean(axis=(1, 2, 3)), variance[rows], residual[rows], at)
        there = np.take_along_axis(outgoing[rows], at[:, :, None], axis=1)
        validated = _covariance_sums(task, vertices[rows], there, errors)
        for total, part in zip(sums or (), validated or (), strict=True):
            total[rows] = part
        return coefficients, variance, sums, at.size * values.shape[2]


def _fit_errors(residuals: Array, pool: DirectionPool, rotation: NDArray[np.int64]) -> Array:
    """Numbers [n,B,K,D·3] that have the variance of fits with residuals [n,B,D,3] (`bakers.error_covariance`)."""
    weighted = pool.weights[rotation][..., None] * residuals[:, :, None]
    return np.asarray(weighted.reshape(*weighted.shape[:3], -1))


def _validation_errors(
    task: Task,
    pool: DirectionPool,
    again: NDArray[np.int64],
    outgoing: Array,
    vertices: NDArray[np.int64],
    coefficients: Array,
    at: NDArray[np.int64],
) -> Array:
    """Numbers [n,m,K,3] that have the variance of the coefficients [n,B,K,3] at the bins `at` [n,m], from an evaluation
    on the second sets `again` [n,B].
    """
    sets = np.take_along_axis(again, at, axis=1)
    towards = np.take_along_axis(outgoing, at[:, :, None], axis=1)
    values = values_on_sets(task.transport, pool.incident, sets, task.positions[vertices], towards)
    here = np.take_along_axis(coefficients, at[:, :, None, None], axis=1)
    return np.asarray((here - project(values, pool, sets)) / np.sqrt(2.0))
