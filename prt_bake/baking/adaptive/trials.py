"""Trials of a pilot: bakes of a few vertices with different tolerances, until these give the requested error."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from bakers.adaptive.calibration import Correction, Tally
from bakers.adaptive.records import RefinedBlock, RefinementSettings
from bakers.workers import SINGLE_THREAD, Workers, split_evenly
from prt_bake.baking.adaptive.adaptive_job import MANY, AdaptiveJob
from prt_bake.baking.adaptive.noise_pilot import FEWEST_VALIDATION_BINS, MISSED
from prt_bake.baking.adaptive.pass_settings import (
    VALIDATION_NOISE,
    VIEW_OVER_LIGHT,
    PassSettings,
    refined_block,
    worst_of,
)
from prt_bake.baking.adaptive.pilot_cost import PilotCost
from prt_bake.baking.job.lattices import sample_without_replacement, validation_bins

Index = NDArray[np.int64]

TARGET, TARGET_OF_FEW = 0.92, 0.88
"""Error that tolerances are chosen for, over the requested one; less for pilots of few bins, which are less exact."""
VIEW_RANGE = 0.3, 2.0
ENOUGH_TRIALS, MOST_TRIALS = (5, 5), 8
"""Trials of small and of large objects after which any error below the requested one is accepted; and most trials."""
RESPONSE = 0.75
"""Tolerances change with this power of the ratio of the errors."""
PENALTY = 4.0
"""Power of the error over the requested one, by which the cost of a trial that misses it is multiplied."""
OUT_OF_REACH = 1.5
"""Least error of a pilot over the requested one at which the latter is out of reach."""
BINS_AT_ONCE = 1 << 14
"""Bins of a piece of a trial, which cannot be interrupted."""
PILOT_VERTICES, PILOT_SHARE = 24, 12
"""Most vertices of the pilot; it takes one of `PILOT_SHARE` vertices."""
PILOT_VALIDATION_BINS, PILOT_VALIDATION_COST, MORE_VALIDATION = (128, 640), 0.03, 1.5
"""Validation bins of a pilot of a small and of a large object; largest cost of the former over that of a complete pass;
factor on their number above which a trial is repeated with more.
"""
NEAR = 0.8, 0.85
"""Least error over the requested one at which trials of small and of large objects end early."""
LEARNED_VALIDATION_BINS = 8
"""Validation bins of a vertex of a pilot whose bins have correlated errors."""
CHEAP = 12.0
"""Evaluations per bin with learned light components below which no other method is tried."""


class PilotStopped(Exception):
    """The bake was stopped during a pilot."""


def never() -> bool:
    """Does not stop."""
    return False


@dataclass(frozen=True)
class Pilot:
    """The job of a pilot, its workers, and a callback that stops it."""

    job: AdaptiveJob
    workers: Workers = SINGLE_THREAD
    stop: Callable[[], bool] = never

    def bake(self, refinement: RefinementSettings, vertices: Index) -> Iterator[tuple[Index, RefinedBlock, PilotCost]]:
        """Bakes the vertices in pieces; yields the vertices, the block and the cost of each piece."""
        most = max(1, min(self.job.block_vertices, BINS_AT_ONCE // self.job.bins))
        pieces = split_evenly(vertices, most, self.workers)
        shared = self.job, refinement
        blocks = self.workers.in_order(lambda piece: (piece, *self.workers.do(_timed_block, shared, piece)), pieces)
        for block in blocks:
            if self.stop():
                blocks.close()
                raise PilotStopped
            yield block


def pilot_vertices(job: AdaptiveJob) -> Index:
    """The vertices [P] of the pilot."""
    count = int(np.clip(len(job.vertices) // PILOT_SHARE, 1, PILOT_VERTICES))
    return job.vertices[np.sort(sample_without_replacement(job.seed, len(job.vertices), count))]


def calibrated(pilot: Pilot, refinement: RefinementSettings, error: float, costs: list[PilotCost]) -> PassSettings:
    """Settings that give the error at a few vertices: the cheapest of the trials, or the one that comes nearest.

    Appends the cost of each trial to `costs`.
    """
    few, most = int(pilot.job.many < MANY), len(refinement.lattice.sizes)
    learned = refinement.lattices == "learned"
    first = replace(refinement, initial_sizes=refinement.initial_sizes_for(error))
    tuning = initial = _Tuning(first, error, TARGET_OF_FEW if few else TARGET)
    trials, before = list[PassSettings](), Tally(0)
    bins = float(PILOT_VALIDATION_BINS[1 - few])
    while len(trials) < MOST_TRIALS:
        settings, tally = trial(pilot, tuning.refinement(), error, bins)
        costs.append(settings.pilot_cost)
        pass_cost = settings.evaluations_per_vertex * len(pilot.job.vertices)
        affordable = PILOT_VALIDATION_COST * pass_cost / max(settings.evaluations_per_validation_bin, 1.0)
        affordable = min(affordable, PILOT_VALIDATION_BINS[1])
        if not learned and affordable > MORE_VALIDATION * bins:
            bins = affordable
            continue
        trials.append(settings)
        cheap = settings.evaluations_per_vertex <= CHEAP * pilot.job.bins
        enough = len(trials) >= ENOUGH_TRIALS[1 - few] or settings.error >= NEAR[1 - few] * error
        enough |= learned and cheap
        repeated = np.array_equal(tally.variance, before.variance)
        if settings.error <= 0.0 or (settings.error <= error and (enough or repeated)):
            break
        if learned and settings.error > error and not cheap:
            break
        missed = max(settings.correction.shared_lattice, settings.correction.own_lattice) > MISSED
        far_off = len(trials) == MOST_TRIALS and min(each.error for each in trials) > OUT_OF_REACH * error
        more = min(tuning.initial_sizes + 2, most)
        if missed and tuning.initial_sizes < most:
            # Most bins miss detail that a few see, so their stated errors mean nothing.
            tuning, trials = tuning.starting_with(more), []
        elif far_off and tuning.initial_sizes < most and not learned:
            # The errors stated by so few directions do not lead to the requested error.
            tuning, trials = initial.starting_with(more), []
        else:
            tuning = tuning.updated(tally, settings)
        before = tally
    return min(trials, key=lambda settings: penalised_cost(settings, error))


def penalised_cost(settings: PassSettings, error: float) -> float:
    """Evaluations per vertex, with a penalty for settings that miss the error."""
    return float(settings.evaluations_per_vertex * max(settings.error / error, 1.0) ** PENALTY)


@dataclass(frozen=True)
class _Tuning:
    """What changes from trial to trial."""

    base: RefinementSettings
    error: float
    target: float
    """Over the requested error."""
    view: float = 1.0
    """Tolerance of interpolation between views, over its usual ratio to that of directions."""
    light: float = 1.0
    """Tolerance of the integration over directions, over the requested error."""

    @property
    def initial_sizes(self) -> int:
        return self.base.initial_sizes

    def refinement(self) -> RefinementSettings:
        light = self.light * self.error
        view = self.view * VIEW_OVER_LIGHT * light
        noise = VALIDATION_NOISE * self.error
        return replace(self.base, light_tolerance=light, view_tolerance=view, validation_noise=noise)

    def starting_with(self, initial_sizes: int) -> "_Tuning":
        return replace(self, base=replace(self.base, initial_sizes=initial_sizes))

    def updated(self, tally: Tally, settings: PassSettings) -> "_Tuning":
        """With the measured noise and interpolation error, and tolerances scaled by the error that these predict."""
        measured, noise, pool_noise = settings.correction, self.base.noise, self.base.pool_noise
        noise = replace(noise, of_differences=noise.of_differences * measured.shared_lattice)
        over_pools = measured.shared_lattice if self.base.lattices == "learned" else measured.own_lattice
        pool_noise = replace(pool_noise, gain=pool_noise.gain / np.sqrt(over_pools))
        view = float(np.clip(self.view / np.sqrt(measured.interpolated), *VIEW_RANGE))
        by_method = tally.variance.sum(axis=1)
        variance = measured.factors @ by_method
        changed = by_method @ [measured.interpolated * (view / self.view) ** 2, 1.0, 1.0, measured.from_vertices]
        expected = settings.error * np.sqrt(changed / variance)
        light = self.light * float(np.clip((self.target * self.error / expected) ** RESPONSE, 0.5, 1.6))
        return replace(self, base=replace(self.base, noise=noise, pool_noise=pool_noise), view=view, light=light)


def trial(pilot: Pilot, refinement: RefinementSettings, error: float, bins: float) -> tuple[PassSettings, Tally]:
    """Bakes the pilot's vertices with about `bins` validation bins; the resulting settings and tally."""
    job, vertices = pilot.job, pilot_vertices(pilot.job)
    if refinement.lattices == "learned":
        bins = min(bins, LEARNED_VALIDATION_BINS * len(vertices))
    share = max(bins / (len(vertices) * job.bins), FEWEST_VALIDATION_BINS / job.many)
    random_bins, always = validation_bins(job.seed + 1, job.bins, min(share, 1.0)), np.zeros(job.bins, bool)
    if refinement.lattices == "learned":
        # Only evaluated bins show what all lattices miss, and random bins are rarely evaluated.
        always[refinement.levels[0].bins] = True
    tally, cost = Tally(len(job.mesh.positions)), PilotCost()
    validated = replace(refinement, validation_bins=partial(_union, random_bins, always))
    for piece, block, piece_cost in pilot.bake(validated, vertices):
        tally.add(piece, block)
        cost += piece_cost
    correction = tally.correction(Correction())
    reached = worst_of(*tally.relative(correction))
    per_vertex = (tally.evaluations - tally.validation_evaluations) / len(vertices)
    per_bin = tally.validation_evaluations / max(1, tally.validated_bins)
    return PassSettings(refinement, correction, reached, 0.0, cost, per_vertex, per_bin), tally


def _union(
    random_bins: Callable[[Index], NDArray[np.bool_]], always: NDArray[np.bool_], vertices: Index
) -> NDArray[np.bool_]:
    return random_bins(vertices) | always


def _timed_block(job: AdaptiveJob, refinement: RefinementSettings, vertices: Index) -> tuple[RefinedBlock, PilotCost]:
    began = time.monotonic()
    block = refined_block(job, refinement, vertices)[0]
    return block, PilotCost(block.evaluations - block.recalled, block.recalled, time.monotonic() - began)
