"""Predicts the cost of a bake and what it would prune, from its pilot and from some of its blocks."""

import math
import time
from collections.abc import Collection
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from bakers.baker import bake_block, cuts
from bakers.path_traced import Walks
from bakers.plan import BakePlan
from bakers.transport import on_mesh, prepared, refuse_foreign, transport_kind, up_to
from bakers.workers import Threads, Workers
from formats.mesh import Mesh
from prt_bake.baking.adaptive.adaptive_job import AdaptiveJob, vertices_at_once
from prt_bake.baking.adaptive.predicted_cost import SIGMAS, Cost, adaptive_cost
from prt_bake.baking.job.arguments import as_light, as_point, refuse_unusable
from prt_bake.baking.job.effort import choose_effort
from prt_bake.baking.job.job import Job, resolve
from prt_bake.baking.job.pruning_record import Light, Pruning
from prt_bake.baking.job.sample_pilot import choose_samples
from prt_bake.baking.job.views import warn_of_clamped_views
from prt_bake.baking.lobes.in_bake import plan_lobes_of_bake
from prt_bake.baking.output.block_checkpoints import as_arrays as block_checkpoint
from prt_bake.baking.output.sink import asset_head
from prt_bake.baking.output.writing_time import checkpoint_time, writing_time
from prt_bake.baking.pruning.pruning import choose_pruning
from prt_bake.jit.limits import limited_threads
from prt_bake.mathematics import sh, sphere
from prt_bake.mathematics.random import hashed

MACHINE = 1.25
"""Factor by which the speed of a machine varies over time."""
ROUNDS, TIMED, MOST_TIMED = 3, 0.5, 0.06
"""Least number of rounds of one block for each worker, and least seconds, to time; at most this share of the blocks."""
_BLOCK_STREAM = 43


def plan(
    transport: Any,
    mesh: Mesh,
    degree: int = 2,
    rings: int = 16,
    sectors: int = 64,
    directions: str = "fibonacci",
    samples: int | None = None,
    seed: int = 0,
    *,
    error: float | None = None,
    precision: str = "float32",
    storage: str = "float16",
    workers: int = 1,
    device: str = "cpu",
    leave_out: Collection[str] = (),
    for_light: Light | ArrayLike | None = None,
    for_eye: ArrayLike | None = None,
    lobes: int = 0,
    minutes: float | None = None,
) -> BakePlan:
    """The cost of `bake` with these arguments, and what it would prune.

    Runs the pilot of the bake and bakes some blocks. Raises as `bake` does.
    """
    began = time.monotonic()
    refuse_unusable(
        mesh, degree=degree, rings=rings, sectors=sectors, samples=samples, error=error, minutes=minutes, seed=seed,
        workers=workers, leave_out=leave_out, lobes=lobes, directions=directions, precision=precision, storage=storage,
    )  # fmt: skip
    refuse_foreign(transport, mesh)
    warn_of_clamped_views(mesh, rings, sectors)
    whole = on_mesh(transport, mesh)
    transport = prepared(up_to(whole, degree), precision, device)
    light, eye = as_light(for_light, degree), None if for_eye is None else as_point(for_eye)
    effort = choose_effort(transport, degree, directions, samples, error, minutes)
    error, limit = effort.error, math.inf if minutes is None else 60.0 * minutes
    endless = minutes is not None and math.isinf(limit) and error is None
    pool = Threads(1 if transport_kind(transport) == "coefficients" else workers)
    with limited_threads(transport, workers):
        pruning = choose_pruning(
            transport, mesh, degree, rings, sectors, error=error, seed=seed, prunable=leave_out, light=light, eye=eye
        )
        head = asset_head(mesh, sphere.tangent_frame(mesh.normals), rings, sectors, degree, transport)
        planned = plan_lobes_of_bake(transport, whole, head, pruning, lobes, minutes, pool.count, precision, device)
        if effort.adaptive:
            grid = (rings, sectors) if pruning.views == "all" else None
            at_once = vertices_at_once(len(pruning.vertices), len(pruning.local), workers)
            adaptive = AdaptiveJob(
                transport, mesh, pruning.vertices, pruning.outgoing, pruning.local, pruning.degree, seed, grid, at_once
            )
            goal = None if error is None else pruning.left_for_projection(error)
            cost = adaptive_cost(adaptive, goal, limit - planned.seconds, pruning, pool, began)
        else:
            job = resolve(transport, mesh, pruning.degree, rings, sectors, directions, effort.samples, seed, pruning)
            if error is not None:
                job, _spent = choose_samples(job, pruning.left_for_projection(error), directions, seed)
            cost = _fixed_samples_cost(job, pruning, pool, began)
    vertices, bins = len(pruning.vertices), len(pruning.local)
    count = 1 if light is not None else sh.count(pruning.kept_degree)
    views, width = bins if pruning.views == "all" else 1, 2 if storage == "float16" else 4
    writing = cost.assets * writing_time(cost.coefficients, head, storage, pruning, vertices)
    after = writing + planned.seconds
    low, high = (seconds + after for seconds in cost.between)
    return BakePlan(
        vertices=vertices,
        bins=bins,
        coefficients=count,
        samples=cost.per_bin,
        evaluations=round(cost.evaluations),
        raw_bytes=vertices * views * count * pruning.channels * width,
        seconds=None if endless else min(cost.seconds + after, limit),
        seconds_between=None if endless else (min(low / MACHINE, limit), min(high * MACHINE, limit)),
        left_out=pruning.pruned,
        kept=pruning.kept,
        lobes={**planned.entry, "seconds": planned.seconds, "bytes": planned.bytes},
        effort=effort.sentence,
        error=cost.error,
    )


def _fixed_samples_cost(job: Job, pruning: Pruning, pool: Workers, began: float) -> Cost:
    """Cost of a bake with the same number of directions, or of walks, at every bin."""
    before, per_vertex = time.monotonic() - began, float(job.resolved.samples * job.task.bins)
    vertices, blocks = len(pruning.vertices), cuts(job.task, pruning.vertices)
    order = np.argsort(hashed(_BLOCK_STREAM, job.vertices[[0]], np.arange(len(blocks))))
    # A block of walks may be the whole object; a smaller one takes as long per vertex.
    most = max(1, int(MOST_TIMED * vertices / ROUNDS)) if isinstance(job.resolved.sampling, Walks) else vertices
    block, rates, timed, done = bake_block(job.task, blocks[0][0], blocks[0][0] + 1), list[float](), 0.0, 0
    while done < len(blocks) and (len(rates) < ROUNDS or (timed < TIMED and done < MOST_TIMED * len(blocks))):
        chosen = [blocks[number] for number in order[done : done + pool.count]]
        chosen = [(begin, min(end, begin + most)) for begin, end in chosen]
        started = time.monotonic()
        *_others, block = pool.in_order(lambda cut: pool.do(bake_block, (job.task,), *cut), chosen)
        seconds = time.monotonic() - started
        rates.append(seconds / sum(end - begin for begin, end in chosen))
        timed, done = timed + seconds, done + len(chosen)
    # The first round is slower because it allocates its memory.
    rates = rates[1:] or rates
    rate, deviation = float(np.mean(rates)), SIGMAS * float(np.std(rates)) / math.sqrt(len(rates))
    before += len(blocks) / pool.count * checkpoint_time(block_checkpoint(block), read=False)
    low, high = (before + each * vertices for each in (max(rate - deviation, 0.0), rate + deviation))
    return Cost(
        per_bin=job.resolved.samples,
        evaluations=per_vertex * vertices,
        seconds=before + rate * vertices,
        between=(low, high),
        coefficients=block.coefficients,
    )
