"""Error against run time for every way to bake: uniform Monte Carlo, Sobol, a lattice, adaptive, and path traced."""

import itertools
import time
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from bakers.adaptive.calibration import Tally
from bakers.adaptive.evaluation_cache import NOTHING
from bakers.baker import Task, bake_block
from bakers.path_traced import Walks
from formats.errors import QueryError
from prt_bake.baking.adaptive.pilot import Site, first_refinement
from prt_bake.baking.adaptive.tolerances import CHECK_NOISE, Aim, Pilot, aimed, refined_block
from prt_bake.baking.job.lattices import checked_bins
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
AIMED = 0.02
"""Error that the pilot is for; tolerances for others are in proportion."""
CHECKED = 0.02
GROWTH = 8.0
"""How much longer the next step of a ladder may take than the last one."""
APART = 1.3
"""Times the shortest, that the longest of the times must be that a slope is fitted to."""


@dataclass(frozen=True)
class Row:
    """One bake of a way, a view bin's share of it."""

    way: str
    evaluations: float
    seconds: float
    error: float
    """Against the truth; for walks their own standard error."""
    told: float
    """What the bake itself says of its error."""

    @property
    def efficiency(self) -> float:
        """1 / (variance · time)"""
        return 1.0 / max(self.error**2 * self.seconds, 1e-300)


def by_samples(transport: Any, bins: Bins, kind: str, truth: Array | None, seconds: float, seed: int) -> list[Row]:
    """Rows of one kind of directions, or of walks where there is no truth, ever more of them for so many seconds, two
    at least.
    """
    rows: list[Row] = []
    ends = time.monotonic() + seconds
    for samples in WALKS if truth is None else LADDERS[kind]:
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
        wide = stated[..., None, None] * np.ones(found.shape[2:])
        signal = found if truth is None else truth
        told = relative(wide, signal)
        if truth is None:
            told = float(told / np.sqrt(max(1.0 - told**2, 0.5)))
        each = task.sampling.paths if isinstance(task.sampling, Walks) else samples
        error = told if truth is None else relative(found - truth, truth)
        rows.append(Row(NAMES["walks" if truth is None else kind], each, spent / bins.count, error, told))
    return rows


def _next(rows: list[Row], bins: Bins) -> float:
    """Seconds that the next step is likely to take."""
    ratio = rows[-1].seconds / rows[-2].seconds if len(rows) > 1 else 4.0
    return float(np.clip(ratio, 1.0, GROWTH)) * rows[-1].seconds * bins.count


def _task(transport: Any, bins: Bins, kind: str, samples: int, seed: int) -> Task | None:
    """The rows of `bins` as vertices 0 … n − 1; None where so few samples do not do."""
    try:
        resolved = resolve_sampling(transport, bins.degree, bins.bins.shape[1], bins.sectors, kind, samples, seed)
    except QueryError:
        return None
    if resolved.samples != samples:
        return None
    positions = bins.mesh.positions[bins.vertices]
    width = bins.bins.shape[1]
    return Task(
        transport, positions, lambda first, last: (bins.outgoing[first:last], 0), width, bins.sectors, resolved.sampling
    )


def adaptively(transport: Any, bins: Bins, truth: Array, seconds: float, seed: int) -> list[Row]:
    """Rows of bakes to ever smaller errors; all view bins of the vertices are baked, the pilot is not counted."""
    mesh = bins.mesh
    site = Site(
        transport,
        mesh,
        np.arange(len(mesh.positions)),
        views_of(mesh, bins.rings, bins.sectors)[1],
        sphere.view_bins(bins.rings, bins.sectors),
        bins.degree,
        seed,
    )
    refinement, _spent = first_refinement(site)
    refinement = replace(refinement, checks=checked_bins(seed, site.bins, CHECKED))
    rows: list[Row] = []
    try:
        aim = aimed(Pilot(site), refinement, AIMED)
    except QueryError:
        return rows
    ends = time.monotonic() + seconds
    for error in ERRORS:
        late = len(rows) > 1 and time.monotonic() + 3.0 * _all_bins(site, bins) * rows[-1].seconds > ends
        if late or (rows and rows[-1].error < GOOD_ENOUGH):
            break
        rows.append(_refined_to(site, _scaled(aim, error), bins, truth))
    return rows


def _all_bins(site: Site, bins: Bins) -> int:
    return site.bins * len(bins.vertices)


def _scaled(aim: Aim, error: float) -> Aim:
    """The same tolerances for another error."""
    by = error / AIMED
    how = replace(
        aim.refinement,
        light=by * aim.refinement.light,
        view=by * aim.refinement.view,
        checked=CHECK_NOISE * error,
        begin=aim.refinement.begin_for(error),
        answers=NOTHING,
    )
    return replace(aim, refinement=how, error=error)


def _refined_to(site: Site, aim: Aim, bins: Bins, truth: Array) -> Row:
    began, tally, found = time.monotonic(), Tally(len(site.mesh.positions)), []
    for first in range(0, len(bins.vertices), site.block_vertices):
        some = bins.vertices[first : first + site.block_vertices]
        refined, _bent = refined_block(site, aim.refinement, some)
        tally.add(some, refined)
        own = bins.bins[first : first + site.block_vertices]
        found.append(np.take_along_axis(refined.coefficients, own[:, :, None, None], axis=1))
    spent, count = time.monotonic() - began, _all_bins(site, bins)
    told = tally.relative(tally.correction(aim.correction))[0]
    error = relative(np.concatenate(found) - truth, truth)
    return Row(NAMES["adaptive"], tally.evaluations / count, spent / count, error, told)


def slope(rows: list[Row]) -> tuple[float, float]:
    """Of log error over log time, fitted to all rows but that of the fewest samples; and the log error at 1 s.

    NaN where the times are too much alike for a slope to say anything.
    """
    used = rows[1:] if len(rows) > 2 else rows
    times = [row.seconds for row in used]
    if len(used) < 2 or max(times) < APART * min(times):
        return float("nan"), float("nan")
    logs = np.log([[row.seconds, max(row.error, 1e-12)] for row in used])
    return cast(tuple[float, float], tuple(np.polyfit(logs[:, 0], logs[:, 1], 1).tolist()))


def seconds_for(rows: list[Row], error: float) -> tuple[float, bool]:
    """Seconds a bin that an error takes: between two rows, or carried on by the fitted law, and then True."""
    falling = sorted(rows, key=lambda row: row.seconds)
    for before, after in itertools.pairwise(falling):
        if before.error >= error >= after.error and before.error > after.error:
            share = np.log(before.error / error) / np.log(before.error / after.error)
            return float(before.seconds * (after.seconds / before.seconds) ** share), False
    steepness, at_one = slope(rows)
    return (float(np.exp((np.log(error) - at_one) / steepness)), True) if steepness < 0.0 else (float("nan"), True)
