"""Passes over an object, coarse to fine, until its error is as small as was asked for, and an asset after each."""

import math
import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bakers.adaptive.calibration import Tally
from bakers.adaptive.records import HELD, OF_VERTICES, WAYS, Checks, Refined, Refinement
from bakers.baker import Block
from formats.asset import Asset
from formats.errors import QueryError
from prt_bake.baking.adaptive.passes import Pass, one_pass, tighter
from prt_bake.baking.adaptive.pilot import MANY, Site, first_refinement, refuse_out_of_reach, vertices_at_once
from prt_bake.baking.adaptive.tolerances import LATTICES, Aim, Pilot, Stopped, aimed, coarse
from prt_bake.baking.job.forecast import COST, Forecast, Standing, power_of_error
from prt_bake.baking.job.work import Work
from prt_bake.baking.output.checkpoint import Store
from prt_bake.baking.output.pruned_sink import pared_sink

COARSE = 0.3
"""Error that the first pass over an object of many bins is made for: there is an asset soon."""
WORTH_A_PASS = 0.25
"""Of that, the error asked for, from which on down there is such a pass."""
PASSES = 4
FINER, FINEST, STEP = 1.25, 16.0, 2.5
"""Times smaller, that the error of a pass must at least and may at most be than that of the one before, in a bake that
has a time to run; and what it is to be in one that runs until it is stopped.
"""
PILOT_UNASKED = 5.0
"""Seconds from which on a pilot is stopped in the middle: a short one is not asked about, as no block is."""
NEARBY = WAYS.index("nearby")
EVALUATED = "evaluated-"
"""Before the names of blocks of vertices that others are foretold from."""
NOTHING_DONE = "the bake was stopped before its first vertex was done; nothing was written"
TIME_TO_USE = 0.75
"""Of the time left, what a pass may be foretold to take."""


class Run:
    """A bake under way: where its blocks go, what it is to come to and by when, and what it has come to so far."""

    def __init__(self, work: Work, store: Store, error: float | None, deadline: float) -> None:
        needs = work.needs
        self.work, self.store, self.deadline = work, store, deadline
        self.error = None if error is None else needs.left_for_projection(error)
        known = [arrays for name in store.names("aim-") if (arrays := store.read(name)) is not None]
        at_once = vertices_at_once(len(needs.vertices), len(needs.local), work.crew.workers)
        if known:
            at_once = int(known[0]["at_once"])
        grid = (work.head.rings, work.head.sectors) if needs.views == "all" else None
        self.site = Site(
            work.transport,
            work.mesh,
            needs.vertices,
            needs.outgoing,
            needs.local,
            needs.degree,
            work.seed,
            grid,
            at_once,
        )  # fmt: skip
        self.pilot = Pilot(self.site, work.crew, lambda: work.seconds > PILOT_UNASKED and self.stopped)
        self.number = self.passes = 0
        self.asset: Asset | None = None
        self.rows: list[tuple[float, float, float]] = []
        self._told: Standing | None = None

    def tell(self, done: int, standing: Standing) -> None:
        """That so many vertices of a pass are done."""
        self._told = standing
        if self.work.progress is not None:
            self.work.progress(done, len(self.site.vertices), standing)

    def tell_of_pilot(self) -> None:
        """That the way to the error is sought, which takes a while, after what was told last."""
        if self._told is not None:
            _seconds, evaluations, error = self._told
            row = self.work.seconds, evaluations, error
            self.tell(len(self.site.vertices), Standing(row, self._told.left, "pilot after pass 1"))

    @property
    def left(self) -> float:
        """Seconds until the bake must end."""
        return self.deadline - time.monotonic()

    @property
    def stopped(self) -> bool:
        """Whether it is to end."""
        return self.left <= 0.0 or self.work.stopped


def bake_to_error(run: Run) -> Asset:
    """Bakes in passes until both figures of the error are at most `run.error`, or the time is up, or it is stopped.

    The asset of the last whole pass is what comes back; where there is none, the part that was done. Raises QueryError
    where nothing was done, where nothing is finite, or where the pilot says that the error is out of reach.
    """
    refinement, looked = first_refinement(run.site, run.work.crew)
    run.work.evaluations += looked
    if run.error is not None and not math.isfinite(run.deadline):
        run.work.evaluations += refuse_out_of_reach(run.site, refinement, run.error)
        large = coarse_first(run.site, run.error)
        if large and not run.store.names("01-") and _pass(run, coarse(refinement, COARSE)) is None:
            return _ended(run)
        run.tell_of_pilot()
        try:
            aim = aimed(run.pilot, refinement, run.error)
        except Stopped:
            return _ended(run, unfinished=True)
        run.work.evaluations += aim.spent.evaluations
        # The numbers of passes to the error must not depend on whether there was a coarse one.
        run.number = 1
        for _again in range(PASSES):
            done = _pass(run, aim)
            if done is None:
                return _ended(run, unfinished=True)
            if done.worst <= run.error:
                break
            aim = tighter(aim, done, run.error)
        return _ended(run)
    began = time.monotonic()
    done = _pass(run, coarse(refinement, max(COARSE, run.error or 0.0)))
    while done is not None and not (run.error is not None and done.worst <= run.error):
        following = _next_aim(run, refinement, done, time.monotonic() - began)
        if following is None:
            break
        began = time.monotonic()
        done = _pass(run, following)
    return _ended(run)


def coarse_first(site: Site, error: float) -> bool:
    """Whether there is a coarse pass before the pilot of a bake to that error."""
    return site.many >= MANY and error < WORTH_A_PASS * COARSE


def _next_aim(run: Run, refinement: Refinement, before: Pass, seconds: float) -> Aim | None:
    """How to get to the smallest error that there is time left for, after a pass that took so many seconds; None where
    there is not enough to make it worth while.
    """
    reached, vertices = before.worst, len(run.site.vertices)
    goal, least = reached * (seconds / max(TIME_TO_USE * run.left, 1e-9)) ** (1.0 / COST), run.error or 0.0
    for _try in range(PASSES):
        goal = max(goal, reached / (FINEST if math.isfinite(run.left) else STEP), least)
        if run.stopped or goal > reached / FINER:
            return None
        try:
            run.work.evaluations += refuse_out_of_reach(run.site, refinement, goal)
            aim = aimed(run.pilot, refinement, goal)
        except (QueryError, Stopped):
            return None
        run.work.evaluations += aim.spent.evaluations
        # A pilot's blocks are small, and slower than those of a pass.
        by_pilot = aim.seconds * vertices / max(1, run.work.crew.workers)
        by_pass = aim.evaluations_per_vertex * vertices * seconds / max(1, before.tally.evaluations)
        over = min(by_pilot, by_pass) / max(TIME_TO_USE * run.left, 1e-9)
        if over <= 1.0:
            return aim
        goal *= over ** (1.0 / COST)
    return None


@dataclass(frozen=True)
class _Shelf:
    """The blocks of pass `number` in the store."""

    store: Store
    number: int

    def name(self, first: int | str) -> str:
        return f"{self.number:02d}-{first}"

    def keep(self, first: int, refined: Refined, bent: int) -> None:
        self.store.write(self.name(first), as_arrays(refined, bent))

    def kept(self, first: int) -> tuple[Refined, int] | None:
        arrays = self.store.read(self.name(first))
        return None if arrays is None else (_as_refined(arrays), int(arrays["bent"]))

    def before(self, first: int) -> tuple[Refined, int]:
        found = _Shelf(self.store, self.number - 1).kept(first)
        assert found is not None
        return found

    def keep_evaluated(self, first: int, refined: Refined, bent: int) -> None:
        self.store.write(EVALUATED + self.name(first), as_arrays(refined, bent))

    def evaluated(self, first: int) -> tuple[Refined, int] | None:
        arrays = self.store.read(EVALUATED + self.name(first))
        return None if arrays is None else (_as_refined(arrays), int(arrays["bent"]))

    def begun(self, kind: str) -> list[int]:
        """Where the blocks begin that are there already, of all vertices or of those that are evaluated first."""
        before = kind + self.name("")
        return [int(name.removeprefix(before)) for name in self.store.names(before)]

    def begin(self, aim: Aim, at_once: int) -> None:
        """Drops what an earlier run has kept of a pass to other tolerances: a bake for minutes is never the same."""
        how, name = aim.refinement, f"aim-{self.number:02d}"
        lattices = LATTICES.index(how.lattices)
        near = aim.foretelling
        cells = [] if near is None else [near.spacing, float(near.bins)]
        tolerances = np.array(
            [how.light, how.view, how.checked, how.floor, how.begin, how.always, lattices, *cells], np.float64
        )
        known = self.store.read(name)
        if known is not None and np.array_equal(known["tolerances"], tolerances):
            return
        self.store.forget(f"{self.number:02d}-")
        self.store.forget(EVALUATED + self.name(""))
        self.store.forget(f"done-{self.number:02d}")
        self.store.write(name, {"tolerances": tolerances, "at_once": np.asarray(at_once)})

    def forget_before(self) -> None:
        self.store.forget(f"{self.number - 1:02d}-")


def _pass(run: Run, aim: Aim) -> Pass | None:
    """One pass and its asset; None where it was stopped before its end, and an asset then only if it is the first."""
    shelf, vertices = _Shelf(run.store, run.number), len(run.site.vertices)
    run.number, run.passes = run.number + 1, run.passes + 1
    shelf.begin(aim, run.site.block_vertices)

    forecast, stage = _forecast(run, aim, shelf), f"pass {run.passes}"

    def show(done: int, tally: Tally) -> None:
        estimate = tally.relative(aim.correction)[0] if done == vertices else aim.error
        spent = run.work.seconds, float(run.work.evaluations + tally.asked), estimate
        run.tell(done, Standing(spent, forecast.left(done), stage))

    done = _whole_before(run, aim, shelf)
    if done is None:
        done = one_pass(run.site, aim, run.work.crew, shelf, lambda: run.stopped, show)
        if done.whole:
            run.store.write(_summary(shelf), done.tally.as_arrays())
            run.store.forget(EVALUATED + shelf.name(""))
    run.work.evaluations += done.tally.asked
    run.rows.append((run.work.seconds, float(run.work.evaluations), done.total))
    if not done.tally.done.any():
        if run.asset is None:
            if not run.store.names(f"{shelf.number:02d}-") + run.store.names(EVALUATED):
                run.store.remove()
            raise QueryError(NOTHING_DONE)
        return None
    if done.tally.invalid[done.tally.done].all():
        raise QueryError(
            f"the transport answered values that are not finite at every one of {int(done.tally.done.sum())} vertices"
        )
    if shelf.kept(0) is not None and (done.whole or run.asset is None):
        _write(run, shelf, aim, done)
    if done.whole and shelf.number:
        shelf.forget_before()
    return done if done.whole else None


def _forecast(run: Run, aim: Aim, shelf: _Shelf) -> Forecast:
    """How long this pass takes, and those that lead from it to the error asked for: the slope between them is measured
    where there were two.
    """
    site = run.site
    vertices, step = len(site.vertices), site.block_vertices
    work = np.ones(vertices) if aim.again is None else aim.again[site.vertices].astype(np.float64)
    ahead = 0.0 if aim.foretelling is None else aim.foretelling.ahead
    for first in shelf.begun(""):
        begin, end = (round(vertices * ahead + (1.0 - ahead) * at) for at in (first, min(first + step, vertices)))
        work[begin:end] = 0.0
    for first in shelf.begun("") + shelf.begun(EVALUATED):
        work[round(ahead * first) : round(ahead * min(first + step, vertices))] = 0.0
    foretold = aim.seconds * vertices / max(1, run.work.crew.workers) if aim.seconds else None
    if run.error is None:
        after = math.inf
    elif aim.error <= FINER * run.error:
        after = 0.0
    else:
        after = (aim.error / run.error) ** power_of_error(run.rows)
    return Forecast(work, foretold, after, run.deadline)


def _whole_before(run: Run, aim: Aim, shelf: _Shelf) -> Pass | None:
    """What a pass came to that an earlier run has done; its blocks may be gone, if the next pass was done as well."""
    arrays = run.store.read(_summary(shelf))
    if arrays is None:
        return None
    tally = Tally.of_arrays(arrays)
    correction = tally.correction(aim.correction)
    return Pass(tally, correction, *tally.relative(correction), True)


def _summary(shelf: _Shelf) -> str:
    return f"done-{shelf.number:02d}"


def _write(run: Run, shelf: _Shelf, aim: Aim, done: Pass) -> None:
    """The asset of a pass, its standard errors corrected by the checks."""
    bent, foretold, histogram = 0, 0, dict[int, int]()
    site = run.site
    with pared_sink(run.work.out, run.work.head, run.work.storage, run.work.needs) as sink:
        for first in site.blocks:
            kept, vertices = shelf.kept(first), site.block(first)
            if kept is None or not done.tally.done[vertices[0]]:
                break
            refined, bent = kept[0], bent + kept[1]
            foretold += int((refined.way == NEARBY).all(axis=1).sum())
            valid = refined.valid
            for size, many in zip(*np.unique(refined.directions, return_counts=True), strict=True):
                histogram[int(size)] = histogram.get(int(size), 0) + int(many)
            deviation = done.correction.standard_error(refined.deviation, refined.way)
            coefficients = np.where(valid[:, None, None, None], refined.coefficients, np.float32(0.0))
            standard_error = np.where(valid[:, None], deviation, 0.0).astype(np.float32)
            for rows in np.split(np.arange(len(vertices)), np.flatnonzero(np.diff(vertices) > 1) + 1):
                parts = coefficients[rows], standard_error[rows], valid[rows]
                shape = refined.shape.of(rows)
                block = Block(int(vertices[rows[0]]), *parts, 0, together=refined.together[rows], shape=shape)
                sink.write(replace(block, bound=done.correction.bound))
        invalid = np.flatnonzero(done.tally.invalid)
        own = {
            "evaluations": run.work.evaluations,
            "seconds": run.work.seconds,
            "estimated_relative_rmse": {"total": done.total, "percentile_95_over_vertices": done.percentile_95},
            "bins_bent_to_the_horizon": bent,
            "vertices_not_finite": {"count": len(invalid), "first": invalid[:16].tolist()},
            "vertices_baked": int(done.tally.done.sum()),
            "refinement": {
                "passes": run.passes,
                "bins_by_directions": {str(size): histogram[size] for size in sorted(histogram)},
                "bins_foretold": 1.0 - done.tally.evaluated_bins / max(1, done.tally.bins),
                "vertices_foretold": foretold,
                "bins_checked": done.tally.checked,
                "checked_over_stated_variance": {
                    name: float(factor) for name, factor in zip(WAYS, done.correction.by_way, strict=True)
                },
                "bound_factor": done.correction.bound,
                "lattice_gain": {"shared": vars(aim.refinement.noise), "alone": vars(aim.refinement.pool_noise)},
            },
        }
        run.asset = sink.finish(run.work.report | own, np.array(run.rows).reshape(-1, 3), complete=done.whole)


def _ended(run: Run, unfinished: bool = False) -> Asset:
    """The asset of the last whole pass, or the part that was done; `unfinished`: what is kept of a finer pass that was
    stopped stays, for the same bake to go on with.
    """
    if run.asset is None:
        raise QueryError(NOTHING_DONE)
    if run.asset.complete and not unfinished:
        run.store.remove()
    return run.asset


def as_arrays(refined: Refined, bent: int) -> dict[str, NDArray[Any]]:
    """A block as it is kept."""
    checks = {f"checks_{name}": np.asarray(values) for name, values in vars(refined.checks).items()}
    own = {name: np.asarray(values) for name, values in vars(refined).items() if name != "checks"}
    return own | checks | {"bent": np.asarray(bent)}


def _as_refined(arrays: dict[str, NDArray[Any]]) -> Refined:
    checks = {name: arrays[f"checks_{name}"] for name in ("rows", *HELD)}
    taken = int(arrays["checks_evaluations"])
    own = {name: arrays[name] for name in OF_VERTICES}
    evaluations, recalled = int(arrays["evaluations"]), int(arrays["recalled"])
    return Refined(**own, evaluations=evaluations, recalled=recalled, checks=Checks(evaluations=taken, **checks))
