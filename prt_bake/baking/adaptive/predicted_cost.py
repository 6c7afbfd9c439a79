"""Predicts the cost of an adaptive bake from its pilot and from passes over some vertices."""

import math
import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bakers.adaptive.calibration import Correction
from bakers.adaptive.records import RefinementSettings
from bakers.workers import Workers
from prt_bake.baking.adaptive.adaptive_job import AdaptiveJob
from prt_bake.baking.adaptive.checkpoints import as_arrays as pass_checkpoint
from prt_bake.baking.adaptive.noise_pilot import first_refinement, refuse_out_of_reach
from prt_bake.baking.adaptive.pass_settings import uncalibrated, worst_of
from prt_bake.baking.adaptive.pilot_pass import PilotPass, run_pilot_pass
from prt_bake.baking.adaptive.run import COARSE, FINER, FINEST, TIME_TO_USE, coarse_first
from prt_bake.baking.adaptive.tolerances import settings_for_error
from prt_bake.baking.adaptive.trials import Pilot, pilot_vertices
from prt_bake.baking.job.forecast import COARSE_EXPONENT, COST_EXPONENT
from prt_bake.baking.job.pruning_record import Pruning
from prt_bake.baking.output.writing_time import checkpoint_time

SIGMAS = 2.0
"""Half width of the stated range of the mean cost of a vertex, in standard errors."""
ERROR_FACTOR = 1.1
"""Uncertainty of the predicted error of a pass."""
_LEAST_SECONDS = 1e-6
"""Of a coarse pass that is too short for the clock."""


@dataclass(frozen=True)
class Cost:
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
    error: float | None = None
    """Predicted error of an adaptive bake."""


def adaptive_cost(
    job: AdaptiveJob, error: float | None, limit: float, pruning: Pruning, pool: Workers, began: float
) -> Cost:
    """Cost of a bake to `error`, or for `limit` seconds if it is not reached by then; one of the two is given.

    The pilot of the bake, which has run, is included.
    """
    refinement, evaluations = first_refinement(job, pool)
    if math.isinf(limit) and error is not None:
        return _cost_to_error(job, refinement, error, pruning, pool, began, evaluations)
    coarse = run_pilot_pass(job, uncalibrated(refinement, max(COARSE, error or 0.0)).refinement, pool)
    timed = _cost_for_time(job, coarse, error, limit, pruning, began, evaluations)
    # The time suffices for the error: predicted more exactly by trials for this error.
    if error is not None and timed.error is not None and timed.error <= error:
        exact = _cost_to_error(job, refinement, error, pruning, pool, began, evaluations)
        return exact if exact.seconds < limit else timed
    return timed


def _cost_to_error(
    job: AdaptiveJob,
    refinement: RefinementSettings,
    error: float,
    pruning: Pruning,
    pool: Workers,
    began: float,
    evaluations: int,
) -> Cost:
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
    return Cost(
        per_bin=math.ceil(per_vertex.evaluations / job.bins),
        evaluations=float(evaluations) + sum(each.evaluations * each.times[0] for each in passes),
        seconds=before + sum(each.seconds * each.times[0] for each in passes),
        between=(before + sum(each.least for each in passes), before + sum(each.most for each in passes)),
        coefficients=fine.block.coefficients,
        assets=len(passes) + (repeats[0] > 1.0),
        error=error,
    )


def _cost_for_time(
    job: AdaptiveJob,
    coarse: PilotPass,
    error: float | None,
    limit: float,
    pruning: Pruning,
    began: float,
    evaluations: int,
) -> Cost:
    """Cost of a coarse pass, and of a finer one in most of the time that is left.

    The bake goes on until no finer pass fits in the time, so it takes from the first two passes to all of the time.
    """
    count, before = len(job.vertices), time.monotonic() - began
    reached = worst_of(*coarse.tally.relative(coarse.tally.correction(Correction())))
    coarse_pass = max(coarse.seconds * count, _LEAST_SECONDS)
    first = before + coarse_pass
    most = _finer_in(TIME_TO_USE * max(limit - first, 0.0) / coarse_pass)
    finer = most if error is None else min(most, reached / error)
    finer = finer if finer > FINER else 1.0
    more = _time_for(finer) if finer > 1.0 else 0.0
    passes = coarse.evaluations * count * (1.0 + more)
    second = coarse_pass * more
    return Cost(
        per_bin=math.ceil(coarse.evaluations * max(1.0, more) / job.bins),
        evaluations=evaluations + pruning.evaluations + passes,
        seconds=first + second,
        between=(first + second / 2.0, max(first + second, limit)),
        coefficients=coarse.block.coefficients,
        assets=1 + (more > 0.0),
        error=reached / finer,
    )


def _time_for(finer: float) -> float:
    """Time of a pass whose error is smaller than that of a coarse pass by this factor, over the time of that one."""
    steep = max(finer / FINEST, 1.0)
    return float((finer / steep) ** COARSE_EXPONENT * steep**COST_EXPONENT)


def _finer_in(time_over_coarse: float) -> float:
    """The inverse of `_time_for`."""
    steep = max(time_over_coarse / FINEST**COARSE_EXPONENT, 1.0)
    return float((time_over_coarse / steep) ** (1.0 / COARSE_EXPONENT) * steep ** (1.0 / COST_EXPONENT))


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
