"""A pass over some vertices, which predicts the cost of a pass over all of them.

The trials of a pilot predict time badly: their blocks are small, much is done for the first time, and some values are
cached. If a few vertices cost several times as much as the others, the mean of two dozen vertices is off by a sixth.
"""

import time
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bakers.adaptive.calibration import Tally
from bakers.adaptive.evaluation_cache import NO_CACHE
from bakers.adaptive.records import RefinedBlock, RefinementSettings
from bakers.workers import Workers
from prt_bake.baking.adaptive.adaptive_job import MANY, AdaptiveJob
from prt_bake.baking.adaptive.parent_vertices import INTERPOLATION_TIME
from prt_bake.baking.adaptive.pass_settings import Pass, PassSettings, refined_block
from prt_bake.baking.adaptive.passes import tighter
from prt_bake.baking.adaptive.trials import PILOT_VALIDATION_BINS
from prt_bake.baking.job.forecast import COST_EXPONENT
from prt_bake.baking.job.lattices import sample_without_replacement

ENOUGH, MOST, LARGEST = 0.06, 0.06, 0.25
"""Blocks are baked until the standard error of the mean cost of a vertex is below `ENOUGH`, or until they are a share
`MOST` of all; a block is at most a share `LARGEST`.
"""


@dataclass(frozen=True)
class PilotPass:
    """Cost of a pass at some vertices."""

    vertices: int
    """Number of vertices."""
    seconds: float
    """Per vertex, with all workers."""
    evaluations: float
    """Per vertex, with validation samples."""
    deviation: float
    """Relative standard error of the mean cost over all vertices."""
    block: RefinedBlock
    """One of the blocks."""
    tally: Tally
    """Of all blocks."""

    def of_pass(self, settings: PassSettings, job: AdaptiveJob) -> "PilotPass":
        """The cost of a pass with these settings, which may interpolate vertices."""
        interpolation = settings.active_interpolation
        if interpolation is None:
            return self
        evaluated = interpolation.mean_evaluations / interpolation.per_vertex
        time_share = (1.0 - interpolation.share) * INTERPOLATION_TIME * job.bins / interpolation.per_vertex
        return replace(self, seconds=self.seconds * (evaluated + time_share), evaluations=self.evaluations * evaluated)

    def repeats(self, settings: PassSettings, error: float, job: AdaptiveJob) -> float:
        """Predicted cost of the pass that follows, over that of the pass itself; 0 if the pass reaches the error."""
        done = Pass.of(self.tally, settings.correction, complete=True)
        if settings.interpolation is not None or min(done.worst, settings.error) <= 0.0:
            return 0.0
        # Both predictions of the error count in proportion to their validation bins.
        weights = PILOT_VALIDATION_BINS[int(job.many >= MANY)], self.tally.validated_bins
        predicted = float(np.exp(np.average(np.log([settings.error, done.worst]), weights=weights)))
        if predicted <= error:
            return 0.0
        following = tighter(settings, done, error * done.worst / predicted)
        assert following.rebake is not None
        finer = settings.refinement.light_tolerance / following.refinement.light_tolerance
        return float(following.rebake[self.tally.done].mean() * finer**COST_EXPONENT)


def run_pilot_pass(job: AdaptiveJob, refinement: RefinementSettings, workers: Workers) -> PilotPass:
    """Bakes blocks of random vertices, one for each worker at a time, without the cache of the pilot."""
    refinement, count = replace(refinement, cache=NO_CACHE), len(job.vertices)
    size = max(1, min(job.block_vertices, int(LARGEST * count)))
    order = job.vertices[sample_without_replacement(job.seed + 6, count, count)]
    seconds, done, blocks, tally = 0.0, 0, list[RefinedBlock](), Tally(len(job.mesh.positions))
    shared = job, refinement
    while done < count:
        pieces = [np.sort(order[first : first + size]) for first in range(done, count, size)][: workers.count]
        began = time.monotonic()
        new = list(workers.in_order(lambda piece: workers.do(refined_block, shared, piece)[0], pieces))
        seconds += time.monotonic() - began
        done, blocks = done + sum(len(piece) for piece in pieces), [*blocks, *new]
        for piece, block in zip(pieces, new, strict=True):
            tally.add(piece, block)
        costs = np.concatenate([block.directions.sum(axis=1, dtype=np.float64) for block in blocks])
        deviation = _deviation(costs, count)
        if done >= MOST * count or deviation <= ENOUGH:
            break
    return PilotPass(done, seconds / done, tally.evaluations / done, deviation, blocks[-1], tally)


def _deviation(costs: NDArray[np.float64], count: int) -> float:
    """Relative standard error of the mean of `costs`, which were drawn without replacement from `count`."""
    if len(costs) < 2:
        return 1.0
    spread = float(costs.std(ddof=1) / max(costs.mean(), 1e-300))
    return spread * float(np.sqrt((1.0 - len(costs) / count) / len(costs)))
