"""Which vertices are evaluated where the others are foretold from them: one of each cell, as large as will do."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bakers.adaptive.records import Refinement
from bakers.adaptive.vertex_interpolation import PARENTS, Parents, Surroundings, carried_along, spread_out
from bakers.evaluation import values_at
from prt_bake.baking.adaptive.pilot import MANY, Site
from prt_bake.baking.job.lattices import drawn
from prt_bake.mathematics import sphere
from prt_bake.mathematics.random import hashed

Array = NDArray[np.float64]
Index = NDArray[np.int64]

FEWEST_VERTICES, FEWEST_SECTORS = 1500, 32
"""Fewer sectors tell too little of what is seen at azimuths between them, where frames are turned."""
SPACINGS = 2.0, 3.0, 4.0, 6.0, 8.0
"""Of the distance to the nearest vertex, cells that are tried."""
TRIED, TRIED_BINS, TRIED_DIRECTIONS, TRIED_SHARE = 48, 8, (64, 512), 0.03
"""Vertices, and at how many bins and in how many directions cells of all sizes are tried there: as few as come to that
share of the whole bake.
"""
HELD_BINS, HELD_SHARE = 4, 0.06
"""A foretold vertex is held against the transport at so many bins, or as few as come to that share of what evaluating
it takes.
"""
SWEPT, WORTH = 2.0, 0.5
"""Evaluations of a network a bin that foretelling takes as long as; and of what it takes without, what it must come
down to, at most, for it to be done.
"""
FORETOLD, ALONE, GOOD = 0.8, 0.85, 0.7
"""Of the error asked for, what a foretold vertex may be off by where it is held against the transport. Of this, what
foretelling alone may be off by at a vertex that is thought to pass, and in rms at all that are, at other bins than
those where they are held: the noise of their parents, that comes on top, is a third in variance of what it is at those.
"""
_SPREAD_STREAM, _HELD_STREAM = 41, 42


@dataclass(frozen=True)
class Nearby:
    """Which of the baked vertices are evaluated, and how the others are foretold.

    Attributes:
        spacing: size of the cells of each of which one vertex is evaluated.
        error: relative error that foretold vertices may have.
        bins: at which they are held against the transport.
        each: directions at each of those, about, of both lattices.
        passing: share of them that is thought to pass.
        per_vertex: evaluations that an evaluated vertex is thought to take, checks apart.
        evaluated: [n] of the baked vertices.
        numbers: [C], vertex numbers of the evaluated.
    """

    spacing: float
    error: float
    bins: int
    each: float
    passing: float
    per_vertex: float
    evaluated: NDArray[np.bool_]
    numbers: Index
    surroundings: Surroundings

    @property
    def on_average(self) -> float:
        """Evaluations that a vertex takes, checks apart."""
        other = self.bins * self.each + (1.0 - self.passing) * self.per_vertex
        return self.share * self.per_vertex + (1.0 - self.share) * other

    @property
    def ahead(self) -> float:
        """Share of the work that is done once all vertices are that others are foretold from."""
        return self.share * self.per_vertex / self.on_average

    @property
    def share(self) -> float:
        """Of the vertices, those that are evaluated first."""
        return float(self.evaluated.mean())

    def parents(self, site: Site, vertices: Index) -> Parents:
        """What these vertices are foretold from."""
        normals = site.mesh.normals[vertices]
        return self.surroundings.parents(site.mesh.positions[vertices], normals, sphere.tangent_frame(normals))


def nearby_for(
    site: Site, refinement: Refinement, error: float, per_vertex: float, each: float
) -> tuple[Nearby | None, int]:
    """The cells that come cheapest at that error, by what they do at a few vertices, or None where evaluating all, at
    `per_vertex` evaluations, is hardly dearer; and the evaluations that it took to find out. A bin is held against the
    transport in about `each` directions, half of them for each of two lattices.
    """
    few = len(site.vertices) < FEWEST_VERTICES or site.many < MANY
    if few or site.grid is None or site.grid[1] < FEWEST_SECTORS:
        return None, 0
    bins = int(np.clip(HELD_SHARE * per_vertex / max(each, 1.0), 1, min(HELD_BINS, site.bins)))
    for_one = len(SPACINGS) * TRIED * TRIED_BINS * (PARENTS + 1)
    directions = int(np.clip(TRIED_SHARE * per_vertex * len(site.vertices) / for_one, *TRIED_DIRECTIONS))
    apart, tried, spent, most = _apart(site), list[Nearby](), 0, 1.0
    for spacing in SPACINGS if apart > 0.0 else ():
        nearby = cells(site, spacing * apart, FORETOLD * error, bins, each, per_vertex)
        # Others cannot be cheaper, however good they are.
        if _cost(site, nearby) < WORTH * per_vertex:
            passing, well, taken = _tried(site, refinement, nearby, directions)
            # In larger cells no more are foretold: what seems so is chance.
            most, spent = min(most, passing), spent + taken
            if well:
                tried.append(replace(nearby, passing=most))
    best = min(tried, key=lambda nearby: _cost(site, nearby), default=None)
    return (best if best is not None and _cost(site, best) < WORTH * per_vertex else None), spent


def _cost(site: Site, nearby: Nearby) -> float:
    """What a vertex takes, in evaluations, foretelling itself included."""
    return nearby.on_average + SWEPT * site.bins * (1.0 - nearby.share)


def cells(site: Site, spacing: float, error: float, bins: int, each: float, per_vertex: float) -> Nearby:
    """One vertex evaluated of each cell of that size, and the others thought to pass."""
    some = site.vertices
    positions, normals = site.mesh.positions[some], site.mesh.normals[some]
    evaluated = spread_out(positions, normals, spacing, hashed(_SPREAD_STREAM, site.seed, some))
    parts = positions[evaluated], normals[evaluated]
    around = Surroundings(*parts, sphere.tangent_frame(parts[1]))
    return Nearby(spacing, error, bins, each, 1.0, per_vertex, evaluated, some[evaluated], around)


def _apart(site: Site) -> float:
    """The distance between neighbouring vertices."""
    from scipy.spatial import cKDTree

    positions = site.mesh.positions[site.vertices]
    some = drawn(site.seed + 6, len(positions), 256)
    return float(np.median(cKDTree(positions).query(positions[some], 2)[0][:, 1]))


def _tried(site: Site, refinement: Refinement, nearby: Nearby, directions: int) -> tuple[float, bool, int]:
    """What share of a few vertices passes, were they held against many directions at their bins, less one sigma of
    that; whether those are as good at other bins; and evaluations.
    """
    rest = site.vertices[~nearby.evaluated]
    tried = rest[drawn(site.seed + 7, len(rest), min(TRIED, len(rest)))]
    parents = nearby.parents(site, tried)
    off, spent = _off(site, refinement, nearby, parents, tried, directions)
    passing = (off[:, : nearby.bins] ** 2).mean(axis=1) <= (ALONE * nearby.error) ** 2
    elsewhere = off[passing, nearby.bins :]
    well = elsewhere.size > 0 and bool(np.sqrt((elsewhere**2).mean()) <= GOOD * nearby.error)
    share = float(passing.sum() / len(tried))
    return max(share - float(np.sqrt(share * (1.0 - share) / len(tried))), 0.0), well, spent


def _off(
    site: Site, refinement: Refinement, nearby: Nearby, parents: Parents, vertices: Index, directions: int
) -> tuple[Array, int]:
    """What sound ones of these vertices are off by [m,bins], relative to the vertex, when foretold from what their
    parents answer in the same directions, at bins that are drawn: without noise of the light. And evaluations.
    """
    few, rows = min(directions, len(refinement.lattice.directions)), np.flatnonzero(parents.sound)
    lattice, fit = refinement.lattice.directions[:few], np.linalg.pinv(refinement.lattice.harmonics[:few])
    off, normals, spent = np.zeros((len(rows), TRIED_BINS)), site.mesh.normals, 0
    for place, row in enumerate(rows):
        vertex, used = vertices[row], np.flatnonzero(parents.weights[row] != 0.0)
        outgoing = site.views(int(vertex), int(vertex) + 1)[0][0][held_bins(site, vertex, TRIED_BINS)]
        family = nearby.numbers[parents.of[row][used]]
        carried = carried_along(outgoing[None], normals[vertex][None, None], normals[family][:, None])
        seen = np.concatenate([carried, outgoing[None]]).reshape(-1, 3)
        where = np.repeat(site.mesh.positions[np.append(family, vertex)], TRIED_BINS, axis=0)
        answers = values_at(site.transport, lattice[None], np.zeros(len(seen), np.int64), where, seen)
        a = (fit @ answers.astype(np.float64)).reshape(len(family) + 1, TRIED_BINS, -1)
        with np.errstate(invalid="ignore", over="ignore"):
            left = np.tensordot(parents.weights[row][used], a[:-1], axes=1) - a[-1]
            scale = np.maximum((a**2).mean(), refinement.floor**2)
            off[place] = np.sqrt((left**2).mean(axis=-1) / scale)
        spent += len(seen) * few
    return off, spent


def held_bins(site: Site, vertices: NDArray[np.integer], bins: int) -> Index:
    """The bins [...,bins] at which vertices [...] are held against the transport."""
    keys = hashed(_HELD_STREAM, site.seed, np.asarray(vertices)[..., None], np.arange(bins))
    return np.asarray((keys % np.uint64(site.bins)).astype(np.int64))
