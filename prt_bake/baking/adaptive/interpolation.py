"""Vertices foretold from those around them, where a mesh is finer than what is seen on it.

One vertex of each cell is evaluated first; the others follow from those (`bakers.adaptive.vertex_interpolation`), each
held against the transport at a few bins. Those that fail are evaluated.
"""

from dataclasses import replace
from threading import Lock
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from bakers.adaptive.records import WAYS, Checks, Refined, Refinement, joined
from bakers.adaptive.refinement import refine
from bakers.adaptive.vertex_interpolation import Parents
from bakers.adaptive.vertex_validation import checked, held_against
from bakers.error_covariance import joined_shapes
from bakers.workers import Crew
from formats.asset.error_covariance import ErrorShape
from prt_bake.baking.adaptive.interpolation_kernel import foretold_from
from prt_bake.baking.adaptive.parent_vertices import Nearby, held_bins
from prt_bake.baking.adaptive.pilot import Site

Array = NDArray[np.float64]
Index = NDArray[np.int64]


class Kept(Protocol):
    """Where the evaluated vertices of each block lie until all that are foretold from them are."""

    def keep_evaluated(self, first: int, refined: Refined, bent: int) -> None:
        """Takes the evaluated vertices of a block."""

    def evaluated(self, first: int) -> tuple[Refined, int] | None:
        """Gives them back."""


class Library:
    """Coefficients of evaluated vertices by their place among them, and how their errors hang together, read block by
    block as they are needed.
    """

    def __init__(self, site: Site, nearby: Nearby, kept: Kept, most_bytes: int = 1 << 28) -> None:
        self._kept, self._lock, self._most = kept, Lock(), most_bytes
        places = np.flatnonzero(nearby.evaluated)
        block = places // site.block_vertices
        self._first = block * site.block_vertices
        self._row = np.arange(len(places)) - np.searchsorted(block, block)
        self._read: dict[int, Refined] = {}

    def of(self, places: Index) -> tuple[NDArray[np.float32], ErrorShape]:
        """Coefficients [G,B,K,3] and shapes [G] of these evaluated vertices."""
        blocks = [(self._block(int(self._first[place])), self._row[place]) for place in places]
        shapes = [block.shape.of(np.array([row])) for block, row in blocks]
        return np.stack([block.coefficients[row] for block, row in blocks]), joined_shapes(shapes)

    def _block(self, first: int) -> Refined:
        with self._lock:
            if first in self._read:
                self._read[first] = self._read.pop(first)
                return self._read[first]
        there = self._kept.evaluated(first)
        assert there is not None
        with self._lock:
            self._read[first] = there[0]
            while sum(each.coefficients.nbytes for each in self._read.values()) > self._most and len(self._read) > 1:
                del self._read[next(iter(self._read))]
            return there[0]


def block_from_nearby(
    site: Site, refinement: Refinement, nearby: Nearby, crew: Crew, kept: Kept, library: Library, first: int
) -> tuple[Refined, int]:
    """A block: its evaluated vertices as they are kept, the others foretold from those around, or evaluated after all;
    and how many of its bins were bent to the horizon.
    """
    vertices = site.block(first)
    here = nearby.evaluated[first : first + len(vertices)]
    parts, bent = list[tuple[Index, Refined]](), 0
    if here.any():
        there = kept.evaluated(first)
        assert there is not None
        parts, bent = [(np.flatnonzero(here), there[0])], there[1]
    rest = np.flatnonzero(~here)
    if len(rest):
        parents = nearby.parents(site, vertices[rest])
        sound = np.flatnonzero(parents.sound)
        wanted = np.unique(parents.of[sound])
        known = library.of(wanted) if len(wanted) else None
        found, more = crew.do(_foretold_block, (site, refinement, nearby), vertices[rest], parents, wanted, known)
        parts.append((rest, found))
        bent += more
    return joined(len(vertices), parts), bent


def _foretold_block(
    site: Site, refinement: Refinement, nearby: Nearby, vertices: Index, parents: Parents, wanted: Index, known: Any
) -> tuple[Refined, int]:
    views = [site.views(int(vertex), int(vertex) + 1) for vertex in vertices]
    outgoing, bent = np.concatenate([view for view, _bent in views]), sum(many for _view, many in views)
    positions = site.mesh.positions[vertices]
    rows, found, told = _all_foretold(site, refinement, nearby, parents, wanted, known[0] if known else None)
    transport, spent, parts = site.transport, 0, list[tuple[Index, Refined]]()
    if len(rows):
        bins = held_bins(site, vertices[rows], nearby.bins)
        off, spent = held_against(transport, refinement, vertices[rows], positions[rows], outgoing[rows], found, bins)
        good = off.mean(axis=1) <= nearby.error**2
        rows, found, told = rows[good], found[good], told[good]
    if len(rows) and known:
        checks = checked(transport, refinement, vertices[rows], positions[rows], outgoing[rows], found, told)
        parts.append((rows, _as_refined(found, told, _shape_of_parents(parents, rows, wanted, known[1]), checks)))
    if len(others := np.setdiff1d(np.arange(len(vertices)), rows)):
        evaluated = refine(transport, refinement, vertices[others], positions[others], outgoing[others])
        parts.append((others, evaluated))
    whole = joined(len(vertices), parts)
    return replace(whole, evaluations=whole.evaluations + spent), bent


def _all_foretold(
    site: Site, refinement: Refinement, nearby: Nearby, parents: Parents, wanted: Index, known: Any
) -> tuple[Index, Array, Array]:
    """Rows [m] of those that can be, by what their fits leave over; coefficients [m,B,K,C] and variances [m,B]."""
    if known is None:
        return np.zeros(0, np.int64), np.zeros((0, site.bins, 0, 3)), np.zeros((0, site.bins))
    assert site.grid is not None
    by_view = np.ascontiguousarray(known).reshape(len(known), *site.grid, -1)
    good, coefficients, variance = list[int](), list[Array](), list[Array]()
    for row in np.flatnonzero(parents.sound):
        places = np.searchsorted(wanted, parents.of[row])
        values, told = foretold_from(by_view, places, parents, int(row))
        scale = max(float((values**2).mean()), refinement.floor**2)
        if told.mean() <= nearby.error**2 * scale:
            good.append(int(row))
            coefficients.append(values.reshape(site.bins, -1, 3))
            variance.append(told)
    if not good:
        return np.zeros(0, np.int64), np.zeros((0, site.bins, 0, 3)), np.zeros((0, site.bins))
    return np.array(good), np.stack(coefficients), np.stack(variance)


def _shape_of_parents(parents: Parents, rows: Index, wanted: Index, known: ErrorShape) -> ErrorShape:
    """What is foretold errs as the vertices do that it was foretold from, on average, and as those beside it."""
    places = [np.searchsorted(wanted, parents.of[row]) for row in rows]
    covariance, channels = (
        np.stack([each[some].mean(axis=0) for some in places]).astype(np.float64)
        for each in (known.covariance, known.channels)
    )
    return ErrorShape(covariance.astype(np.float32), channels.astype(np.float32), np.zeros((len(rows), 2), np.float32))


def _as_refined(found: Array, variance: Array, shape: ErrorShape, checks: Checks) -> Refined:
    directions = np.zeros(variance.shape, np.uint16)
    way = np.full(variance.shape, WAYS.index("nearby"), np.uint8)
    deviation = np.sqrt(variance).astype(np.float32)
    together = np.ones(len(variance), np.float32)
    shapes = shape.covariance, shape.channels, shape.apart
    return Refined(
        found.astype(np.float32), deviation, directions, way, together, *shapes, checks.evaluations, 0, checks
    )
