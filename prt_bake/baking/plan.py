"""What a bake would cost, and what it would leave out: from its pilot, and from some of its blocks."""

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
from bakers.transport import on_mesh, prepared, refuse_foreign, up_to, way_in
from bakers.workers import Crew, Threads
from formats.mesh import Mesh
from prt_bake.baking.adaptive.pilot import Site, first_refinement, refuse_out_of_reach, vertices_at_once
from prt_bake.baking.adaptive.pilot_pass import rehearsed
from prt_bake.baking.adaptive.run import COARSE, coarse_first
from prt_bake.baking.adaptive.run import as_arrays as kept_refined
from prt_bake.baking.adaptive.tolerances import Pilot, aimed, coarse, pilot_vertices
from prt_bake.baking.job.arguments import refuse_unusable
from prt_bake.baking.job.job import Job, resolve
from prt_bake.baking.job.pilot import reach
from prt_bake.baking.job.pruning_record import Light, Needs
from prt_bake.baking.output.checkpoint_store import as_arrays as kept_block
from prt_bake.baking.output.sink import asset_head
from prt_bake.baking.output.writing_time import keeping_time, writing_time
from prt_bake.baking.pruning.pruning import as_light, as_point, needs_of
from prt_bake.jit.limits import limited_threads
from prt_bake.mathematics import sh, sphere
from prt_bake.mathematics.random import hashed

MACHINE = 1.25
"""How many times as long the same work takes at some times as at others."""
SURE = 2.0
"""Sigmas within which what vertices take on average is told to lie."""
NOISY = 1.1
"""How far the error is off that the vertices tried say a pass leaves, as a factor."""
ROUNDS, TIMED, MOST_TIMED = 3, 0.5, 0.06
"""How often a block for each worker is timed at least, and for how many seconds, unless that is so large a share of
all.
"""
_BLOCK_STREAM = 43


@dataclass(frozen=True)
class _Cost:
    """Of a bake, from its beginning to its asset, but for what writing that takes."""

    a_bin: int
    """Directions, or walks."""
    evaluations: float
    seconds: float
    between: tuple[float, float]
    """Seconds, by what the vertices that were tried differ by."""
    coefficients: NDArray[np.float32]
    """Of some vertices [n,B,K,3]."""
    assets: int = 1
    """How many are written, the last one in place of those before."""


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
) -> BakePlan:
    """What `bake` with these arguments would cost, and what it would leave out. What comes before the first block is
    done as the bake does it, the pilot too, and some blocks are baked. Raises as `bake` does.
    """
    began = time.monotonic()
    refuse_unusable(
        mesh, degree=degree, rings=rings, sectors=sectors, samples=samples, error=error, minutes=None, seed=seed,
        workers=workers, leave_out=leave_out, directions=directions, precision=precision, storage=storage,
    )  # fmt: skip
    refuse_foreign(transport, mesh)
    transport = prepared(up_to(on_mesh(transport, mesh), degree), precision, device)
    light, eye = as_light(for_light, degree), None if for_eye is None else as_point(for_eye)
    walks = way_in(transport) == "coefficients"
    crew = Threads(1 if walks else workers)
    with limited_threads(transport, workers):
        needs = needs_of(transport, mesh, degree, rings, sectors, error, seed, leave_out, light, eye)
        if error is not None and directions == "fibonacci" and not walks:
            grid = (rings, sectors) if needs.views == "all" else None
            at_once = vertices_at_once(len(needs.vertices), len(needs.local), workers)
            site = Site(transport, mesh, needs.vertices, needs.outgoing, needs.local, needs.degree, seed, grid, at_once)
            cost = _to_error(site, needs.left_for_projection(error), needs, crew, began)
        else:
            job = resolve(transport, mesh, needs.degree, rings, sectors, directions, samples, seed, needs)
            if error is not None:
                job, _spent = reach(job, needs.left_for_projection(error), directions, seed)
            cost = _by_samples(job, needs, crew, began)
    vertices, count = len(needs.vertices), 1 if light is not None else sh.count(needs.kept_degree)
    views, width = len(needs.local) if needs.views == "all" else 1, 2 if storage == "float16" else 4
    sizes = plan_bake(vertices, len(needs.local), count, cost.a_bin, width, needs.channels, views)
    head = asset_head(mesh, sphere.tangent_frame(mesh.normals), rings, sectors, degree, transport)
    written = cost.assets * writing_time(cost.coefficients, head, storage, needs, vertices)
    low, high = (within + written for within in cost.between)
    return replace(
        sizes,
        left_out=needs.left_out,
        kept=needs.kept,
        evaluations=round(cost.evaluations),
        seconds=cost.seconds + written,
        seconds_between=(low / MACHINE, high * MACHINE),
    )


def _to_error(site: Site, error: float, needs: Needs, crew: Crew, began: float) -> _Cost:
    """Of a bake to an error, what was needed for the plan among it."""
    refinement, looked = first_refinement(site, crew)
    looked += refuse_out_of_reach(site, refinement, error) + needs.evaluations
    aim = aimed(Pilot(site, crew), refinement, error)
    before, evaluations = time.monotonic() - began, float(looked + aim.spent.evaluations)
    fine = rehearsed(site, aim.refinement, crew)
    whole = fine.of_passes(aim, site)
    # What the pilot has evaluated is not evaluated again.
    vertices = len(site.vertices) - len(pilot_vertices(site))
    again = [1.0 + fine.again(aim, by * error, site) for by in (1.0, NOISY, 1.0 / NOISY)]
    passes = [_Share(whole.seconds * vertices, whole.evaluations * vertices, fine.deviation, tuple(again))]
    if coarse_first(site, error):
        first, all_of = rehearsed(site, coarse(refinement, COARSE).refinement, crew), len(site.vertices)
        passes.append(_Share(first.seconds * all_of, first.evaluations * all_of, first.deviation))
    blocks = len(passes) * len(site.blocks) / crew.workers
    before += blocks * keeping_time(kept_refined(fine.block, 0), read=True)
    return _Cost(
        math.ceil(whole.evaluations / site.bins),
        evaluations + sum(share.evaluations * share.times[0] for share in passes),
        before + sum(share.seconds * share.times[0] for share in passes),
        (before + sum(share.least for share in passes), before + sum(share.most for share in passes)),
        fine.block.coefficients,
        len(passes) + (again[0] > 1.0),
    )


@dataclass(frozen=True)
class _Share:
    """A pass, and what follows it of the same kind."""

    seconds: float
    evaluations: float
    deviation: float
    times: tuple[float, ...] = (1.0, 1.0, 1.0)
    """How often it is done, fractions too: as is to be expected, at least and at most."""

    @property
    def least(self) -> float:
        """Seconds."""
        return max(1.0 - SURE * self.deviation, 0.0) * self.times[1] * self.seconds

    @property
    def most(self) -> float:
        """Seconds."""
        return (1.0 + SURE * self.deviation) * self.times[2] * self.seconds


def _by_samples(job: Job, needs: Needs, crew: Crew, began: float) -> _Cost:
    """Of a bake with the same number of directions, or of walks, at every bin."""
    before, per_vertex = time.monotonic() - began, float(job.resolved.samples * job.task.bins)
    vertices, blocks = len(needs.vertices), cuts(job.task, needs.vertices)
    order = np.argsort(hashed(_BLOCK_STREAM, job.vertices[[0]], np.arange(len(blocks))))
    # A block of walks may be the whole object, and takes as long a vertex if it is small.
    most = max(1, int(MOST_TIMED * vertices / ROUNDS)) if isinstance(job.resolved.sampling, Walks) else vertices
    block, rates, spent, done = bake_block(job.task, blocks[0][0], blocks[0][0] + 1), list[float](), 0.0, 0
    while done < len(blocks) and (len(rates) < ROUNDS or (spent < TIMED and done < MOST_TIMED * len(blocks))):
        some = [blocks[place] for place in order[done : done + crew.workers]]
        some = [(begin, min(end, begin + most)) for begin, end in some]
        started = time.monotonic()
        *_others, block = crew.in_order(lambda cut: crew.do(bake_block, (job.task,), *cut), some)
        took = time.monotonic() - started
        rates.append(took / sum(end - begin for begin, end in some))
        spent, done = spent + took, done + len(some)
    # The first round is slower: it touches all of its memory for the first time.
    rates = rates[1:] or rates
    each, off = float(np.mean(rates)), SURE * float(np.std(rates)) / math.sqrt(len(rates))
    before += len(blocks) / crew.workers * keeping_time(kept_block(block), read=False)
    low, high = (before + rate * vertices for rate in (max(each - off, 0.0), each + off))
    return _Cost(
        job.resolved.samples,
        per_vertex * vertices,
        before + each * vertices,
        (low, high),
        block.coefficients,
    )
