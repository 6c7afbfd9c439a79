"""Runs the passes of an adaptive bake, coarse to fine, until its error is as small as requested, or the time is up.

An asset is written after each pass.
"""

import math
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from bakers.adaptive.calibration import Correction, Tally
from bakers.adaptive.records import RefinementSettings
from formats.asset import Asset, read_asset
from formats.errors import QueryError, StorageError, warn
from prt_bake.baking.adaptive.adaptive_job import MANY, AdaptiveJob, vertices_at_once
from prt_bake.baking.adaptive.checkpoints import DONE, EVALUATED, PassCheckpoints
from prt_bake.baking.adaptive.noise_pilot import first_refinement, refuse_out_of_reach
from prt_bake.baking.adaptive.pass_asset import write_asset
from prt_bake.baking.adaptive.pass_progress import PassProgress
from prt_bake.baking.adaptive.pass_settings import Pass, PassSettings, uncalibrated
from prt_bake.baking.adaptive.passes import one_pass, tighter
from prt_bake.baking.adaptive.tolerances import settings_for_error
from prt_bake.baking.adaptive.trials import Pilot, PilotStopped
from prt_bake.baking.job.forecast import COST_EXPONENT, BakeStatus, Forecast, error_exponent
from prt_bake.baking.job.provenance import not_finite, nothing_done
from prt_bake.baking.job.work import Work
from prt_bake.baking.output.checkpoint_store import CheckpointStore

COARSE = 0.3
"""Error of a first coarse pass, which gives an asset soon."""
WORTH_A_PASS = 0.25
"""An object of many bins gets a coarse pass if the requested error is below this share of `COARSE`."""
PASSES = 4
FINER, FINEST, STEP = 1.25, 16.0, 2.5
"""Factors between the errors of two passes of a bake with a time limit: least and most, and the factor of a bake that
runs until it is stopped.
"""
UNINTERRUPTED = 5.0
"""Seconds from the start during which a pilot ignores a stop, as a block does."""
LATE = 1.2
"""Predicted time of the first pass over the time left from which the bake warns."""
TIME_TO_USE = 0.75
"""Largest predicted time of a pass over the time left."""


class Run:
    """An adaptive bake in progress."""

    def __init__(self, work: Work, store: CheckpointStore, error: float | None, deadline: float) -> None:
        """`deadline` is by the monotonic clock."""
        pruning = work.pruning
        self.work, self.store, self.deadline = work, store, deadline
        self.error = None if error is None else pruning.left_for_projection(error)
        earlier = [arrays for name in store.names("settings-") if (arrays := store.read(name)) is not None]
        at_once = vertices_at_once(len(pruning.vertices), len(pruning.local), work.workers.count)
        if earlier:
            at_once = int(earlier[0]["block_vertices"])
        self.job = AdaptiveJob(
            transport=work.transport,
            mesh=work.mesh,
            vertices=pruning.vertices,
            views=pruning.outgoing,
            local=pruning.local,
            degree=pruning.degree,
            seed=work.seed,
            grid=(work.head.rings, work.head.sectors) if pruning.views == "all" else None,
            at_once=at_once,
        )
        self.pilot = Pilot(self.job, work.workers, lambda: work.seconds > UNINTERRUPTED and self.stopped)
        self.number = self.passes = 0
        self.asset: Asset | None = None
        self.rows: list[tuple[float, float, float]] = []
        self._last_status: BakeStatus | None = None
        self._is_late = False

    def report(self, done: int, status: BakeStatus) -> None:
        """Reports that `done` vertices of a pass are finished."""
        self._last_status = status
        if self.work.progress is not None:
            self.work.progress(done, len(self.job.vertices), status)

    def warn_if_late(self, forecast: Forecast, done: int) -> None:
        """Warns once if the first pass will not end before the deadline, after `done` of its vertices."""
        seconds, allowed = forecast.of_pass(done), self.deadline - forecast.began
        if self.asset is None and not self._is_late and seconds is not None and seconds > LATE * allowed:
            self._is_late = True
            warn(
                f"the time is too short: the coarsest pass takes about {seconds / 60.0:.2g} minutes, of which "
                f"{max(0.0, allowed) / 60.0:.2g} are left, and what is not baked will be black; give more minutes, "
                "fewer rings and sectors, or a mesh of fewer vertices"
            )

    def report_pilot(self) -> None:
        """Reports that a pilot runs after the first pass, which takes a while."""
        if self._last_status is not None:
            last, (_seconds, evaluations, error) = self._last_status, self._last_status
            row = self.work.seconds, evaluations, error
            self.report(len(self.job.vertices), BakeStatus(row, last.left, "pilot after pass 1", last.figures))

    @property
    def left(self) -> float:
        """Seconds until the deadline."""
        return self.deadline - time.monotonic()

    @property
    def stopped(self) -> bool:
        """Whether the bake must end."""
        return self.left <= 0.0 or self.work.stopped


def bake_to_error(run: Run) -> Asset:
    """Bakes in passes until both error figures are at most `run.error`, the time is up, or the bake is stopped.

    Returns the asset of the last complete pass, or a partial asset if there is none. Raises QueryError if no vertex was
    done or is finite, or if the pilot finds the error out of reach.
    """
    refinement, evaluations = first_refinement(run.job, run.work.workers)
    run.work.evaluations += evaluations
    if run.error is None or math.isfinite(run.deadline):
        return _bake_for_time(run, refinement)
    run.work.evaluations += refuse_out_of_reach(run.job, refinement, run.error)
    coarse = coarse_first(run.job, run.error)
    if coarse and not run.store.names("01-") and _pass(run, uncalibrated(refinement, COARSE)) is None:
        return _finish(run)
    run.report_pilot()
    try:
        settings = settings_for_error(run.pilot, refinement, run.error)
    except PilotStopped:
        return _finish(run, keep_checkpoints=True)
    run.work.evaluations += settings.pilot_cost.evaluations
    # The random numbers of these passes must not depend on whether there was a coarse one.
    run.number = 1
    for _attempt in range(PASSES):
        done = _pass(run, settings)
        if done is None:
            return _finish(run, keep_checkpoints=True)
        if done.worst <= run.error:
            break
        settings = tighter(settings, done, run.error)
    return _finish(run)


def _bake_for_time(run: Run, refinement: RefinementSettings) -> Asset:
    done = _last_complete(run) or _pass(run, uncalibrated(refinement, max(COARSE, run.error or 0.0)))
    while done is not None and not (run.error is not None and done.worst <= run.error):
        following = _next_settings(run, refinement, done)
        if following is None:
            break
        done = _pass(run, following)
    return _finish(run)


def _last_complete(run: Run) -> Pass | None:
    """The last pass that an earlier run for a time has completed, and whose asset is in the file.

    A pass with other settings follows it: those of the time that is left. Its own blocks begin again.
    """
    numbers = [int(name.removeprefix(DONE)) for name in run.store.names(DONE)]
    if not numbers:
        return None
    if run.work.out is None or not Path(run.work.out).is_file():
        run.store.forget("")
        return None
    last = max(numbers)
    done = PassCheckpoints(run.store, last).read_result(Correction())
    if done is None:
        raise StorageError(
            f"checkpoint {DONE}{last:02d}: expected the result of a complete pass, found none that can be read; "
            "bake again without resuming"
        )
    run.asset = read_asset(run.work.out, load=False)
    run.rows = [(float(seconds), float(count), float(error)) for seconds, count, error in run.asset.error_vs_time]
    run.number = run.passes = last + 1
    # The time and the evaluations of the asset are those of all runs.
    run.work.began -= run.rows[-1][0]
    run.work.evaluations += round(run.rows[-1][1])
    return done


def coarse_first(job: AdaptiveJob, error: float) -> bool:
    """Whether a bake to that error starts with a coarse pass, before its pilot."""
    return job.many >= MANY and error < WORTH_A_PASS * COARSE


def _next_settings(run: Run, refinement: RefinementSettings, before: Pass) -> PassSettings | None:
    """Settings for the smallest error that the remaining time allows; None if it is too short for a worthwhile pass."""
    reached, seconds, vertices = before.worst, before.seconds, len(run.job.vertices)
    goal, least = reached * (seconds / max(TIME_TO_USE * run.left, 1e-9)) ** (1.0 / COST_EXPONENT), run.error or 0.0
    for _attempt in range(PASSES):
        goal = max(goal, reached / (FINEST if math.isfinite(run.left) else STEP), least)
        if run.stopped or goal > reached / FINER:
            return None
        try:
            run.work.evaluations += refuse_out_of_reach(run.job, refinement, goal)
            settings = settings_for_error(run.pilot, refinement, goal)
        except (QueryError, PilotStopped):
            return None
        run.work.evaluations += settings.pilot_cost.evaluations
        # The small blocks of a pilot are slower than those of a pass.
        by_pilot = settings.seconds * vertices / max(1, run.work.workers.count)
        by_pass = settings.evaluations_per_vertex * vertices * seconds / max(1, before.tally.evaluations)
        over = min(by_pilot, by_pass) / max(TIME_TO_USE * run.left, 1e-9)
        if over <= 1.0:
            return settings
        goal *= over ** (1.0 / COST_EXPONENT)
    return None


def _pass(run: Run, settings: PassSettings) -> Pass | None:
    """Runs one pass and writes its asset. None if it was stopped; a partial asset is written only in the first pass."""
    checkpoints, vertices = PassCheckpoints(run.store, run.number), len(run.job.vertices)
    run.number, run.passes = run.number + 1, run.passes + 1
    checkpoints.start(settings, run.job.block_vertices)
    forecast, stage = _forecast(run, settings, checkpoints), f"pass {run.passes}"
    progress = PassProgress(forecast, settings.correction, vertices, lambda error: _time_after(run, error))

    def report(done: int, tally: Tally) -> None:
        run.report(done, progress.status(done, tally, run.work, stage))
        run.warn_if_late(forecast, done)

    done = earlier = checkpoints.read_result(settings.correction)
    if done is None:
        began = time.monotonic()
        done = one_pass(run.job, settings, run.work.workers, checkpoints, lambda: run.stopped, report)
        done = replace(done, seconds=time.monotonic() - began)
    run.work.evaluations += done.tally.new_evaluations
    run.rows.append((run.work.seconds, float(run.work.evaluations), done.total))
    if not done.tally.done.any():
        if run.asset is None:
            if not run.store.names(f"{checkpoints.number:02d}-") + run.store.names(EVALUATED):
                run.store.remove()
            raise nothing_done()
        return None
    if done.tally.invalid[done.tally.done].all():
        raise not_finite(run.job.transport, f"{int(done.tally.done.sum())} vertices that were baked")
    if 0 in checkpoints.finished() and (done.complete or run.asset is None):
        run.asset = write_asset(run.work, run.job, checkpoints, settings, done, run.passes, run.rows)
    if not done.complete:
        return None
    if earlier is None:
        # A result states that the asset is in the file.
        checkpoints.write_result(done)
        checkpoints.forget_evaluated()
    if checkpoints.number:
        checkpoints.forget_previous()
    return done


def _forecast(run: Run, settings: PassSettings, checkpoints: PassCheckpoints) -> Forecast:
    """Forecast of this pass and of those that follow it until the requested error."""
    job = run.job
    vertices, step = len(job.vertices), job.block_vertices
    work = np.ones(vertices) if settings.rebake is None else settings.rebake[job.vertices].astype(np.float64)
    ahead = 0.0 if settings.active_interpolation is None else settings.active_interpolation.ahead
    finished = checkpoints.finished()
    for first in finished:
        begin, end = (round(vertices * ahead + (1.0 - ahead) * at) for at in (first, min(first + step, vertices)))
        work[begin:end] = 0.0
    for first in finished + checkpoints.finished_evaluated():
        work[round(ahead * first) : round(ahead * min(first + step, vertices))] = 0.0
    predicted = settings.seconds * vertices / max(1, run.work.workers.count) if settings.seconds else None
    return Forecast(work, predicted, _time_after(run, settings.error), run.deadline)


def _time_after(run: Run, error: float) -> float:
    """Time of the passes that follow one with this error, over the time of that one."""
    if run.error is None:
        return math.inf
    return 0.0 if error <= FINER * run.error else (error / run.error) ** error_exponent(run.rows)


def _finish(run: Run, keep_checkpoints: bool = False) -> Asset:
    """The asset of the last complete pass, or the partial one. `keep_checkpoints`: a finer pass was stopped, which the
    bake can resume.
    """
    if run.asset is None:
        raise nothing_done()
    run.work.finished = run.asset.complete and not keep_checkpoints
    return run.asset
