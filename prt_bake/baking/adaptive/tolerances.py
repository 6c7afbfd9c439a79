"""Chooses the settings of a pass for a requested error: lattices, tolerances, interpolation and validation samples."""

from dataclasses import replace

import numpy as np

from bakers.adaptive.evaluation_cache import EvaluationCache
from bakers.adaptive.records import Lattices, RefinementSettings
from prt_bake.baking.adaptive.adaptive_job import AdaptiveJob
from prt_bake.baking.adaptive.noise_pilot import (
    FEWEST_VALIDATION_BINS,
    MOST_VALIDATION_BINS,
    fewest_validation_bins,
    out_of_reach,
)
from prt_bake.baking.adaptive.parent_vertices import Interpolation, choose_interpolation
from prt_bake.baking.adaptive.pass_settings import VALIDATION_NOISE, VIEW_OVER_LIGHT, PassSettings, uncalibrated
from prt_bake.baking.adaptive.pilot_cost import PilotCost, seconds_per_evaluation
from prt_bake.baking.adaptive.trials import (
    CHEAP,
    OUT_OF_REACH,
    VIEW_RANGE,
    Pilot,
    calibrated,
    penalised_cost,
    pilot_vertices,
)
from prt_bake.baking.job.forecast import COST_EXPONENT
from prt_bake.baking.job.lattices import validation_bins

INTERPOLATION_TARGET = 0.8
"""Error of evaluated vertices over the requested one if most vertices are interpolated from them."""
SHARED_PAYS = 1.3
"""A shared lattice is tried if lattices of each bin's own need this many times the evaluations. Detail that a shared
lattice misses is missed at all bins of a vertex, and underestimated.
"""
COMPARED = 2
"""That comparison uses one in this many vertices of the pilot."""
LEAST_VALIDATION_NOISE = 0.25
"""`VALIDATION_NOISE` if there are as many validation samples as are useful."""
VALIDATION_COST = 0.3
"""Largest share of the evaluations of a pass for validation samples beyond the fewest, or for less noisy ones."""
EXPENSIVE, EXPENSIVE_NOISE, VALIDATION_BINS_PER_VERTEX = 3.0, 1.0, 2
"""If validation costs more than `EXPENSIVE` times the rest, there are fewer samples, with `EXPENSIVE_NOISE`, but at
least `VALIDATION_BINS_PER_VERTEX`.
"""
LEAST_ERROR = 0.3
"""Smallest error of a pilot that is trusted, over the requested one."""
LEARNED_BINS = 256
"""Fewest view bins for learned light components: fewer bins share one lattice, and their correlated errors are badly
estimated.
"""
LEARNED_MISSED = 0.1
"""Largest error that lattices may miss, over the requested one, for light to be learned from few directions."""
LEARNED_TARGET = 0.8
"""Error of learned light over the requested one: a smaller error costs little, and vertices differ."""


def settings_for_error(pilot: Pilot, refinement: RefinementSettings, error: float) -> PassSettings:
    """Settings that give the error at a few vertices, with the cheapest kind of lattices.

    Raises QueryError if the error is out of reach, PilotStopped if the bake is stopped.
    """
    learnable = _is_learnable(refinement, error)
    refinement = refinement.with_full_levels(error, VIEW_RANGE[1] * VIEW_OVER_LIGHT * error)
    # Trials evaluate mostly the same directions, and the passes after them reuse these.
    refinement = replace(refinement, cache=EvaluationCache(pilot_vertices(pilot.job), pilot.job.bins))
    candidates, costs = list[PassSettings](), list[PilotCost]()
    if learnable:
        candidates.append(calibrated(pilot, replace(refinement, lattices="learned"), LEARNED_TARGET * error, costs))
    learned = candidates[0] if candidates else None
    if learned is None or learned.error > error or learned.evaluations_per_vertex > CHEAP * pilot.job.bins:
        lattices: Lattices = "shared" if _sharing_pays(pilot, refinement, error, costs) else "own"
        candidates.append(calibrated(pilot, replace(refinement, lattices=lattices), error, costs))
    best = min(candidates, key=lambda settings: penalised_cost(settings, error))
    if best.error > OUT_OF_REACH * error:
        raise out_of_reach(error, refinement.lattice.sizes[-1], best.error)
    interpolation, evaluations = choose_interpolation(
        pilot.job, refinement, error, best.evaluations_per_vertex, best.evaluations_per_validation_bin
    )
    best = replace(best, pilot_cost=sum(costs, PilotCost(evaluations)))
    if interpolation is not None:
        best = _with_interpolation(best, interpolation, error)
    return _with_validation(pilot.job, best, error, seconds_per_evaluation(costs))


def _with_interpolation(settings: PassSettings, interpolation: Interpolation, error: float) -> PassSettings:
    """The settings with most vertices interpolated; evaluated ones get a smaller error, because interpolation adds its
    own.
    """
    finer = min(1.0, INTERPOLATION_TARGET * error / max(settings.error, 1e-300))
    refinement = replace(
        settings.refinement,
        light_tolerance=finer * settings.refinement.light_tolerance,
        view_tolerance=finer * settings.refinement.view_tolerance,
    )
    settings = replace(settings, refinement=refinement, interpolation=interpolation, error=finer * settings.error)
    return replace(settings, evaluations_per_vertex=interpolation.mean_evaluations * finer**-COST_EXPONENT)


def _is_learnable(refinement: RefinementSettings, error: float) -> bool:
    """Whether few functions of the light seem to span all bins, without detail that few directions would miss."""
    seen = float(refinement.missed_error.max(initial=0.0)) <= LEARNED_MISSED * error
    seen &= sum(len(level.bins) for level in refinement.levels) >= LEARNED_BINS
    return seen and refinement.survey is not None and refinement.survey.is_low_rank(error)


def _sharing_pays(pilot: Pilot, refinement: RefinementSettings, error: float, costs: list[PilotCost]) -> bool:
    """Whether bins of a vertex are similar enough to share a lattice; appends the cost of the comparison to `costs`. It
    does not pay if there are many bins and most are interpolated.
    """
    own = _unvalidated_cost(pilot, replace(refinement, lattices="own"), error)
    costs.append(own)
    compared = pilot.job.bins * len(pilot_vertices(pilot.job)[::COMPARED])
    if pilot.job.bins >= LEARNED_BINS and own.requested < refinement.lattice.sizes[0] * compared:
        return False
    shared = _unvalidated_cost(pilot, replace(refinement, lattices="shared"), error)
    costs.append(shared)
    return own.requested >= SHARED_PAYS * shared.requested


def _unvalidated_cost(pilot: Pilot, refinement: RefinementSettings, error: float) -> PilotCost:
    """Cost of some of the pilot's vertices, without validation samples."""
    none = validation_bins(pilot.job.seed, pilot.job.bins, 0.0)
    refinement = replace(uncalibrated(refinement, error).refinement, validation_bins=none)
    pieces = pilot.bake(refinement, pilot_vertices(pilot.job)[::COMPARED])
    return sum((cost for _vertices, _block, cost in pieces), PilotCost())


def _with_validation(job: AdaptiveJob, settings: PassSettings, error: float, seconds: float) -> PassSettings:
    """The settings with as many validation samples as cost a small share of the pass, and less noisy ones if there is
    more to spend. An evaluation takes `seconds`.
    """
    exponent, usual = 0.5 + settings.refinement.pool_noise.slope, fewest_validation_bins(job)
    reached = float(np.clip(settings.error, LEAST_ERROR * error, error))
    each = max(settings.evaluations_per_validation_bin, 1.0) * (error / reached) ** (1.0 / exponent)
    rest = settings.evaluations_per_vertex * len(job.vertices) / each
    fewest = min(max(EXPENSIVE * rest, VALIDATION_BINS_PER_VERTEX * len(job.vertices), FEWEST_VALIDATION_BINS), usual)
    count = float(np.clip(VALIDATION_COST * rest, fewest, MOST_VALIDATION_BINS))
    noise = max(VALIDATION_NOISE * max(VALIDATION_COST * rest / count, 1.0) ** -exponent, LEAST_VALIDATION_NOISE)
    noise = EXPENSIVE_NOISE if count < usual else noise
    validation_cost = count * each * (VALIDATION_NOISE / noise) ** (1.0 / exponent) / len(job.vertices)
    bins = validation_bins(job.seed, job.bins, min(count / job.many, 1.0))
    refinement = replace(settings.refinement, validation_bins=bins, validation_noise=noise * reached)
    seconds *= settings.evaluations_per_vertex + validation_cost
    return replace(settings, refinement=refinement, seconds=seconds)
