"""Error against run time of every method: uniform Monte Carlo, Sobol, a lattice, adaptive, and path traced."""

import itertools
import time
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from bakers.adaptive.calibration import Tally
from bakers.adaptive.evaluation_cache import NO_CACHE
from bakers.baker import Task, bake_block
from bakers.path_traced import Walks
from formats.errors import QueryError
from prt_bake.baking.adaptive.adaptive_job import AdaptiveJob
from prt_bake.baking.adaptive.noise_pilot import first_refinement
from prt_bake.baking.adaptive.pass_settings import VALIDATION_NOISE, PassSettings, refined_block
from prt_bake.baking.adaptive.tolerances import settings_for_error
from prt_bake.baking.adaptive.trials import Pilot
from prt_bake.baking.job.lattices import validation_bins
from prt_bake.baking.job.sampling import resolve_sampling
from prt_bake.baking.job.views import views_of
from prt_bake.baking.report.bins import Bins, relative
from prt_bake.mathematics import sphere

Array = NDArray[np.float64]

LADDERS = {
    "uniform": tuple(4**power for power in range(2, 9)),
    "sobol": tuple(2**power for power in range(4, 14)),
    "fibonacci": tuple(2**power for power in range(4, 13)),
}
NAMES = {
    "uniform": "uniform Monte Carlo",
    "sobol": "scrambled Sobol",
    "fibonacci": "lattice, least squares",
    "adaptive": "adaptive (--error)",
    "walks": "path traced",
}
ERRORS = (0.1, 0.05, 0.02, 0.01, 0.005, 0.002, 0.001)
WALKS = (16, 64, 256, 1024, 4096, 16384)
GOOD_ENOUGH = 0.001
PILOT_ERROR = 0.02
"""Error that the pilot calibrates for; tolerances for other errors are proportional."""
VALIDATION_SHARE = 0.02
GROWTH = 8.0
"""Largest predicted growth of the time from one row to the next."""
LEAST_TIME_RATIO = 1.3
"""Least ratio of the longest to the shortest time for a slope to be fitted."""


@dataclass(frozen=True)
class Row:
    """One bake with a method; costs are per view bin."""

    method: str
    evaluations: float
    seconds: float
    error: float
    """Compared with the reference; for walks their own standard error."""
    reported: float
    """Error that the bake itself reports."""

    @property
    def efficiency(self) -> float:
        """1 / (variance · time)"""
        return 1.0 / max(self.error**2 * self.seconds, 1e-300)


def fixed_sample_rows(
    transport: Any, bins: Bins, kind: str, reference: Array | None, seconds: float, seed: int
) -> list[Row]:
    """Rows of one kind of directions, or of walks without a reference, with growing sample counts for about `seconds`,
    at least two.
    """
    rows: list[Row] = []
    ends = time.monotonic() + seconds
    for samples in WALKS if reference is None else LADDERS[kind]:
        late = len(rows) > 1 and time.monotonic() + _next(rows, bins) > ends
        if late or (rows and rows[-1].error < GOOD_ENOUGH):
            break
        task = _task(transport, bins, kind, samples, seed)
        if task is None:
            continue
        bake_block(task, 0, 1)
        began = time.monotonic()
        blocks = [bake_block(task, row, row + 1) for row in range(len(bins.vertices))]
        spent = time.monotonic() - began
        found = np.concatenate([block.coefficients for block in blocks]).astype(np.float64)
        stated = np.concatenate([block.standard_error for block in blocks]).astype(np.float64)
        errors = stated[..., None, None] * np.ones(found.shape[2:])
        signal = found if reference is None else reference
        reported = relative(errors, signal)
        if reference is None:
            reported = float(reported / np.sqrt(max(1.0 - reported**2, 0.5)))
        each = task.sampling.paths if isinstance(task.sampling, Walks) else samples
        error = reported if reference is None else relative(found - reference, reference)
        rows.append(Row(NAMES["walks" if reference is None else kind], each, spent / bins.count, error, reported))
    return rows


def _next(rows: list[Row], bins: Bins) -> float:
    """Predicted seconds of the next row."""
    ratio = rows[-1].seconds / rows[-2].seconds if len(rows) > 1 else 4.0
    return float(np.clip(ratio, 1.0, GROWTH)) * rows[-1].seconds * bins.count


def _task(transport: Any, bins: Bins, kind: str, samples: int, seed: int) -> Task | None:
    """A task with the rows of `bins` as vertices 0 … n − 1; None if there are too few samples."""
    try:
        resolved = resolve_sampling(transport, bins.degree, bins.bins.shape[1], bins.sectors, kind, samples, seed)
    except QueryError:
        return None
    if resolved.samples != samples:
        return None
    positions = bins.mesh.positions[bins.vertices]
    width = bins.bins.shape[1]
    return Task(
        transport, positions, lambda vertices: (bins.outgoing[vertices], 0), width, bins.sectors, resolved.sampling
    )


def adaptive_rows(transport: Any, bins: Bins, reference: Array, seconds: float, seed: int) -> list[Row]:
    """Rows of bakes to decreasing errors. All view bins of the vertices are baked; the pilot is not counted."""
    mesh = bins.mesh
    job = AdaptiveJob(
        transport,
        mesh,
        np.arange(len(mesh.positions)),
        views_of(mesh, bins.rings, bins.sectors),
        sphere.view_bins(bins.rings, bins.sectors),
        bins.degree,
        seed,
    )
    refinement, _spent = first_refinement(job)
    refinement = replace(refinement, validation_bins=validation_bins(seed, job.bins, VALIDATION_SHARE))
    rows: list[Row] = []
    try:
        settings = settings_for_error(Pilot(job), refinement, PILOT_ERROR)
    except QueryError:
        return rows
    ends = time.monotonic() + seconds
    for error in ERRORS:
        late = len(rows) > 1 and time.monotonic() + 3.0 * _all_bins(job, bins) * rows[-1].seconds > ends
        if late or (rows and rows[-1].error < GOOD_ENOUGH):
            break
        rows.append(_refined_to(job, _scaled(settings, error), bins, reference))
    return rows


def _all_bins(job: AdaptiveJob, bins: Bins) -> int:
    return job.bins * len(bins.vertices)


def _scaled(settings: PassSettings, error: float) -> PassSettings:
    """The settings scaled to another error."""
    by = error / PILOT_ERROR
    how = replace(
        settings.refinement,
        light_tolerance=by * settings.refinement.light_tolerance,
        view_tolerance=by * settings.refinement.view_tolerance,
        validation_noise=VALIDATION_NOISE * error,
        initial_sizes=settings.refinement.initial_sizes_for(error),
        cache=NO_CACHE,
    )
    return replace(settings, refinement=how, error=error)


def _refined_to(job: AdaptiveJob, settings: PassSettings, bins: Bins, reference: Array) -> Row:
    began, tally, found = time.monotonic(), Tally(len(job.mesh.positions)), []
    for first in range(0, len(bins.vertices), job.block_vertices):
        some = bins.vertices[first : first + job.block_vertices]
        refined, _clamped = refined_block(job, settings.refinement, some)
        tally.add(some, refined)
        own = bins.bins[first : first + job.block_vertices]
        found.append(np.take_along_axis(refined.coefficients, own[:, :, None, None], axis=1))
    spent, count = time.monotonic() - began, _all_bins(job, bins)
    reported = tally.relative(tally.correction(settings.correction))[0]
    error = relative(np.concatenate(found) - reference, reference)
    return Row(NAMES["adaptive"], tally.evaluations / count, spent / count, error, reported)


def slope(rows: list[Row]) -> tuple[float, float]:
    """Slope of log error over log time, fitted to all rows but that of the fewest samples; and the log error at 1 s.

    NaN if the times are too similar for a fit.
    """
    used = rows[1:] if len(rows) > 2 else rows
    times = [row.seconds for row in used]
    if len(used) < 2 or max(times) < LEAST_TIME_RATIO * min(times):
        return float("nan"), float("nan")
    logs = np.log([[row.seconds, max(row.error, 1e-12)] for row in used])
    return cast(tuple[float, float], tuple(np.polyfit(logs[:, 0], logs[:, 1], 1).tolist()))


def seconds_for(rows: list[Row], error: float) -> tuple[float, bool]:
    """Seconds per bin for an error, interpolated between two rows; or extrapolated by the slope, and then True."""
    falling = sorted(rows, key=lambda row: row.seconds)
    for before, after in itertools.pairwise(falling):
        if before.error >= error >= after.error and before.error > after.error:
            share = np.log(before.error / error) / np.log(before.error / after.error)
            return float(before.seconds * (after.seconds / before.seconds) ** share), False
    steepness, at_one = slope(rows)
    return (float(np.exp((np.log(error) - at_one) / steepness)), True) if steepness < 0.0 else (float("nan"), True)
