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
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bakers.in_order import in_order
from bakers.light_noise import LightNoise, fitted_noise
from bakers.refinement import Refined, Refinement, refine, values_at
from bakers.verdict import Correction, Tally
from bakers.view_levels import view_levels
from formats.errors import QueryError
from formats.mesh import Mesh
from prt_bake import sh, sphere
from prt_bake.bake_job import Views
from prt_bake.bake_light import bin_turns, checked_bins, drawn, lattice_for, pair_turns, vertex_turns

Array = NDArray[np.float64]
Index = NDArray[np.int64]

AIM = 0.92
"""Of the error asked for, what tolerances are chosen for: what a few vertices say of all is not exact."""
VIEW_OVER_LIGHT = 2.0
VIEW_RANGE = 0.3, 2.0
PILOTS, MOST_PILOTS = 3, 6
OUT_OF_REACH = 1.5
"""Times the error asked for, which a pilot must come down to."""
PILOT_VERTICES, PILOT_SHARE = 24, 12
"""Most vertices of the pilot, and of how many vertices it takes one."""
PILOT_CHECKS = 128
CHECK_SHARE, FEWEST_CHECKS, MOST_CHECKS = 0.01, 64, 4096
CHECK_NOISE = 1.5
"""Of half of a check's lattice, over the error asked for."""
FEWEST_NOISE_BINS, MOST_NOISE_BINS = 16, 48
PERCENTILE_SLACK = 1.15
DARK = 0.01
"""Of the object's root mean square coefficient: darker vertices are held to the errors of those that have it."""
BINS_AT_ONCE = 1 << 15


@dataclass(frozen=True)
class Site:
    """Where a refined bake is: the transport, ready to be asked, and what it is baked on."""

    transport: Any
    mesh: Mesh
    tangents: Array
    views: Views
    rings: int
    sectors: int
    degree: int
    seed: int

    @property
    def bins(self) -> int:
        """B"""
        return self.rings * self.sectors

    @property
    def block_vertices(self) -> int:
        """Vertices that are baked together."""
        return int(np.clip(BINS_AT_ONCE // self.bins, 1, 64))


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


def first_refinement(site: Site) -> tuple[Refinement, int]:
    """How to refine at all, tolerances apart; and how many evaluations it took to see how noisy fits are."""
    lattice = lattice_for(site.degree)
    noise, floor, spent = _noise(site, lattice)
    levels = view_levels(sphere.view_bins(site.rings, site.sectors))
    share = np.clip(CHECK_SHARE, FEWEST_CHECKS / _many(site), MOST_CHECKS / _many(site))
    return Refinement(
        levels=levels,
        lattice=lattice,
        rotations=vertex_turns(site.seed),
        other_rotations=bin_turns(site.seed),
        rotate=lambda turns: sh.rotations(turns, site.degree),
        noise=noise,
        light=1.0,
        view=1.0,
        checked=1.0,
        floor=DARK * floor,
        checks=checked_bins(site.seed, site.bins, float(share)),
    ), spent


def aimed(site: Site, refinement: Refinement, error: float) -> Aim:
    """Tolerances that lead to the error at a few vertices."""
    vertices = len(site.mesh.positions)
    chosen = np.sort(drawn(site.seed, vertices, int(np.clip(vertices // PILOT_SHARE, 1, PILOT_VERTICES))))
    share = max(PILOT_CHECKS / (len(chosen) * site.bins), FEWEST_CHECKS / _many(site))
    checks = checked_bins(site.seed + 1, site.bins, min(share, 1.0))
    noise, view, tightness = refinement.noise, 1.0, 1.0
    spent, correction, reached, seconds, per_vertex = 0, Correction(), 0.0, 0.0, 0.0
    for attempt in range(MOST_PILOTS):
        if attempt:
            # The noise of differences and the error of prediction as they were seen, and then what is tolerated.
            noise = replace(noise, of_differences=noise.of_differences * correction.evaluated)
            view = float(np.clip(view / np.sqrt(correction.foretold), *VIEW_RANGE))
            tightness *= float(np.clip(AIM * error / reached, 0.5, 1.6)) if attempt > 1 else 1.0
        tolerated = tightness * error
        trial = replace(
            refinement, noise=noise, light=tolerated, view=view * VIEW_OVER_LIGHT * tolerated, checked=CHECK_NOISE * error
        )
        began, tally = time.monotonic(), Tally(vertices)
        for first in range(0, len(chosen), site.block_vertices):
            some = chosen[first : first + site.block_vertices]
            tally.add(some, _refined(site, replace(trial, checks=checks), some)[0])
        seconds = (time.monotonic() - began) / len(chosen)
        spent += tally.evaluations
        per_vertex = (tally.evaluations - tally.check_evaluations) / len(chosen)
        correction = tally.correction(Correction())
        reached = _worst(*tally.relative(correction))
        if reached <= 0.0 or 0.7 * error <= reached <= error or (reached < error and attempt + 1 >= PILOTS):
            break
    if reached > OUT_OF_REACH * error:
        raise QueryError(
            f"error: a relative RMSE of {error:g} is out of reach; up to {refinement.lattice.sizes[-1]:,} directions "
            f"a bin leave {reached:.3g}; ask for less"
        )
    return Aim(trial, correction, reached, seconds, spent, per_vertex)


def coarse(refinement: Refinement, error: float) -> Aim:
    """Tolerances of about that error, without a pilot."""
    return Aim(
        replace(refinement, light=error, view=VIEW_OVER_LIGHT * error, checked=CHECK_NOISE * error),
        Correction(),
        error,
        0.0,
        0,
        0.0,
    )


def tighter(aim: Aim, done: Pass, error: float) -> Aim:
    """What to do after a pass that left more than the error asked for."""
    factor = AIM * error / done.worst
    refinement = replace(aim.refinement, light=factor * aim.refinement.light, view=factor * aim.refinement.view)
    return replace(aim, refinement=refinement, correction=done.correction, error=AIM * error)


def one_pass(
    site: Site,
    aim: Aim,
    workers: int,
    keep: Callable[[int, Refined, int], None],
    kept: Callable[[int], Refined | None],
    stop: Callable[[], bool],
    progress: Callable[[int, Tally], None],
) -> Pass:
    """Bakes all vertices to the aim's tolerances, block by block.

    `keep` (first vertex, block, bins bent to the horizon) takes each block, `kept` gives one of an earlier run back.
    Ends early, not whole, once `stop` says so.
    """
    vertices = len(site.mesh.positions)
    tally, done = Tally(vertices), 0

    def block(first: int) -> tuple[int, Refined]:
        refined = kept(first)
        if refined is None:
            refined, bent = _refined(site, aim.refinement, np.arange(first, min(first + site.block_vertices, vertices)))
            keep(first, refined, bent)
        return first, refined

    blocks: Iterator[tuple[int, Refined]] = in_order(block, range(0, vertices, site.block_vertices), workers)
    try:
        while not stop():
            following = next(blocks, None)
            if following is None:
                break
            first, refined = following
            rows = np.arange(first, first + len(refined.deviation))
            tally.add(rows, refined)
            done += len(rows)
            progress(done, tally)
    except KeyboardInterrupt:
        pass
    finally:
        blocks.close()  # type: ignore[attr-defined]
    correction = tally.correction(aim.correction)
    return Pass(tally, correction, *tally.relative(correction), done == vertices)


def _refined(site: Site, refinement: Refinement, vertices: Index) -> tuple[Refined, int]:
    """A block, and how many of its bins were bent to the horizon."""
    views = [site.views(int(vertex), int(vertex) + 1) for vertex in vertices]
    outgoing = np.concatenate([directions for directions, _bent in views])
    refined = refine(site.transport, refinement, vertices, site.mesh.positions[vertices], outgoing)
    return refined, sum(bent for _directions, bent in views)


def _noise(site: Site, lattice: Any) -> tuple[LightNoise, float, int]:
    """How noisy fits over the lattice are, the root mean square coefficient and the evaluations that these took; from
    bins that are drawn, each with two lattices of each of the first four sizes.
    """
    bins = drawn(
        site.seed + 2,
        _many(site),
        min(int(np.clip(_many(site) // 2048, FEWEST_NOISE_BINS, MOST_NOISE_BINS)), _many(site)),
    )
    vertices, local = np.divmod(bins, site.bins)
    outgoing = np.stack([site.views(int(v), int(v) + 1)[0][0, b] for v, b in zip(vertices, local, strict=True)])
    sizes, positions, spent = lattice.sizes[:4], site.mesh.positions[vertices], 0
    rough, squared, found = [], [], np.zeros(0)
    for size in sizes:
        fits = []
        for which in (0, 1):
            turns = pair_turns(site.seed, size, which, bins)
            incident = lattice.directions[:size] @ turns.transpose(0, 2, 1)
            values = values_at(site.transport, incident, np.arange(len(bins)), positions, outgoing)
            coefficients, left = lattice.fitted(values, lattice.sizes.index(size))
            fits.append((sh.rotations(turns, site.degree) @ coefficients.reshape(len(bins), -1, 3), left))
            spent += len(bins) * size
        found = (fits[0][0] + fits[1][0]) / 2.0
        rough.append((fits[0][1] + fits[1][1]) / 2.0)
        squared.append(((fits[0][0] - fits[1][0]) ** 2).mean(axis=(1, 2)) / 2.0)
    finite = np.isfinite(squared).all(axis=0) & np.isfinite(rough).all(axis=0)
    if not finite.any():
        raise QueryError(f"the transport answered values that are not finite at every one of {len(bins)} bins tried")
    noise = fitted_noise(lattice, sizes, np.array(rough)[:, finite], np.array(squared)[:, finite])
    return noise, float(np.sqrt((found[finite] ** 2).mean())), spent


def _worst(total: float, percentile_95: float) -> float:
    """The larger of the two figures of an error; the percentile is estimated on the safe side, and has its slack."""
    return max(total, percentile_95 / PERCENTILE_SLACK)


def _many(site: Site) -> int:
    return len(site.mesh.positions) * site.bins
