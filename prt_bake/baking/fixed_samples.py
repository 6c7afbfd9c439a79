"""Bakes with the same number of directions, or of random walks, at every view bin.

Finished blocks are kept beside the asset while it is written (`prt_bake.baking.output.checkpoint_store`), and when it
is only a part.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from bakers.baker import Block, bake_block
from bakers.path_traced import Account, Walks
from formats.asset import Asset
from formats.errors import QueryError
from prt_bake.baking.job.forecast import Forecast, Standing
from prt_bake.baking.job.job import Job, resolve
from prt_bake.baking.job.pilot import reach
from prt_bake.baking.job.running_error import ErrorMeter
from prt_bake.baking.job.work import Work
from prt_bake.baking.output.checkpoint import Store
from prt_bake.baking.output.checkpoint_store import Cut, Shelf
from prt_bake.baking.output.pruned_sink import pared_sink
from prt_bake.baking.output.sink import Sink

ROWS = 100
PILOT = "pilot"


def bake_by_samples(work: Work, store: Store, directions: str, samples: int, error: float | None) -> Asset:
    """Bakes block by block; to an `error`, a pilot finds out how many samples it takes.

    Raises QueryError where nothing was done or nothing is finite, or the error is out of reach, NotSo where a vertex
    needs what was to be left out.
    """
    spent = 0
    if error is not None and (known := store.read(PILOT)) is not None:
        samples, spent = int(known["samples"]), int(known["evaluations"])
    rings, sectors = work.head.rings, work.head.sectors
    job = resolve(
        work.transport, work.mesh, work.needs.degree, rings, sectors, directions, samples, work.seed, work.needs
    )
    if error is not None and not spent:
        job, spent = reach(job, work.needs.left_for_projection(error), directions, work.seed)
        store.write(PILOT, {"samples": np.asarray(job.resolved.samples), "evaluations": np.asarray(spent)})
    work.evaluations += spent
    with pared_sink(work.out, work.head, work.storage, work.needs) as sink:
        asset = _run(work, job, sink, Shelf(None if work.out is None else store))
    if asset.complete:
        store.remove()
    return asset


def _run(work: Work, job: Job, sink: Sink, shelf: Shelf) -> Asset:
    """Bakes into the sink, keeps the error figures, and closes the asset, whole or in part."""
    vertices, per_vertex = len(work.needs.vertices), job.task.bins * job.resolved.samples
    meter, rows, invalid, account = ErrorMeter(), list[tuple[float, float, float]](), list[int](), Account()
    done = bent = 0

    def one(cut: Cut) -> Block:
        block = shelf.kept(cut)
        if block is None:
            block = work.crew.do(bake_block, (job.task,), *cut)
            shelf.keep(block)
        return block

    cuts = shelf.cuts(job.task, work.needs.vertices)
    forecast = Forecast(_missing(work.needs.vertices, shelf.there))
    blocks = work.crew.in_order(one, cuts)
    try:
        for block in _until(work, blocks):
            work.evaluations += len(block.valid) * per_vertex + block.more
            sink.write(block)
            done, bent = done + len(block.valid), bent + block.bent
            invalid += (block.first_vertex + np.flatnonzero(~block.valid)).tolist()
            account += block.account or Account()
            meter.add(block)
            row = (work.seconds, float(work.evaluations), meter.total)
            if not rows or done * ROWS // vertices > len(rows) or done == vertices:
                rows.append(row)
            if work.progress is not None:
                work.progress(done, vertices, Standing(row, forecast.left(done)))
    except KeyboardInterrupt:
        pass
    finally:
        blocks.close()
    if done == 0:
        raise QueryError("the bake was stopped before its first vertex was done; nothing was written")
    if len(invalid) == done:
        raise QueryError(f"the transport answered values that are not finite at every one of {done} vertices")
    settings = work.report["settings"] | {"directions": job.resolved.directions, "samples": job.resolved.samples}
    report = work.report | {
        "settings": settings,
        "error_estimate": job.resolved.error_estimate,
        "condition_number": job.resolved.condition,
        "evaluations": work.evaluations,
        "seconds": work.seconds,
        "estimated_relative_rmse": {"total": meter.total, "percentile_95_over_vertices": meter.percentile_95},
        "bins_bent_to_the_horizon": bent,
        "vertices_not_finite": {"count": len(invalid), "first": invalid[:16]},
        "vertices_baked": done,
    }
    if isinstance(job.resolved.sampling, Walks):
        report["walks"] = account.as_json()
    return sink.finish(report, np.array(rows, dtype=np.float64).reshape(-1, 3), done == vertices)


def _missing(vertices: NDArray[np.int64], there: list[Cut]) -> NDArray[np.float64]:
    """1 at the vertices that are to be baked, 0 at those that are there."""
    missing = np.ones(len(vertices))
    for first, last in there:
        missing[(vertices >= first) & (vertices < last)] = 0.0
    return missing


def _until(work: Work, blocks: Iterator[Block]) -> Iterator[Block]:
    while not work.stopped:
        block = next(blocks, None)
        if block is None:
            return
        yield block
