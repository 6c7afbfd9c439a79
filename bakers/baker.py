"""The work of every bake in fixed samples: a block of vertices in, coefficients with standard errors out.

A block's numbers depend on its vertices alone, not on where the cuts lie or how many workers there are.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bakers.error_estimate import (
    Estimator,
    halves_variance,
    held_against,
    neighbour_variance,
    pairs_variance,
    suspect,
)
from bakers.path_traced import Account, Walks, vertices_walked_at_once, walk_block
from bakers.plan import vertices_at_once
from bakers.projection import DirectionPool, project, residual_variance
from bakers.transport import as_radiance, way_in

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
        coefficients, variance, account = walk_block(task.transport, task.sampling, positions, outgoing, first)
        bent += account.bent
    else:
        coefficients, variance, more = _sample(task, task.sampling, outgoing, first, last)
    with np.errstate(over="ignore"):
        rounded = coefficients.astype(np.float32)
    valid = np.asarray(np.isfinite(rounded).all(axis=(1, 2, 3)) & np.isfinite(variance).all(axis=1))
    rounded[~valid] = 0.0
    standard_error = np.sqrt(np.where(valid[:, None], variance, 0.0)).astype(np.float32)
    return Block(first, rounded, standard_error, valid, bent, account, more)


def _sample(task: Task, sampling: Sampling, outgoing: Array, first: int, last: int) -> tuple[Array, Array, int]:
    """Coefficients and their variance from values of Ŝ, and evaluations beyond those of every bin."""
    rotation, vertices = sampling.rotation(first, last), np.arange(first, last)
    values = _values(task, sampling.pool, rotation, outgoing, vertices)
    # Answers that are not finite are found, and named, by their vertex afterwards.
    with np.errstate(invalid="ignore", over="ignore"):
        coefficients = project(values, sampling.pool, rotation)
        if sampling.estimator == "halves" and sampling.second_rotation is not None:
            again = sampling.second_rotation(first, last)
            other = project(_values(task, sampling.pool, again, outgoing, vertices), sampling.pool, again)
            return (coefficients + other) / 2.0, halves_variance(coefficients, other, task.sectors), 0
        rough = residual_variance(values, coefficients, sampling.pool, rotation)
        if sampling.estimator == "residual":
            return coefficients, rough, 0
        variance = neighbour_variance(coefficients, task.sectors)
        view = suspect(variance, rough, 0 if sampling.pool.harmonics is None else values.shape[2])
        if not len(view) or sampling.held is None or sampling.second_rotation is None:
            return coefficients, variance, 0
        at, again = sampling.held(first, last)[view], sampling.second_rotation(first, last)[view]
        pairs = _pairs(task, sampling.pool, again, outgoing[view], vertices[view], coefficients[view], at)
        variance[view] = held_against(pairs, variance[view], rough[view], at)
        return coefficients, variance, at.size * values.shape[2]


def _pairs(
    task: Task,
    pool: DirectionPool,
    again: NDArray[np.int64],
    outgoing: Array,
    vertices: NDArray[np.int64],
    coefficients: Array,
    at: NDArray[np.int64],
) -> Array:
    """Variance [n] of the coefficients [n,B,K,3] of some bins `at` [n,m], evaluated on other sets `again` [n,B]."""
    sets = np.take_along_axis(again, at, axis=1)
    values = _values(task, pool, sets, np.take_along_axis(outgoing, at[:, :, None], axis=1), vertices)
    return pairs_variance(np.take_along_axis(coefficients, at[:, :, None, None], axis=1), project(values, pool, sets))


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
