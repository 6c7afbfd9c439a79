"""Predicts the cost of a bake and what it would prune, from its pilot and from some of its blocks."""

import math
import time
from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bakers.baker import bake_block, cuts
from bakers.path_traced import Walks
from bakers.plan import BakePlan, plan_bake
from bakers.transport import on_mesh, prepared, refuse_foreign, transport_kind, up_to
from bakers.workers import Threads, Workers
from formats.mesh import Mesh
from prt_bake.baking.adaptive.adaptive_job import AdaptiveJob, vertices_at_once
from prt_bake.baking.adaptive.checkpoints import as_arrays as pass_checkpoint
from prt_bake.baking.adaptive.noise_pilot import first_refinement, refuse_out_of_reach
from prt_bake.baking.adaptive.pass_settings import uncalibrated
from prt_bake.baking.adaptive.pilot_pass import run_pilot_pass
from prt_bake.baking.adaptive.run import COARSE, coarse_first
from prt_bake.baking.adaptive.tolerances import settings_for_error
from prt_bake.baking.adaptive.trials import Pilot, pilot_vertices
from prt_bake.baking.job.arguments import as_light, as_point, refuse_unusable
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
SIGMAS = 2.0
"""Half width of the stated range of the mean cost of a vertex, in standard errors."""
ERROR_FACTOR = 1.1
"""Uncertainty of the predicted error of a pass."""
ROUNDS, TIMED, MOST_TIMED = 3, 0.5, 0.06
"""Least number of rounds of one block for each worker, and least seconds, to time; at most this share of the blocks."""
_BLOCK_STREAM = 43


@dataclass(frozen=True)
class _Cost:
    """Cost of a bake from its start to its asset, without writing the asset."""

    per_bin: int
    """Directions, or walks."""
    evaluations: float
    seconds: float
    between: tuple[float, float]
    """Range of the seconds, from the variance between vertices."""
    coefficients: NDArray[np.float32]
    """Of some vertices [n,B,K,3]."""
    assets: int = 1
    """How many assets are written; each replaces the one before."""


def plan(
    transport: Any,
    mesh: Mesh,
    degree: int = 2,
    rings: int = 16,
    sectors: int = 64,
    directions: str = "fibonacci",
    samples: int = 64,
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
    """The cost of `bake` with these arguments, and what it would prune. minutes: decides on lobes alone.

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
    walks = transport_kind(transport) == "coefficients"
    pool = Threads(1 if walks else workers)
    with limited_threads(transport, workers):
        pruning = choose_pruning(
            transport, mesh, degree, rings, sectors, error=error, seed=seed, prunable=leave_out, light=light, eye=eye
        )
        if error is not None and directions == "fibonacci" and not walks:
            grid = (rings, sectors) if pruning.views == "all" else None
            at_once = vertices_at_once(len(pruning.vertices), len(pruning.local), workers)
            adaptive = AdaptiveJob(
                transport, mesh, pruning.vertices, pruning.outgoing, pruning.local, pruning.degree, seed, grid, at_once
            )
            cost = _adaptive_cost(adaptive, pruning.left_for_projection(error), pruning, pool, began)
        else:
            job = resolve(transport, mesh, pruning.degree, rings, sectors, directions, samples, seed, pruning)
            if error is not None:
                job, _spent = choose_samples(job, pruning.left_for_projection(error), directions, seed)
            cost = _fixed_samples_cost(job, pruning, pool, began)
        head = asset_head(mesh, sphere.tangent_frame(mesh.normals), rings, sectors, degree, transport)
        planned = plan_lobes_of_bake(transport, whole, head, pruning, lobes, minutes, pool.count, precision, device)
    vertices, count = len(pruning.vertices), 1 if light is not None else sh.count(pruning.kept_degree)
    views, width = len(pruning.local) if pruning.views == "all" else 1, 2 if storage == "float16" else 4
    sizes = plan_bake(vertices, len(pruning.local), count, cost.per_bin, width, pruning.channels, views)
    writing = cost.assets * writing_time(cost.coefficients, head, storage, pruning, vertices)
    after = writing + planned.seconds
    low, high = (seconds + after for seconds in cost.between)
    return replace(
        sizes,
        left_out=pruning.pruned,
        kept=pruning.kept,
        evaluations=round(cost.evaluations),
        seconds=cost.seconds + after,
        seconds_between=(low / MACHINE, high * MACHINE),
        lobes={**planned.entry, "seconds": planned.seconds, "bytes": planned.bytes},
    )


def _adaptive_cost(job: AdaptiveJob, error: float, pruning: Pruning, pool: Workers, began: float) -> _Cost:
    """Cost of a bake to an error; the bake's own pilot, which has run, is included."""
    refinement, evaluations = first_refinement(job, pool)
    evaluations += refuse_out_of_reach(job, refinement, error) + pruning.evaluations
    settings = settings_for_error(Pilot(job, pool), refinement, error)
    before, evaluations = time.monotonic() - began, evaluations + settings.pilot_cost.evaluations
    fine = run_pilot_pass(job, settings.refinement, pool)
    per_vertex = fine.of_pass(settings, job)
    # The bake reuses the evaluations of the pilot.
    vertices = len(job.vertices) - len(pilot_vertices(job))
    repeats = [1.0 + fine.repeats(settings, by * error, job) for by in (1.0, ERROR_FACTOR, 1.0 / ERROR_FACTOR)]
    passes = [
        _PassCost(per_vertex.seconds * vertices, per_vertex.evaluations * vertices, fine.deviation, tuple(repeats))
    ]
    if coarse_first(job, error):
        first, count = run_pilot_pass(job, uncalibrated(refinement, COARSE).refinement, pool), len(job.vertices)
        passes.append(_PassCost(first.seconds * count, first.evaluations * count, first.deviation))
    blocks = len(passes) * len(job.blocks) / pool.count
    before += blocks * checkpoint_time(pass_checkpoint(fine.block, 0), read=True)
    return _Cost(
        per_bin=math.ceil(per_vertex.evaluations / job.bins),
        evaluations=float(evaluations) + sum(each.evaluations * each.times[0] for each in passes),
        seconds=before + sum(each.seconds * each.times[0] for each in passes),
        between=(before + sum(each.least for each in passes), before + sum(each.most for each in passes)),
        coefficients=fine.block.coefficients,
        assets=len(passes) + (repeats[0] > 1.0),
    )


@dataclass(frozen=True)
class _PassCost:
    """Cost of a pass and its repetitions."""

    seconds: float
    evaluations: float
    deviation: float
    times: tuple[float, ...] = (1.0, 1.0, 1.0)
    """Expected, least and most number of times that the pass is done; partial passes are fractions."""

    @property
    def least(self) -> float:
        """Least seconds."""
        return max(1.0 - SIGMAS * self.deviation, 0.0) * self.times[1] * self.seconds

    @property
    def most(self) -> float:
        """Most seconds."""
        return (1.0 + SIGMAS * self.deviation) * self.times[2] * self.seconds


def _fixed_samples_cost(job: Job, pruning: Pruning, pool: Workers, began: float) -> _Cost:
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
    return _Cost(
        per_bin=job.resolved.samples,
        evaluations=per_vertex * vertices,
        seconds=before + rate * vertices,
        between=(low, high),
        coefficients=block.coefficients,
    )
