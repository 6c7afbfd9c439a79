"""Some vertices baked as a pass would bake them, to foretell what all of them take.

A pilot tells little of time: its blocks are small, much is done for the first time, and some of it is recalled. Nor are
its vertices many: where a few cost several times as much as the others, two dozen are off by a sixth.
"""

import time
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bakers.adaptive.calibration import Tally
from bakers.adaptive.evaluation_cache import NOTHING
from bakers.adaptive.records import Refined, Refinement
from bakers.workers import Crew
from prt_bake.baking.adaptive.parent_vertices import SWEPT
from prt_bake.baking.adaptive.passes import Pass, tighter
from prt_bake.baking.adaptive.pilot import MANY, Site
from prt_bake.baking.adaptive.tolerances import PILOT_CHECKS, Aim, refined_block
from prt_bake.baking.job.forecast import COST
from prt_bake.baking.job.lattices import drawn

ENOUGH, MOST, LARGEST = 0.06, 0.06, 0.25
"""Blocks are baked until the mean over their vertices is known to within so much, one sigma, or until they are so large
a share of all; and the largest share that the first of them may be.
"""


@dataclass(frozen=True)
class Rehearsal:
    """What some vertices took of a pass."""

    vertices: int
    """How many."""
    seconds: float
    """For one vertex, with all workers at it."""
    evaluations: float
    """For one vertex, checks among them."""
    deviation: float
    """Of the mean over all vertices as these tell it, one sigma, relative."""
    block: Refined
    """One of the blocks."""
    tally: Tally
    """Of them all."""

    def of_passes(self, aim: Aim, site: Site) -> "Rehearsal":
        """The same of a pass to that aim, which foretells vertices from others where that is to be done."""
        near = aim.foretelling
        if near is None:
            return self
        by_network = near.on_average / near.per_vertex
        swept = (1.0 - near.share) * SWEPT * site.bins / near.per_vertex
        return replace(self, seconds=self.seconds * (by_network + swept), evaluations=self.evaluations * by_network)

    def again(self, aim: Aim, error: float, site: Site) -> float:
        """How much of a pass follows it, over the pass itself: none, unless the pilot and these vertices say that it
        leaves more than that error.
        """
        correction = self.tally.correction(aim.correction)
        done = Pass(self.tally, correction, *self.tally.relative(correction), True)
        if aim.nearby is not None or min(done.worst, aim.error) <= 0.0:
            return 0.0
        # Either knows the more of it, the more bins were held against others.
        checks = PILOT_CHECKS[int(site.many >= MANY)], self.tally.checked
        told = float(np.exp(np.average(np.log([aim.error, done.worst]), weights=checks)))
        if told <= error:
            return 0.0
        following = tighter(aim, done, error * done.worst / told)
        assert following.again is not None
        finer = aim.refinement.light / following.refinement.light
        return float(following.again[self.tally.done].mean() * finer**COST)


def rehearsed(site: Site, how: Refinement, crew: Crew) -> Rehearsal:
    """Bakes blocks of vertices that are drawn by the seed, as many at a time as there are workers, and nothing of the
    pilot's recalled.
    """
    how, count = replace(how, answers=NOTHING), len(site.vertices)
    size = max(1, min(site.block_vertices, int(LARGEST * count)))
    order = site.vertices[drawn(site.seed + 6, count, count)]
    seconds, done, blocks, tally = 0.0, 0, list[Refined](), Tally(len(site.mesh.positions))
    while done < count:
        cut = [np.sort(order[first : first + size]) for first in range(done, count, size)][: crew.workers]
        began = time.monotonic()
        found = list(crew.in_order(lambda some: crew.do(refined_block, (site, how), some)[0], cut))
        seconds += time.monotonic() - began
        done, blocks = done + sum(len(some) for some in cut), [*blocks, *found]
        for some, block in zip(cut, found, strict=True):
            tally.add(some, block)
        costs = np.concatenate([block.directions.sum(axis=1, dtype=np.float64) for block in blocks])
        deviation = _deviation(costs, count)
        if done >= MOST * count or deviation <= ENOUGH:
            break
    return Rehearsal(done, seconds / done, tally.evaluations / done, deviation, blocks[-1], tally)


def _deviation(costs: NDArray[np.float64], count: int) -> float:
    """One sigma of the mean of `costs`, which were drawn without repetition from `count`, over that mean."""
    if len(costs) < 2:
        return 1.0
    spread = float(costs.std(ddof=1) / max(costs.mean(), 1e-300))
    return spread * float(np.sqrt((1.0 - len(costs) / count) / len(costs)))
