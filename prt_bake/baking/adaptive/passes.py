"""Bakes to an error that is asked for, or for as long as one likes: a coarse asset first, then finer ones.

A pilot at a few vertices finds out how noisy the fits are and which tolerances lead to the error asked for; then all
vertices are baked to those (`bakers.adaptive.refinement`), a random sample of bins is held against independent
directions, and what these say corrects every stated error (`bakers.adaptive.calibration`). Where the error turns out
larger than was asked for, the tolerances are drawn tighter and it is done again. Each pass starts anew: of what a pass
costs, the passes before it are a small part, and a lattice of the right size has a smaller error than one that was
added to.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from bakers.adaptive.calibration import Correction, Tally
from bakers.adaptive.records import Refined
from bakers.workers import Crew
from prt_bake.baking.adaptive.interpolation import Library, block_from_nearby
from prt_bake.baking.adaptive.parent_vertices import Nearby
from prt_bake.baking.adaptive.pilot import Site
from prt_bake.baking.adaptive.tolerances import AIM, Aim, refined_block, worst_of
from prt_bake.baking.job.forecast import COST

AGAIN = 0.8, 0.6, 0.4, 0.25, 0.15
"""Of their error, what vertices that are done again may come down to."""


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
        return worst_of(self.total, self.percentile_95)


def tighter(aim: Aim, done: Pass, error: float) -> Aim:
    """What to do after a pass that left more than the error asked for: the worst vertices again, as many of them and to
    as small an error of theirs as costs least.
    """
    goal = AIM * error
    factors = AGAIN if aim.refinement.lattices != "learned" else AGAIN[2:]
    trials = [_worst_again(done, goal, factor) for factor in factors] + [_all_again(done, goal)]
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
        left = worst_of(*done.tally.relative(done.correction, smaller))
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

    def keep_evaluated(self, first: int, refined: Refined, bent: int) -> None:
        """Takes the vertices of a block that others are foretold from."""

    def evaluated(self, first: int) -> tuple[Refined, int] | None:
        """Gives them back."""


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
    tally, done, vertices = Tally(len(site.mesh.positions)), 0, len(site.vertices)
    nearby, library, ahead = aim.foretelling, None, 0.0
    if nearby is not None:
        library, ahead = Library(site, nearby, shelf), nearby.ahead * vertices
        for share in _evaluated_first(site, aim, nearby, crew, shelf):
            progress(int(share * ahead), tally)
            if stop():
                return Pass(tally, aim.correction, 0.0, 0.0, whole=False)

    def block(first: int) -> tuple[int, Refined]:
        kept = shelf.kept(first)
        if kept is None:
            if nearby is not None and library is not None:
                kept = block_from_nearby(site, aim.refinement, nearby, crew, shelf, library, first)
            else:
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
            progress(round(ahead + (1.0 - ahead / vertices) * done), tally)
    except KeyboardInterrupt:
        pass
    finally:
        blocks.close()  # type: ignore[attr-defined]
    correction = tally.correction(aim.correction)
    return Pass(tally, correction, *tally.relative(correction), done == len(site.vertices))


def _evaluated_first(site: Site, aim: Aim, nearby: Nearby, crew: Crew, shelf: Shelf) -> Iterator[float]:
    """Bakes the vertices that others are foretold from, and tells the share of them that is done."""

    def block(first: int) -> int:
        vertices = site.block(first)
        chosen = vertices[nearby.evaluated[first : first + len(vertices)]]
        if len(chosen) and shelf.kept(first) is None and shelf.evaluated(first) is None:
            shelf.keep_evaluated(first, *crew.do(refined_block, (site, aim.refinement), chosen))
        return len(chosen)

    done = 0
    for many in crew.in_order(block, site.blocks):
        done += many
        yield done / len(nearby.numbers)


def _one_block(site: Site, aim: Aim, crew: Crew, shelf: Shelf, first: int) -> tuple[Refined, int]:
    vertices, shared = site.block(first), (site, aim.refinement)
    if aim.again is None:
        return crew.do(refined_block, shared, vertices)
    before, bent = shelf.before(first)
    rows = np.flatnonzero(aim.again[vertices])
    if not len(rows):
        return before.for_nothing(), bent
    return before.with_rows(rows, crew.do(refined_block, shared, vertices[rows])[0]), bent
