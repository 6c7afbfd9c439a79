"""Bakes with the same number of directions, or of random walks, at every view bin.

Finished blocks are kept beside the asset until it is complete (`prt_bake.baking.output.block_checkpoints`).
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from bakers.baker import Block, bake_block
from bakers.path_traced import Walks, WalkStatistics
from formats.asset import Asset
from prt_bake.baking.job.forecast import BakeStatus, ErrorFigures, Forecast
from prt_bake.baking.job.job import Job, resolve
from prt_bake.baking.job.provenance import not_finite, nothing_done, outcome
from prt_bake.baking.job.running_error import ErrorMeter
from prt_bake.baking.job.sample_pilot import choose_samples
from prt_bake.baking.job.work import Work
from prt_bake.baking.output.block_checkpoints import BlockCheckpoints, Cut
from prt_bake.baking.output.checkpoint_store import CheckpointStore
from prt_bake.baking.output.pruned_sink import open_pruned_sink
from prt_bake.baking.output.sink import Sink

ROWS = 100
PILOT = "pilot"


def bake_by_samples(work: Work, store: CheckpointStore, directions: str, samples: int, error: float | None) -> Asset:
    """Bakes block by block; for a requested `error` a pilot chooses the number of samples.

    Raises QueryError if no vertex was done or is finite or if the error is out of reach, WronglyPruned if a vertex
    needs what was pruned.
    """
    spent = 0
    if error is not None and (known := store.read(PILOT)) is not None:
        samples, spent = int(known["samples"]), int(known["evaluations"])
    rings, sectors = work.head.rings, work.head.sectors
    job = resolve(
        work.transport, work.mesh, work.pruning.degree, rings, sectors, directions, samples, work.seed, work.pruning
    )
    if error is not None and not spent:
        job, spent = choose_samples(job, work.pruning.left_for_projection(error), directions, work.seed)
        store.write(PILOT, {"samples": np.asarray(job.resolved.samples), "evaluations": np.asarray(spent)})
    work.evaluations += spent
    with open_pruned_sink(work.out, work.head, work.storage, work.pruning) as sink:
        asset = _run(work, job, sink, BlockCheckpoints(None if work.out is None else store))
    work.finished = asset.complete
    return asset


def _run(work: Work, job: Job, sink: Sink, checkpoints: BlockCheckpoints) -> Asset:
    """Bakes into the sink and finishes the asset, complete or partial."""
    vertices, per_vertex = len(work.pruning.vertices), job.task.bins * job.resolved.samples
    meter, rows, invalid, statistics = ErrorMeter(), list[tuple[float, float, float]](), list[int](), WalkStatistics()
    done = clamped = 0

    def bake_cut(cut: Cut) -> Block:
        block = checkpoints.read(cut)
        if block is None:
            block = work.workers.do(bake_block, (job.task,), *cut)
            checkpoints.write(block)
        return block

    cuts = checkpoints.cuts(job.task, work.pruning.vertices)
    forecast = Forecast(_missing(work.pruning.vertices, checkpoints.finished))
    blocks = work.workers.in_order(bake_cut, cuts)
    try:
        for block in _until_stopped(work, blocks):
            work.evaluations += len(block.valid) * per_vertex + block.extra_evaluations
            sink.write(block)
            done, clamped = done + len(block.valid), clamped + block.clamped
            invalid += (block.first_vertex + np.flatnonzero(~block.valid)).tolist()
            statistics += block.statistics or WalkStatistics()
            meter.add(block)
            row = (work.seconds, float(work.evaluations), meter.total)
            if not rows or done * ROWS // vertices > len(rows) or done == vertices:
                rows.append(row)
                figures = ErrorFigures(meter.total, meter.percentile_95)
            if work.progress is not None:
                work.progress(done, vertices, BakeStatus(row, forecast.left(done), figures=figures))
    except KeyboardInterrupt:
        pass
    finally:
        blocks.close()
    if done == 0:
        raise nothing_done()
    if len(invalid) == done:
        raise not_finite(work.transport, f"{done} vertices that were baked")
    settings = work.report["settings"] | {"directions": job.resolved.directions, "samples": job.resolved.samples}
    report = work.report | {
        "settings": settings,
        "error_estimate": job.resolved.error_estimate,
        "condition_number": job.resolved.condition,
        **outcome(work, meter.total, meter.percentile_95, clamped, invalid, done),
    }
    if isinstance(job.resolved.sampling, Walks):
        report["walks"] = statistics.as_json()
        if meter.total == 0.0:  # no path carried light, which does not mean that there is none
            report["estimated_relative_rmse"] = dict.fromkeys(report["estimated_relative_rmse"])
    return sink.finish(report, np.array(rows, dtype=np.float64).reshape(-1, 3), done == vertices)


def _missing(vertices: NDArray[np.int64], finished: list[Cut]) -> NDArray[np.float64]:
    """1 at the vertices that remain to be baked, 0 at finished ones."""
    missing = np.ones(len(vertices))
    for first, last in finished:
        missing[(vertices >= first) & (vertices < last)] = 0.0
    return missing


def _until_stopped(work: Work, blocks: Iterator[Block]) -> Iterator[Block]:
    while not work.stopped:
        block = next(blocks, None)
        if block is None:
            return
        yield block
