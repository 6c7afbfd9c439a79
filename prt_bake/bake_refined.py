"""Bakes to an error that is asked for, or for as long as one likes: a coarse asset first, then finer ones.

A pilot at a few vertices finds out how noisy the fits are and which tolerances lead to the error asked for; then all
vertices are baked to those (`bakers.refinement`), a random sample of bins is held against independent directions, and
what these say corrects every stated error (`bakers.verdict`). Where the error turns out larger than was asked for, the
tolerances are drawn tighter and it is done again. Each pass starts anew: of what a pass costs, the passes before it are
a small part, and a lattice of the right size has a smaller error than one that was added to.
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from bakers.crew import ALONE, Crew, pieces
from bakers.refined import Lattices, Refined, Refinement
from bakers.refinement import refine
from bakers.verdict import Correction, Tally
from prt_bake.bake_first_look import FEWEST_AT_ONCE, FEWEST_CHECKS, MISSED, Site, out_of_reach
from prt_bake.bake_forecast import COST
from prt_bake.bake_light import checked_bins, drawn

Array = NDArray[np.float64]
Index = NDArray[np.int64]

AIM = 0.92
"""Of the error asked for, what tolerances are chosen for: what a few vertices say of all is not exact."""
VIEW_OVER_LIGHT = 2.0
VIEW_RANGE = 0.3, 2.0
PILOTS, MOST_PILOTS = (3, 5), 6
"""Trials of few bins, and of many, after which any error below the one asked for will do; and most trials."""
RESPONSE = 0.75
"""Tolerances change with that power of the error that they are to lead to."""
OUT_OF_REACH = 1.5
"""Times the error asked for, which a pilot must come down to."""
PILOT_VERTICES, PILOT_SHARE = 24, 12
"""Most vertices of the pilot, and of how many vertices it takes one."""
PILOT_CHECKS = 128
NEAR = 0.7, 0.85
"""Of the error asked for, what a pilot of few bins, and of many, comes to at least before it is content."""
MANY = 1 << 18
"""Bins of an object from which on a pilot is a small part of it all."""
LATTICES: tuple[Lattices, ...] = ("own", "both", "shared")
ALIKE = 1.3
"""Times the least evaluations that a way may take to be tried out with checks."""
CHECK_NOISE = 0.7
"""Of each of the two lattices of a check, over the error asked for."""
AGAIN = 0.8, 0.6, 0.4, 0.25, 0.15
"""Of their error, what vertices that are done again may come down to."""


@dataclass(frozen=True)
class Aim:
    """How to bake to an error, as the pilot has it."""

    refinement: Refinement
    correction: Correction
    error: float
    """What the pilot came to: the larger of the object's relative RMSE and its 95th percentile over vertices."""
    seconds: float
    """Of one worker for one vertex."""
    evaluations: int
    """That the pilot took."""
    evaluations_per_vertex: float
    """Of a pass, checks apart."""
    again: NDArray[np.bool_] | None = None
    """Vertices [V] to be done; the others stay as the pass before left them. None: all."""


@dataclass(frozen=True)
class Pass:
    """All vertices baked once, or those that there was time for."""

    tally: Tally
    correction: Correction
    total: float
    percentile_95: float
    whole: bool

    @property
    def worst(self) -> float:
        """What is held against the error asked for."""
        return _worst(self.total, self.percentile_95)


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

    def tried(self, how: Refinement) -> Iterator[tuple[Index, Refined, float]]:
        """The pilot's vertices, some at a time, what came of them, and the seconds that they took."""
        # Small pieces, so that it does not take long to stop one that takes many directions.
        most = max(1, min(self.site.block_vertices, FEWEST_AT_ONCE // self.site.bins))
        cut = pieces(_pilot_vertices(self.site), most, self.crew)
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
    refinement = refinement.for_views(error, VIEW_RANGE[1] * VIEW_OVER_LIGHT * error)
    ways = [replace(refinement, lattices=which) for which in LATTICES]
    costs = [_untold(pilot, way, error) for way in ways]
    # What checks make of it may reorder ways that cost about the same; trying all of them out pays on large objects.
    near = ALIKE if pilot.site.many >= MANY else 1.0
    tried = [way for way, cost in zip(ways, costs, strict=True) if cost <= near * min(costs)]
    aims = [_calibrated(pilot, way, error) for way in tried]
    best = min(aims, key=lambda aim: aim.evaluations_per_vertex * max(aim.error / error, 1.0) ** COST)
    return replace(best, evaluations=sum(costs) + sum(aim.evaluations for aim in aims))


def _untold(pilot: Pilot, refinement: Refinement, error: float) -> int:
    """Evaluations at the pilot's vertices, without checks."""
    checks = checked_bins(pilot.site.seed, pilot.site.bins, 0.0)
    how = replace(coarse(refinement, error).refinement, checks=checks)
    return sum(refined.evaluations for _some, refined, _seconds in pilot.tried(how))


def _timed_block(site: Site, how: Refinement, vertices: Index) -> tuple[Refined, float]:
    began = time.monotonic()
    return refined_block(site, how, vertices)[0], time.monotonic() - began


def _pilot_vertices(site: Site) -> Index:
    count = int(np.clip(len(site.vertices) // PILOT_SHARE, 1, PILOT_VERTICES))
    return site.vertices[np.sort(drawn(site.seed, len(site.vertices), count))]


def _calibrated(pilot: Pilot, refinement: Refinement, error: float) -> Aim:
    """Tolerances that lead to the error at a few vertices."""
    site = pilot.site
    chosen = _pilot_vertices(site)
    share = max(PILOT_CHECKS / (len(chosen) * site.bins), FEWEST_CHECKS / site.many)
    checks = checked_bins(site.seed + 1, site.bins, min(share, 1.0))
    noise, pool_noise, view, tightness = refinement.noise, refinement.pool_noise, 1.0, 1.0
    begin, most, large = refinement.begin_for(error), len(refinement.lattice.sizes), int(site.many >= MANY)
    spent, correction, reached, seconds, per_vertex, attempt = 0, Correction(), 0.0, 0.0, 0.0, 0
    while attempt < MOST_PILOTS:
        if max(correction.shared, correction.alone) > MISSED and begin < most:
            # Most bins do not see what some do: what they say of their error is worth nothing.
            begin, attempt = min(begin + 2, most), 0
        elif attempt:
            # The noise of differences and the error of prediction as they were seen, and then what is tolerated.
            noise = replace(noise, of_differences=noise.of_differences * correction.shared)
            pool_noise = replace(pool_noise, gain=pool_noise.gain / np.sqrt(correction.alone))
            view = float(np.clip(view / np.sqrt(correction.foretold), *VIEW_RANGE))
            tightness *= float(np.clip((AIM * error / reached) ** RESPONSE, 0.5, 1.6)) if attempt > 1 else 1.0
        light = tightness * error
        bound = view * VIEW_OVER_LIGHT * light
        trial = replace(refinement, noise=noise, light=light, view=bound, checked=CHECK_NOISE * error, begin=begin)
        tally, seconds = Tally(len(site.mesh.positions)), 0.0
        for some, refined, took in pilot.tried(replace(trial, checks=checks)):
            tally.add(some, refined)
            seconds += took / len(chosen)
        spent += tally.evaluations
        per_vertex = (tally.evaluations - tally.check_evaluations) / len(chosen)
        correction = tally.correction(Correction())
        reached = _worst(*tally.relative(correction))
        attempt += 1
        if reached <= 0.0 or NEAR[large] * error <= reached <= error or (reached < error and attempt >= PILOTS[large]):
            break
    if reached > OUT_OF_REACH * error:
        raise out_of_reach(error, refinement.lattice.sizes[-1], reached)
    return Aim(trial, correction, reached, seconds, spent, per_vertex)


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
        0,
        0.0,
    )


def tighter(aim: Aim, done: Pass, error: float) -> Aim:
    """What to do after a pass that left more than the error asked for: the worst vertices again, as many of them and to
    as small an error of theirs as costs least.
    """
    goal = AIM * error
    trials = [_worst_again(done, goal, factor) for factor in AGAIN] + [_all_again(done, goal)]
    again, factor, left = min(trials, key=lambda trial: (trial[2] > goal, trial[0].sum() * trial[1] ** -COST))
    refinement = replace(aim.refinement, light=factor * aim.refinement.light, view=factor * aim.refinement.view)
    return replace(aim, refinement=refinement, correction=done.correction, error=left, again=again)


def _worst_again(done: Pass, goal: float, factor: float) -> tuple[NDArray[np.bool_], float, float]:
    """The fewest vertices [V], to within a hundredth, that lead to that error where theirs become `factor` times what
    they are; the factor, and the error.
    """
    order = done.tally.worst_first(done.correction)
    smaller, left = np.ones(len(done.tally.done)), done.worst
    for many in np.unique(np.linspace(1, max(1, len(order)), 100).astype(np.int64)):
        smaller[order[:many]] = factor
        left = _worst(*done.tally.relative(done.correction, smaller))
        if left <= goal:
            break
    return smaller < 1.0, factor, left


def _all_again(done: Pass, goal: float) -> tuple[NDArray[np.bool_], float, float]:
    return np.ones(len(done.tally.done), bool), goal / done.worst, goal


class Shelf(Protocol):
    """Where the blocks of a pass lie: each with the number of its bins that were bent to the horizon."""

    def keep(self, first: int, refined: Refined, bent: int) -> None:
        """Takes the block that begins with the baked vertex number `first`."""

    def kept(self, first: int) -> tuple[Refined, int] | None:
        """Gives a block of this pass back."""

    def before(self, first: int) -> tuple[Refined, int]:
        """A block as the pass before left it."""


def one_pass(
    site: Site,
    aim: Aim,
    crew: Crew,
    shelf: Shelf,
    stop: Callable[[], bool],
    progress: Callable[[int, Tally], None],
) -> Pass:
    """Bakes all vertices to the aim's tolerances, or those that it names, block by block.

    Ends early, not whole, once `stop` says so.
    """
    tally, done = Tally(len(site.mesh.positions)), 0

    def block(first: int) -> tuple[int, Refined]:
        kept = shelf.kept(first)
        if kept is None:
            kept = _one_block(site, aim, crew, shelf, first)
            shelf.keep(first, *kept)
        return first, kept[0]

    blocks: Iterator[tuple[int, Refined]] = crew.in_order(block, site.blocks)
    try:
        while not stop():
            following = next(blocks, None)
            if following is None:
                break
            first, refined = following
            tally.add(site.block(first), refined)
            done += len(refined.deviation)
            progress(done, tally)
    except KeyboardInterrupt:
        pass
    finally:
        blocks.close()  # type: ignore[attr-defined]
    correction = tally.correction(aim.correction)
    return Pass(tally, correction, *tally.relative(correction), done == len(site.vertices))


def _one_block(site: Site, aim: Aim, crew: Crew, shelf: Shelf, first: int) -> tuple[Refined, int]:
    vertices, shared = site.block(first), (site, aim.refinement)
    if aim.again is None:
        return crew.do(refined_block, shared, vertices)
    before, bent = shelf.before(first)
    rows = np.flatnonzero(aim.again[vertices])
    if not len(rows):
        return before.for_nothing(), bent
    return before.with_rows(rows, crew.do(refined_block, shared, vertices[rows])[0]), bent


def refined_block(site: Site, refinement: Refinement, vertices: Index) -> tuple[Refined, int]:
    """A block, and how many of its bins were bent to the horizon."""
    views = [site.views(int(vertex), int(vertex) + 1) for vertex in vertices]
    outgoing = np.concatenate([directions for directions, _bent in views])
    refined = refine(site.transport, refinement, vertices, site.mesh.positions[vertices], outgoing)
    return refined, sum(bent for _directions, bent in views)


def _worst(total: float, percentile_95: float) -> float:
    """The larger of the two figures of an error."""
    return max(total, percentile_95)
