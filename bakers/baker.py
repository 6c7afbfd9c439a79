"""The work of every bake in fixed samples: a block of vertices in, coefficients with standard errors out.

A block's numbers depend on its vertices alone, not on where the cuts lie or how many workers there are.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bakers.error_covariance import Frames, of_errors, shape_of
from bakers.error_estimate import Estimator, halves_variance, held_against, neighbour_errors, suspect
from bakers.path_traced import Account, Walks, vertices_walked_at_once, walk_block
from bakers.plan import vertices_at_once
from bakers.projection import DirectionPool, left_over, project, residual_variance
from bakers.transport import as_radiance, way_in
from formats.asset.error_covariance import ErrorShape

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
    """[n], false where the transport answered something that is not finite."""
    bent: int
    """Bins whose direction lay below the horizon."""
    account: Account | None = None
    """What random walks say beside the coefficients."""
    more: int = 0
    """Evaluations beyond `samples` at every bin."""
    together: NDArray[np.float32] | None = None
    """[n], share of the squared error that all bins of a vertex have in common; None: all of it."""
    shape: ErrorShape | None = None
    """How the errors of each vertex hang together, where that is known."""
    bound: float = 1.0
    """How many times the root mean square error `standard_error` is, such that 1.96 of it are a 95 % bound."""


@dataclass(frozen=True)
class Sampling:
    """How the light is sampled at every bin."""

    pool: DirectionPool
    rotation: Callable[[int, int], NDArray[np.int64]]
    """(first vertex, last vertex) → which set of the pool each bin takes, [n,B]."""
    second_rotation: Callable[[int, int], NDArray[np.int64]] | None
    """Another set for each bin, where the error comes from two sets, of all bins or of some."""
    estimator: Estimator
    held: Callable[[int, int], NDArray[np.int64]] | None = None
    """(first vertex, last vertex) → bins [n,m] that are evaluated on that other set where neighbours do not tell."""


@dataclass(frozen=True)
class Task:
    """A transport and where to bake it."""

    transport: Any
    positions: Array
    """[V,3] in object space."""
    outgoing: Callable[[int, int], tuple[Array, int]]
    """(first vertex, last vertex) → directions to the eye [n,B,3] and how many of them were bent to the horizon."""
    bins: int
    sectors: int
    sampling: Sampling | Walks
    frames: Frames | None = None
    """In which it is told how errors hang together; None: not at all."""


def cuts(task: Task, vertices: NDArray[np.int64]) -> list[tuple[int, int]]:
    """First and last + 1 of the blocks that these vertices, in ascending order, are baked in."""
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
    outgoing, bent = task.outgoing(first, last)
    account, more = None, 0
    if isinstance(task.sampling, Walks):
        positions = task.positions[first:last]
        coefficients, squares, account = walk_block(task.transport, task.sampling, positions, outgoing, first)
        variance, errors = squares.mean(axis=(2, 3)), _of_walks(squares)
        sums = _sums(task, np.arange(first, last), outgoing, errors)
        bent += account.bent
    else:
        coefficients, variance, sums, more = _sample(task, task.sampling, outgoing, first, last)
    with np.errstate(over="ignore"):
        rounded = coefficients.astype(np.float32)
    valid = np.asarray(np.isfinite(rounded).all(axis=(1, 2, 3)) & np.isfinite(variance).all(axis=1))
    rounded[~valid] = 0.0
    standard_error = np.sqrt(np.where(valid[:, None], variance, 0.0)).astype(np.float32)
    shape = None if sums is None else shape_of(*sums, np.ones(len(valid)), coefficients.shape[2])
    return Block(first, rounded, standard_error, valid, bent, account, more, shape=shape)


def _of_walks(squares: Array) -> Array:
    """Numbers [n,B,K,K·3] that vary by harmonic as variances [n,B,K,3] have it: walks tell each harmonic's apart."""
    n, bins, count, channels = squares.shape
    each = np.sqrt(squares)[:, :, :, None] * np.eye(count)[:, :, None]
    return np.asarray(each.reshape(n, bins, count, count * channels))


def _sums(task: Task, vertices: NDArray[np.int64], outgoing: Array, errors: Array) -> tuple[Array, Array] | None:
    """Sums [n,P], [n,3] that tell how such errors [n,m,K,…·3] of vertices [n] seen along outgoing [n,m,3] hang
    together, where that is wanted.
    """
    if task.frames is None:
        return None
    n, many, count, width = errors.shape
    each = errors.reshape(n * many, count, width)
    in_view = task.frames.in_view(np.repeat(vertices, many), outgoing.reshape(-1, 3), each)
    return of_errors(in_view.reshape(n, many, count, width))


def _sample(
    task: Task, sampling: Sampling, outgoing: Array, first: int, last: int
) -> tuple[Array, Array, tuple[Array, Array] | None, int]:
    """Coefficients and their variance from values of Ŝ, sums that tell the shape of their errors, and evaluations
    beyond those of every bin.
    """
    rotation, vertices = sampling.rotation(first, last), np.arange(first, last)
    values = _values(task, sampling.pool, rotation, outgoing, vertices)
    # Answers that are not finite are found, and named, by their vertex afterwards.
    with np.errstate(invalid="ignore", over="ignore"):
        coefficients = project(values, sampling.pool, rotation)
        rough = residual_variance(values, coefficients, sampling.pool, rotation)
        if sampling.estimator == "halves" and sampling.second_rotation is not None:
            again = sampling.second_rotation(first, last)
            more = _values(task, sampling.pool, again, outgoing, vertices)
            other = project(more, sampling.pool, again)
            errors = (coefficients - other) / 2.0
            rough = rough + residual_variance(more, other, sampling.pool, again)
            variance = halves_variance(errors, rough, task.sectors)
            return (coefficients + other) / 2.0, variance, _sums(task, vertices, outgoing, errors), 0
        if sampling.estimator == "residual":
            residuals = left_over(values, coefficients, sampling.pool, rotation)
            return coefficients, rough, _sums(task, vertices, outgoing, _of_fits(residuals, sampling.pool, rotation)), 0
        errors = neighbour_errors(coefficients, task.sectors)
        variance, sums = (errors**2).mean(axis=(2, 3)), _sums(task, vertices, outgoing, errors)
        view = suspect(variance, rough, 0 if sampling.pool.harmonics is None else values.shape[2])
        if not len(view) or sampling.held is None or sampling.second_rotation is None:
            return coefficients, variance, sums, 0
        at, again = sampling.held(first, last)[view], sampling.second_rotation(first, last)[view]
        pairs = _pairs(task, sampling.pool, again, outgoing[view], vertices[view], coefficients[view], at)
        variance[view] = held_against((pairs**2).mean(axis=(1, 2, 3)), variance[view], rough[view], at)
        there = np.take_along_axis(outgoing[view], at[:, :, None], axis=1)
        for whole, of_pairs in zip(sums or (), _sums(task, vertices[view], there, pairs) or (), strict=True):
            whole[view] = of_pairs
        return coefficients, variance, sums, at.size * values.shape[2]


def _of_fits(residuals: Array, pool: DirectionPool, rotation: NDArray[np.int64]) -> Array:
    """Numbers [n,B,K,D·3] that vary as the errors of fits with residuals [n,B,D,3] (`bakers.error_covariance`)."""
    weighted = pool.weights[rotation][..., None] * residuals[:, :, None]
    return np.asarray(weighted.reshape(*weighted.shape[:3], -1))


def _pairs(
    task: Task,
    pool: DirectionPool,
    again: NDArray[np.int64],
    outgoing: Array,
    vertices: NDArray[np.int64],
    coefficients: Array,
    at: NDArray[np.int64],
) -> Array:
    """Numbers [n,m,K,3] that vary as the errors do of the coefficients [n,B,K,3] of some bins `at` [n,m], evaluated on
    other sets `again` [n,B].
    """
    sets = np.take_along_axis(again, at, axis=1)
    values = _values(task, pool, sets, np.take_along_axis(outgoing, at[:, :, None], axis=1), vertices)
    here = np.take_along_axis(coefficients, at[:, :, None, None], axis=1)
    return np.asarray((here - project(values, pool, sets)) / np.sqrt(2.0))


def _values(
    task: Task, pool: DirectionPool, rotation: NDArray[np.int64], outgoing: Array, vertices: NDArray[np.int64]
) -> NDArray[Any]:
    """Ŝ [n,B,D,3] of vertices [n] seen along outgoing [n,B,3], on the direction sets that `rotation` [n,B] names."""
    positions = task.positions[vertices]
    directions = pool.incident.shape[1]
    expected = (*rotation.shape, directions, 3)
    if way_in(task.transport) == "block":
        answer = task.transport.evaluate_block(pool.incident, rotation, positions, outgoing)
        return as_radiance(answer, expected, "evaluate_block")
    incident = pool.incident[rotation].reshape(-1, directions, 3)
    answer = task.transport.evaluate(incident, np.repeat(positions, rotation.shape[1], axis=0), outgoing.reshape(-1, 3))
    return as_radiance(answer, (len(incident), directions, 3), "evaluate").reshape(expected)
