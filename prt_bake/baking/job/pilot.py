"""What a few vertices tell of a whole bake: its error and its time for more and for fewer directions."""

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
SEEN = 0.3
"""A relative error of walks below which their number is foretold from it."""
MARGIN = 1.1
"""More walks than foretold, for what a few vertices do not show."""
STEEPEST = {"uniform": 0.5, "sobol": 1.5}
"""Power of the number of directions that an error falls with at most."""
WITHIN = 1.2
"""Times the error asked for, that a foretold one must exceed to be out of reach: a pilot's is not exact."""
_PILOT_STREAM, _LIKE_STREAM = 14, 44
READ_AT_ONCE = 64
"""Vertices of an asset."""


def reach(job: Job, error: float, directions: str, seed: int) -> tuple[Job, int]:
    """Takes more samples until a few vertices, drawn by the seed, show the error asked for; and what that took.

    Directions are doubled. The error of walks falls as the root of their number, so that one pilot tells how many.
    """
    vertices = _pilot_vertices(job, seed)
    bins, spent = job.task.bins, 0
    walks = isinstance(job.resolved.sampling, Walks)
    limit, kind = (MOST_SAMPLES, "walks") if walks else (PILOT_LIMIT, "directions")
    foretold = False
    while True:
        meter, more = _baked(job, vertices)
        spent += len(vertices) * bins * job.resolved.samples + more
        if meter.total <= error:
            return job, spent
        samples = 2 * job.resolved.samples
        least = 0.0 if walks else meter.total * min(1.0, job.resolved.samples / limit) ** STEEPEST[directions]
        if walks and meter.total < SEEN:
            samples, foretold = math.ceil(MARGIN * job.resolved.samples * (meter.total / error) ** 2), True
        if samples > limit or least > WITHIN * error:
            raise QueryError(
                f"error: a relative RMSE of {error:g} is out of reach; {job.resolved.samples} {kind} a bin leave "
                f"{meter.total:.3g}, and more than {limit:,} are not tried; ask for a larger one"
            )
        job = resolve(job.transport, job.mesh, job.degree, job.rings, job.sectors, directions, samples, seed, job.needs)
        if foretold:
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
    """Rows (seconds, evaluations, estimated relative RMSE) of baking the whole mesh with each number of directions.

    Error and time come from a few vertices drawn by the seed; the time is carried to all vertices and shared among the
    workers. Where a few vertices have most of the error, as many drawn evenly hardly ever show it: those are drawn
    the more often then, the larger a share of the error or of the squares of the coefficients `baked` has at them, a
    bake of the same mesh in any way. Raises as `bake` does.
    """
    transport = prepared(up_to(on_mesh(transport, mesh), degree), precision, device)
    rows = []
    with limited_threads(transport, 1):
        for count in samples:
            job = resolve(transport, mesh, degree, rings, sectors, "fibonacci", count, seed)
            vertices, times = (_pilot_vertices(job, seed), None) if baked is None else _drawn_like(baked, seed)
            bake_block(job.task, 0, 1)
            began = time.monotonic()
            error = _baked(job, vertices, times)[0].total
            share = len(mesh.positions) / len(vertices)
            seconds = (time.monotonic() - began) * share / max(1, workers)
            rows.append((seconds, float(len(mesh.positions) * rings * sectors * job.resolved.samples), error))
    return np.array(rows, dtype=np.float64).reshape(-1, 3)


def _pilot_vertices(job: Job, seed: int) -> list[int]:
    order = np.argsort(hashed(_PILOT_STREAM, seed, job.vertices))
    return [int(vertex) for vertex in job.vertices[order[:PILOT_VERTICES]]]


def _drawn_like(baked: Asset, seed: int) -> tuple[list[int], list[float]]:
    """A few vertices, and how many of all each stands for."""
    errors, squares = _by_vertex(baked)
    shares = (errors / max(errors.sum(), 1e-300) + squares / max(squares.sum(), 1e-300)) / 2.0
    shares = shares / shares.sum() if shares.sum() > 0.0 else np.full(len(shares), 1.0 / len(shares))
    # Evenly through all shares: what is drawn varies less than by chance alone.
    at = (np.arange(PILOT_VERTICES) + uniforms((_LIKE_STREAM, seed, 0), 1)) / PILOT_VERTICES
    places = np.minimum(np.searchsorted(np.cumsum(shares), at), len(shares) - 1)
    vertices, often = np.unique(places, return_counts=True)
    return vertices.tolist(), (often / (PILOT_VERTICES * shares[vertices])).tolist()


def _by_vertex(baked: Asset) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Squared error and squares of the coefficients, sums over B, K and C, of each vertex [V]."""
    errors, squares = np.zeros((2, len(baked.mesh.positions)))
    for first in range(0, len(errors), READ_AT_ONCE):
        some = slice(first, first + READ_AT_ONCE)
        coefficients = np.asarray(baked.coefficients[some], np.float64)
        squares[some] = (coefficients**2).sum(axis=(1, 2, 3))
        variance = np.asarray(baked.standard_error[some], np.float64) ** 2
        errors[some] = variance.sum(axis=1) * coefficients.shape[2] * coefficients.shape[3]
    return errors, squares


def _baked(job: Job, vertices: list[int], times: list[float] | None = None) -> tuple[ErrorMeter, int]:
    """The error at these vertices, each counted so many times, and evaluations beyond `samples` at every bin."""
    meter, more = ErrorMeter(), 0
    for vertex, often in zip(vertices, times or [1.0] * len(vertices), strict=True):
        block = bake_block(job.task, vertex, vertex + 1)
        meter.add(block, often)
        more += block.more
    return meter, more
