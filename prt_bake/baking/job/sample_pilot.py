"""A pilot bake of a few vertices, which predicts error and time of the bake for other numbers of samples."""

import math
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bakers.baker import bake_block
from bakers.path_traced import Walks
from bakers.transport import on_mesh, prepared, up_to
from formats.asset import Asset
from formats.errors import QueryError
from formats.mesh import Mesh
from prt_bake.baking.job.job import Job, resolve
from prt_bake.baking.job.running_error import ErrorMeter
from prt_bake.baking.job.sampling import MOST_SAMPLES
from prt_bake.jit.limits import limited_threads
from prt_bake.mathematics.random import hashed, uniforms

PILOT_VERTICES = 32
PILOT_LIMIT = 1 << 14
LADDER = (18, 32, 64, 128, 256)
EXACT = 1e-5
"""Below this relative error a bake is exact up to rounding: a network with low bands needs no more directions."""
RELIABLE_ERROR = 0.3
"""Largest relative error of walks from which the required number of walks is predicted."""
MARGIN = 1.1
"""Factor on the predicted number of walks, because a pilot samples few vertices."""
STEEPEST = {"uniform": 0.5, "sobol": 1.5}
"""Largest power of 1 / directions by which the error falls."""
UNREACHABLE = 1.2
"""An error is out of reach if the prediction exceeds it by this factor: a pilot's error is not exact."""
_PILOT_STREAM, _IMPORTANCE_STREAM = 14, 44
READ_AT_ONCE = 64
"""Vertices of an asset that are read together."""


def choose_samples(job: Job, error: float, directions: str, seed: int) -> tuple[Job, int]:
    """The job with enough samples for the requested error at a few random vertices, and the evaluations of this pilot.

    Directions are doubled until they suffice. The number of walks is predicted from one pilot, because their error
    falls with the square root of their number. Raises QueryError if the error is out of reach.
    """
    vertices = _pilot_vertices(job, seed)
    bins, spent = job.task.bins, 0
    walks = isinstance(job.resolved.sampling, Walks)
    limit, kind = (MOST_SAMPLES, "paths") if walks else (PILOT_LIMIT, "directions")
    predicted = False
    while True:
        meter, more = _bake_vertices(job, vertices)
        spent += len(vertices) * bins * job.resolved.samples + more
        if meter.total <= error:
            return job, spent
        samples = 2 * job.resolved.samples
        least = 0.0 if walks else meter.total * min(1.0, job.resolved.samples / limit) ** STEEPEST[directions]
        if walks and meter.total < RELIABLE_ERROR:
            samples, predicted = math.ceil(MARGIN * job.resolved.samples * (meter.total / error) ** 2), True
        if samples > limit or least > UNREACHABLE * error:
            raise QueryError(
                f"error: a relative RMSE of {error:g} is out of reach; {job.resolved.samples} {kind} a bin leave "
                f"{meter.total:.3g}, and at most {limit:,} are tried; request a larger error"
            )
        job = resolve(
            job.transport, job.mesh, job.degree, job.rings, job.sectors, directions, samples, seed, job.pruning
        )
        if predicted:
            return job, spent


def error_ladder(
    transport: Any,
    mesh: Mesh,
    degree: int = 2,
    rings: int = 16,
    sectors: int = 64,
    samples: tuple[int, ...] = LADDER,
    seed: int = 0,
    *,
    precision: str = "float32",
    workers: int = 1,
    device: str = "cpu",
    baked: Asset | None = None,
) -> NDArray[np.float64]:
    """Rows (seconds, evaluations, estimated relative RMSE) of baking the complete mesh with each number of directions.

    Ends with the first exact number, since more directions change nothing: a network with low bands has one row.
    Error and time are measured at a few vertices drawn by the seed; the time is scaled to all vertices and divided by
    the workers. With `baked`, an earlier bake of the same mesh, vertices are drawn by importance: in proportion to
    their share of its error and of its squared coefficients. Uniform draws would usually miss the error if a few
    vertices have most of it. Raises as `bake` does.
    """
    transport = prepared(up_to(on_mesh(transport, mesh), degree), precision, device)
    rows = []
    with limited_threads(transport, 1):
        for count in samples:
            job = resolve(transport, mesh, degree, rings, sectors, "fibonacci", count, seed)
            vertices, weights = (
                (_pilot_vertices(job, seed), None) if baked is None else _importance_sampled(baked, seed)
            )
            bake_block(job.task, 0, 1)
            began = time.monotonic()
            error = _bake_vertices(job, vertices, weights)[0].total
            share = len(mesh.positions) / len(vertices)
            seconds = (time.monotonic() - began) * share / max(1, workers)
            rows.append((seconds, float(len(mesh.positions) * rings * sectors * job.resolved.samples), error))
            if error < EXACT:
                break
    return np.array(rows, dtype=np.float64).reshape(-1, 3)


def _pilot_vertices(job: Job, seed: int) -> list[int]:
    order = np.argsort(hashed(_PILOT_STREAM, seed, job.vertices))
    return [int(vertex) for vertex in job.vertices[order[:PILOT_VERTICES]]]


def _importance_sampled(baked: Asset, seed: int) -> tuple[list[int], list[float]]:
    """A few vertices, and the weight of each: the number of vertices that it represents."""
    errors, squares = _error_and_signal(baked)
    shares = (errors / max(errors.sum(), 1e-300) + squares / max(squares.sum(), 1e-300)) / 2.0
    shares = shares / shares.sum() if shares.sum() > 0.0 else np.full(len(shares), 1.0 / len(shares))
    # Systematic resampling has less variance than independent draws.
    at = (np.arange(PILOT_VERTICES) + uniforms((_IMPORTANCE_STREAM, seed, 0), 1)) / PILOT_VERTICES
    drawn = np.minimum(np.searchsorted(np.cumsum(shares), at), len(shares) - 1)
    vertices, counts = np.unique(drawn, return_counts=True)
    return vertices.tolist(), (counts / (PILOT_VERTICES * shares[vertices])).tolist()


def _error_and_signal(baked: Asset) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Squared error and squared coefficients of each vertex [V], summed over B, K and C."""
    errors, squares = np.zeros((2, len(baked.mesh.positions)))
    for first in range(0, len(errors), READ_AT_ONCE):
        some = slice(first, first + READ_AT_ONCE)
        coefficients = np.asarray(baked.coefficients[some], np.float64)
        squares[some] = (coefficients**2).sum(axis=(1, 2, 3))
        variance = np.asarray(baked.standard_error[some], np.float64) ** 2
        errors[some] = variance.sum(axis=1) * coefficients.shape[2] * coefficients.shape[3]
    return errors, squares


def _bake_vertices(job: Job, vertices: list[int], weights: list[float] | None = None) -> tuple[ErrorMeter, int]:
    """The error at these vertices, and the evaluations beyond `samples` at every bin."""
    meter, more = ErrorMeter(), 0
    for vertex, weight in zip(vertices, weights or [1.0] * len(vertices), strict=True):
        block = bake_block(job.task, vertex, vertex + 1)
        meter.add(block, weight)
        more += block.extra_evaluations
    return meter, more
