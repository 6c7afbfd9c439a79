"""One pass of an adaptive bake over all vertices, and the settings of a pass that follows one with too large an error.

A pilot at a few vertices measures the noise of the fits and chooses tolerances for the requested error. A pass bakes
all vertices to these (`bakers.adaptive.refinement`), validates a random sample of the bins against independent
directions, and corrects all stated errors by the result (`bakers.adaptive.calibration`). If the error is larger than
requested, a pass with tighter tolerances follows. Each pass starts again: the passes before it cost little in
comparison, and a lattice of the right size has a smaller error than one that was enlarged.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bakers.adaptive.calibration import Tally
from bakers.adaptive.records import RefinedBlock
from bakers.workers import Workers
from prt_bake.baking.adaptive.adaptive_job import AdaptiveJob
from prt_bake.baking.adaptive.checkpoints import ClampedBlock, PassCheckpoints
from prt_bake.baking.adaptive.interpolation import EvaluatedVertices, interpolated_block
from prt_bake.baking.adaptive.parent_vertices import Interpolation
from prt_bake.baking.adaptive.pass_settings import Pass, PassSettings, refined_block, worst_of
from prt_bake.baking.adaptive.trials import TARGET
from prt_bake.baking.job.forecast import COST_EXPONENT

TIGHTER = 0.8, 0.6, 0.4, 0.25, 0.15
"""Factors on the error of vertices that are baked again."""


def tighter(settings: PassSettings, done: Pass, error: float) -> PassSettings:
    """Settings of a pass after one that missed the requested error. The worst vertices are baked again; their number
    and their tolerances are the cheapest that reach the error.
    """
    goal = TARGET * error
    factors = TIGHTER if settings.refinement.lattices != "learned" else TIGHTER[2:]
    options = [_rebake_worst(done, goal, factor) for factor in factors] + [_rebake_all(done, goal)]
    rebake, factor, left = min(
        options, key=lambda option: (option[2] > goal, option[0].sum() * option[1] ** -COST_EXPONENT)
    )
    refinement = replace(
        settings.refinement,
        light_tolerance=factor * settings.refinement.light_tolerance,
        view_tolerance=factor * settings.refinement.view_tolerance,
    )
    return replace(settings, refinement=refinement, correction=done.correction, error=left, rebake=rebake)


def _rebake_worst(done: Pass, goal: float, factor: float) -> tuple[NDArray[np.bool_], float, float]:
    """The fewest vertices [V], to a hundredth, that reach the goal if their errors shrink by `factor`; also the factor
    and the resulting error.
    """
    order = done.tally.worst_first(done.correction)
    smaller, left = np.ones(len(done.tally.done)), done.worst
    for count in np.unique(np.linspace(1, max(1, len(order)), 100).astype(np.int64)):
        smaller[order[:count]] = factor
        left = worst_of(*done.tally.relative(done.correction, smaller))
        if left <= goal:
            break
    return smaller < 1.0, factor, left


def _rebake_all(done: Pass, goal: float) -> tuple[NDArray[np.bool_], float, float]:
    return np.ones(len(done.tally.done), bool), goal / done.worst, goal


def one_pass(
    job: AdaptiveJob,
    settings: PassSettings,
    workers: Workers,
    checkpoints: PassCheckpoints,
    stop: Callable[[], bool],
    progress: Callable[[int, Tally], None],
) -> Pass:
    """Bakes all vertices, or those in `settings.rebake`, block by block. Ends early once `stop` is true."""
    tally, done, vertices = Tally(len(job.mesh.positions)), 0, len(job.vertices)
    interpolation, parents, ahead = settings.active_interpolation, None, 0.0
    if interpolation is not None:
        parents, ahead = EvaluatedVertices(job, interpolation, checkpoints), interpolation.ahead * vertices
        try:
            for share in _evaluate_parents(job, settings, interpolation, workers, checkpoints):
                progress(int(share * ahead), tally)
                if stop():
                    raise KeyboardInterrupt
        except KeyboardInterrupt:
            return Pass(tally, settings.correction, 0.0, 0.0, complete=False)

    def bake(first: int) -> tuple[int, RefinedBlock]:
        block = checkpoints.read(first)
        if block is None:
            if interpolation is not None and parents is not None:
                block = interpolated_block(
                    job, settings.refinement, interpolation, workers, checkpoints, parents, first
                )
            else:
                block = _evaluated_block(job, settings, workers, checkpoints, first)
            checkpoints.write(first, *block)
        return first, block[0]

    blocks: Iterator[tuple[int, RefinedBlock]] = workers.in_order(bake, job.blocks)
    try:
        while not stop():
            following = next(blocks, None)
            if following is None:
                break
            first, refined = following
            tally.add(job.block(first), refined)
            done += len(refined.standard_error)
            progress(round(ahead + (1.0 - ahead / vertices) * done), tally)
    except KeyboardInterrupt:
        pass
    finally:
        blocks.close()  # type: ignore[attr-defined]
    return Pass.of(tally, settings.correction, complete=done == len(job.vertices))


def _evaluate_parents(
    job: AdaptiveJob,
    settings: PassSettings,
    interpolation: Interpolation,
    workers: Workers,
    checkpoints: PassCheckpoints,
) -> Iterator[float]:
    """Bakes the vertices from which others are interpolated, and yields the share of them that is done."""

    def bake(first: int) -> int:
        vertices = job.block(first)
        chosen = vertices[interpolation.evaluated[first : first + len(vertices)]]
        if len(chosen) and checkpoints.read(first) is None and checkpoints.read_evaluated(first) is None:
            checkpoints.write_evaluated(first, *workers.do(refined_block, (job, settings.refinement), chosen))
        return len(chosen)

    done = 0
    for count in workers.in_order(bake, job.blocks):
        done += count
        yield done / len(interpolation.numbers)


def _evaluated_block(
    job: AdaptiveJob, settings: PassSettings, workers: Workers, checkpoints: PassCheckpoints, first: int
) -> ClampedBlock:
    """A block without interpolated vertices; vertices that are not in `settings.rebake` keep their values."""
    vertices, shared = job.block(first), (job, settings.refinement)
    if settings.rebake is None:
        return workers.do(refined_block, shared, vertices)
    previous, clamped = checkpoints.require_previous(first)
    rows = np.flatnonzero(settings.rebake[vertices])
    if not len(rows):
        return previous.without_cost(), clamped
    return previous.with_rows(rows, workers.do(refined_block, shared, vertices[rows])[0]), clamped
