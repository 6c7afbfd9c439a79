"""A pilot at a few vertices: how noisy fits are there, and which tolerances lead to the error that is asked for."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bakers.adaptive.calibration import Correction, Tally
from bakers.adaptive.evaluation_cache import Answers
from bakers.adaptive.records import Lattices, Refined, Refinement
from bakers.adaptive.refinement import refine
from bakers.workers import ALONE, Crew, pieces
from prt_bake.baking.adaptive.parent_vertices import Nearby, nearby_for
from prt_bake.baking.adaptive.pilot import FEWEST_CHECKS, MANY, MISSED, MOST_CHECKS, Site, fewest_checks, out_of_reach
from prt_bake.baking.adaptive.pilot_cost import Spent, seconds_each
from prt_bake.baking.job.forecast import COST
from prt_bake.baking.job.lattices import checked_bins, drawn

Index = NDArray[np.int64]

AIM, AIM_BY_FEW = 0.92, 0.88
"""Of the error asked for, what tolerances are chosen for, and by a pilot of few bins: what it says of all is not exact.
"""
NEARBY_AIM = 0.8
"""The same where most vertices are foretold from others, at those that are not."""
VIEW_OVER_LIGHT = 2.0
VIEW_RANGE = 0.3, 2.0
PILOTS, MOST_PILOTS = (5, 5), 8
"""Trials of few bins, and of many, after which any error below the one asked for will do; and most trials."""
RESPONSE = 0.75
"""Tolerances change with that power of the error that they are to lead to."""
OVER = 4.0
"""Power of the error asked for, over which a trial's is counted as dearer by that."""
OUT_OF_REACH = 1.5
"""Times the error asked for, which a pilot must come down to."""
PILOT_AT_ONCE = 1 << 14
"""Bins of a piece of a pilot: it cannot be stopped in the middle of one."""
PILOT_VERTICES, PILOT_SHARE = 24, 12
"""Most vertices of the pilot, and of how many vertices it takes one."""
PILOT_CHECKS, PILOT_CHECK_COST, MORE_CHECKS = (128, 640), 0.03, 1.5
"""Bins that a pilot of few bins, and of many, is held against others at; what share of a whole pass the checks of one
of few may cost, and times as many as there were, from which on a trial is done again with more.
"""
NEAR = 0.8, 0.85
"""Of the error asked for, what a pilot of few bins, and of many, comes to at least before it is content."""
LATTICES: tuple[Lattices, ...] = ("own", "shared", "learned")
SHARED_PAYS = 1.3
"""Times the evaluations that bins take over a lattice that they share, what they must take over lattices of their own
for it to be tried: what it misses of a bin's detail it misses at every bin of a vertex, and tells too little of.
"""
COMPARED = 2
"""Of how many of the pilot's vertices one is enough to compare them at."""
CHECK_NOISE, LEAST_CHECK_NOISE = 0.7, 0.25
"""Of each of the two lattices of a check, over the error asked for; and where as many are made as are of use."""
CHECK_COST = 0.3
"""Of the evaluations of a pass, what more checks than the fewest, or less noisy ones, may come to."""
DEAR, DEAR_NOISE, CHECKS_A_VERTEX = 3.0, 1.0, 2
"""Times all the rest, that checks may cost before there are fewer; the noise of each of their two lattices then, and
how many of each vertex there are at least."""
LEARNED_CHECKS = 8
"""Of a vertex of a pilot where its bins err together."""
LEAST_AIM = 0.3
"""Of the error asked for, what a pilot may come to that is believed."""
LEARNED_BINS = 256
"""View bins from which on light is learned: fewer share one lattice, err together, and are told badly of."""
LEARNED_MISSED = 0.1
"""Of the error asked for, what lattices may miss without telling where light is to be learned in few directions."""
LEARNED_AIM = 0.8
"""Of the error asked for, what learned light is to come to: it costs hardly more, but vertices differ."""
RECOGNISED = 12.0
"""Evaluations a bin of learned light, up to which no other way is tried."""


@dataclass(frozen=True)
class Aim:
    """How to bake to an error, as the pilot has it."""

    refinement: Refinement
    correction: Correction
    error: float
    """What the pilot came to: the larger of the object's relative RMSE and its 95th percentile over vertices."""
    seconds: float
    """Of one worker for one vertex."""
    spent: Spent
    """By the pilot."""
    evaluations_per_vertex: float
    """Of a pass, checks apart."""
    evaluations_per_check: float = 0.0
    nearby: Nearby | None = None
    """How most vertices are foretold from others, where they are."""
    again: NDArray[np.bool_] | None = None
    """Vertices [V] to be done; the others stay as the pass before left them. None: all."""

    @property
    def foretelling(self) -> Nearby | None:
        """How vertices are foretold in this pass: those that are done again are all evaluated."""
        return self.nearby if self.again is None else None


class Stopped(Exception):
    """A pilot was asked to end."""


def never() -> bool:
    """Does not stop."""
    return False


@dataclass(frozen=True)
class Pilot:
    """Trials at a few vertices of a site: who does them, and whether they are to end."""

    site: Site
    crew: Crew = ALONE
    stop: Callable[[], bool] = never

    def tried(self, how: Refinement, vertices: Index) -> Iterator[tuple[Index, Refined, Spent]]:
        """These vertices, some at a time, what came of them, and what they took."""
        most = max(1, min(self.site.block_vertices, PILOT_AT_ONCE // self.site.bins))
        cut = pieces(vertices, most, self.crew)
        found = self.crew.in_order(lambda some: (some, *self.crew.do(_timed_block, (self.site, how), some)), cut)
        for each in found:
            if self.stop():
                found.close()
                raise Stopped
            yield each


def aimed(pilot: Pilot, refinement: Refinement, error: float) -> Aim:
    """Tolerances that lead to the error at a few vertices, over whichever lattices cost least there.

    Raises QueryError where the error is out of reach, Stopped once the pilot is to end.
    """
    learnable = _learnable(refinement, error)
    refinement = refinement.for_views(error, VIEW_RANGE[1] * VIEW_OVER_LIGHT * error)
    # Trials are much alike, and the passes after them begin with what they have found out.
    refinement = replace(refinement, answers=Answers(pilot_vertices(pilot.site), pilot.site.bins))
    aims, trials = list[Aim](), list[Spent]()
    if learnable:
        aims.append(_calibrated(pilot, replace(refinement, lattices="learned"), LEARNED_AIM * error, trials))
    if not aims or aims[0].error > error or aims[0].evaluations_per_vertex > RECOGNISED * pilot.site.bins:
        way: Lattices = "shared" if _sharing_pays(pilot, refinement, error, trials) else "own"
        aims.append(_calibrated(pilot, replace(refinement, lattices=way), error, trials))
    best = min(aims, key=lambda aim: _dearness(aim, error))
    if best.error > OUT_OF_REACH * error:
        raise out_of_reach(error, refinement.lattice.sizes[-1], best.error)
    nearby, looked = nearby_for(pilot.site, refinement, error, best.evaluations_per_vertex, best.evaluations_per_check)
    best = replace(best, spent=sum(trials, Spent(looked)))
    if nearby is not None:
        best = _foretelling(best, nearby, error)
    return _checked(pilot.site, best, error, seconds_each(trials))


def _foretelling(aim: Aim, nearby: Nearby, error: float) -> Aim:
    """The same with most vertices foretold from others: these err besides by what differs from vertex to vertex."""
    finer = min(1.0, NEARBY_AIM * error / max(aim.error, 1e-300))
    refinement = replace(aim.refinement, light=finer * aim.refinement.light, view=finer * aim.refinement.view)
    aim = replace(aim, refinement=refinement, nearby=nearby, error=finer * aim.error)
    return replace(aim, evaluations_per_vertex=nearby.on_average * finer**-COST)


def _learnable(refinement: Refinement, error: float) -> bool:
    """Whether bins seem to be made of few functions of the light, and none of those that few directions would miss."""
    seen = float(refinement.missed.max(initial=0.0)) <= LEARNED_MISSED * error
    seen &= sum(len(level.bins) for level in refinement.levels) >= LEARNED_BINS
    return seen and refinement.survey is not None and refinement.survey.learnable(error)


def _sharing_pays(pilot: Pilot, refinement: Refinement, error: float, trials: list[Spent]) -> bool:
    """Whether bins of a vertex have so much in common that they had better share a lattice; `trials` takes what it took
    to find out. Where there are many and most are foretold, nothing is gained by it.
    """
    own = _untold(pilot, replace(refinement, lattices="own"), error)
    trials.append(own)
    tried = pilot.site.bins * len(pilot_vertices(pilot.site)[::COMPARED])
    if pilot.site.bins >= LEARNED_BINS and own.wanted < refinement.lattice.sizes[0] * tried:
        return False
    shared = _untold(pilot, replace(refinement, lattices="shared"), error)
    trials.append(shared)
    return own.wanted >= SHARED_PAYS * shared.wanted


def _untold(pilot: Pilot, refinement: Refinement, error: float) -> Spent:
    """What some of the pilot's vertices take, without checks."""
    vertices = pilot_vertices(pilot.site)
    checks = checked_bins(pilot.site.seed, pilot.site.bins, 0.0)
    how = replace(coarse(refinement, error).refinement, checks=checks)
    return sum((spent for _some, _refined, spent in pilot.tried(how, vertices[::COMPARED])), Spent())


def _checked(site: Site, aim: Aim, error: float, seconds: float) -> Aim:
    """The same, with as many checks as cost a small part of it all, and less noisy ones where that allows for more.

    An evaluation takes so many seconds.
    """
    falling, usual = 0.5 + aim.refinement.pool_noise.slope, fewest_checks(site)
    reached = float(np.clip(aim.error, LEAST_AIM * error, error))
    each = max(aim.evaluations_per_check, 1.0) * (error / reached) ** (1.0 / falling)
    rest = aim.evaluations_per_vertex * len(site.vertices) / each
    # Where they are dearer than all the rest, a few of each vertex must do, and less exact ones.
    few = min(max(DEAR * rest, CHECKS_A_VERTEX * len(site.vertices), FEWEST_CHECKS), usual)
    many = float(np.clip(CHECK_COST * rest, few, MOST_CHECKS))
    noise = max(CHECK_NOISE * max(CHECK_COST * rest / many, 1.0) ** -falling, LEAST_CHECK_NOISE)
    noise = DEAR_NOISE if many < usual else noise
    of_checks = many * each * (CHECK_NOISE / noise) ** (1.0 / falling) / len(site.vertices)
    checks = checked_bins(site.seed, site.bins, min(many / site.many, 1.0))
    refinement = replace(aim.refinement, checks=checks, checked=noise * reached)
    return replace(aim, refinement=refinement, seconds=seconds * (aim.evaluations_per_vertex + of_checks))


def _timed_block(site: Site, how: Refinement, vertices: Index) -> tuple[Refined, Spent]:
    began = time.monotonic()
    found = refined_block(site, how, vertices)[0]
    return found, Spent(found.evaluations - found.recalled, found.recalled, time.monotonic() - began)


def pilot_vertices(site: Site) -> Index:
    """The vertices [P] that a pilot tries everything at."""
    count = int(np.clip(len(site.vertices) // PILOT_SHARE, 1, PILOT_VERTICES))
    return site.vertices[np.sort(drawn(site.seed, len(site.vertices), count))]


def _calibrated(pilot: Pilot, refinement: Refinement, error: float, spent: list[Spent]) -> Aim:
    """Tolerances that lead to the error at a few vertices, the cheapest of those tried, or what comes nearest; `spent`
    takes what each trial took.
    """
    few, most = int(pilot.site.many < MANY), len(refinement.lattice.sizes)
    learned = refinement.lattices == "learned"
    dials = untried = _Dials(replace(refinement, begin=refinement.begin_for(error)), error, AIM_BY_FEW if few else AIM)
    trials, before = list[Aim](), Tally(0)
    checks = float(PILOT_CHECKS[1 - few])
    while len(trials) < MOST_PILOTS:
        aim, tally = _trial(pilot, dials.refinement(), error, checks)
        spent.append(aim.spent)
        of_all = aim.evaluations_per_vertex * len(pilot.site.vertices)
        affordable = min(PILOT_CHECK_COST * of_all / max(aim.evaluations_per_check, 1.0), PILOT_CHECKS[1])
        if not learned and affordable > MORE_CHECKS * checks:
            checks = affordable
            continue
        trials.append(aim)
        enough = len(trials) >= PILOTS[1 - few] or aim.error >= NEAR[1 - few] * error
        enough |= learned and aim.evaluations_per_vertex <= RECOGNISED * pilot.site.bins
        if aim.error <= 0.0 or (aim.error <= error and (enough or np.array_equal(tally.variance, before.variance))):
            break
        missed = max(aim.correction.shared, aim.correction.alone) > MISSED
        if learned and aim.error > error and aim.evaluations_per_vertex > RECOGNISED * pilot.site.bins:
            break
        if missed and dials.begin < most:
            # Most bins do not see what some do: what they say of their error is worth nothing.
            dials, trials = dials.beginning(min(dials.begin + 2, most)), []
        elif len(trials) == MOST_PILOTS and dials.begin < most and not learned and _stuck(trials, error):
            # What the first directions say of their error leads nowhere.
            dials, trials = untried.beginning(min(dials.begin + 2, most)), []
        else:
            dials = dials.turned(tally, aim)
        before = tally
    return min(trials, key=lambda aim: _dearness(aim, error))


def _stuck(trials: list[Aim], error: float) -> bool:
    """Whether none of them comes near the error."""
    return min(trial.error for trial in trials) > OUT_OF_REACH * error


def _dearness(aim: Aim, error: float) -> float:
    """Evaluations, more where they do not lead to the error."""
    return float(aim.evaluations_per_vertex * max(aim.error / error, 1.0) ** OVER)


@dataclass(frozen=True)
class _Dials:
    """What is turned between trials."""

    begun: Refinement
    asked: float
    aim: float
    view: float = 1.0
    """The error of prediction tolerated, over what is usual beside that of directions."""
    tightness: float = 1.0
    """The error of directions tolerated, over the error asked for."""

    @property
    def begin(self) -> int:
        return self.begun.begin

    def refinement(self) -> Refinement:
        light = self.tightness * self.asked
        bound = self.view * VIEW_OVER_LIGHT * light
        return replace(self.begun, light=light, view=bound, checked=CHECK_NOISE * self.asked)

    def beginning(self, begin: int) -> "_Dials":
        return replace(self, begun=replace(self.begun, begin=begin))

    def turned(self, tally: Tally, aim: Aim) -> "_Dials":
        """The noise and the error of prediction as they were seen; and what is tolerated, by what that alone would lead
        to.
        """
        seen, noise, pool_noise = aim.correction, self.begun.noise, self.begun.pool_noise
        noise = replace(noise, of_differences=noise.of_differences * seen.shared)
        over_pools = seen.shared if self.begun.lattices == "learned" else seen.alone
        pool_noise = replace(pool_noise, gain=pool_noise.gain / np.sqrt(over_pools))
        view = float(np.clip(self.view / np.sqrt(seen.foretold), *VIEW_RANGE))
        variance = seen.by_way @ tally.variance.sum(axis=1)
        alike = tally.variance.sum(axis=1) @ [seen.foretold * (view / self.view) ** 2, 1.0, 1.0, seen.nearby]
        expected = aim.error * np.sqrt(alike / variance)
        tightness = self.tightness * float(np.clip((self.aim * self.asked / expected) ** RESPONSE, 0.5, 1.6))
        begun = replace(self.begun, noise=noise, pool_noise=pool_noise)
        return replace(self, begun=begun, view=view, tightness=tightness)


def _trial(pilot: Pilot, how: Refinement, error: float, many: float) -> tuple[Aim, Tally]:
    """What such a refinement leads to at the pilot's vertices."""
    site, chosen = pilot.site, pilot_vertices(pilot.site)
    if how.lattices == "learned":
        many = min(many, LEARNED_CHECKS * len(chosen))
    share = max(many / (len(chosen) * site.bins), FEWEST_CHECKS / site.many)
    drawn_bins, coarsest = checked_bins(site.seed + 1, site.bins, min(share, 1.0)), np.zeros(site.bins, bool)
    if how.lattices == "learned":
        # What all lattices miss is seen at bins that are evaluated, and hardly any of those that are drawn are.
        coarsest[how.levels[0].bins] = True
    checks = partial(_checks_and, drawn_bins, coarsest)
    tally, spent = Tally(len(site.mesh.positions)), Spent()
    for some, refined, took in pilot.tried(replace(how, checks=checks), chosen):
        tally.add(some, refined)
        spent += took
    correction = tally.correction(Correction())
    reached = worst_of(*tally.relative(correction))
    per_vertex = (tally.evaluations - tally.check_evaluations) / len(chosen)
    per_check = tally.check_evaluations / max(1, tally.checked)
    return Aim(how, correction, reached, 0.0, spent, per_vertex, per_check), tally


def _checks_and(drawn_bins: Callable[[Index], NDArray[np.bool_]], others: NDArray[np.bool_], vertices: Index) -> Any:
    return drawn_bins(vertices) | others


def coarse(refinement: Refinement, error: float) -> Aim:
    """Tolerances of about that error, without a pilot."""
    return Aim(
        replace(
            refinement.for_views(error, VIEW_OVER_LIGHT * error),
            light=error,
            view=VIEW_OVER_LIGHT * error,
            checked=CHECK_NOISE * error,
            begin=refinement.begin_for(error),
        ),
        Correction(),
        error,
        0.0,
        Spent(),
        0.0,
    )


def refined_block(site: Site, refinement: Refinement, vertices: Index) -> tuple[Refined, int]:
    """A block, and how many of its bins were bent to the horizon."""
    views = [site.views(int(vertex), int(vertex) + 1) for vertex in vertices]
    outgoing = np.concatenate([directions for directions, _bent in views])
    refined = refine(site.transport, refinement, vertices, site.mesh.positions[vertices], outgoing)
    return refined, sum(bent for _directions, bent in views)


def worst_of(total: float, percentile_95: float) -> float:
    """The larger of the two figures of an error."""
    return max(total, percentile_95)
