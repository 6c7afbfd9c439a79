"""Texture space of an object: which texels a place of its surface reads.

A query reads the four texels about it (bilinear interpolation). Two places of a translucent object have different
transport and must not share a texel. Where texture coordinates bring places apart from each other within a texel, each
of them has its own copy of that texel. Each texel, and each copy, is a row of a table.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_CANDIDATES = 1 << 21
_FAR = 1e6
"""Distance of charts for the search of the nearest texel of the same chart."""


class Taps(NamedTuple):
    """What each of N queries reads: rows of the table [N,4], and their weights [N,4], whose sum is 1."""

    rows: Indices
    weights: Array


@dataclass(frozen=True)
class TextureSpace:
    """A texture of size² texels on faces with coordinates corner_uv [F,3,2] in the unit square.

    `copies` [E] are the texels of faces that read a copy, as face · size² + texel in ascending order, and `copy_rows`
    [E] the rows of those copies.
    """

    size: int
    corner_uv: Array
    copies: Indices
    copy_rows: Indices

    @property
    def rows(self) -> int:
        """The number of rows of the table: texels first, then copies."""
        return int(max(self.size**2 - 1, self.copy_rows.max(initial=0))) + 1

    def taps(self, faces: Indices, barycentric: Array) -> Taps:
        """The rows that queries on `faces` [N] at barycentric (u, v) [N,2] read."""
        u, v = barycentric[:, :1], barycentric[:, 1:]
        corners = self.corner_uv[faces]
        at = in_texels((1.0 - u - v) * corners[:, 0] + u * corners[:, 1] + v * corners[:, 2], self.size)
        low = np.minimum(at.astype(np.int64), max(self.size - 2, 0))
        high, share = np.minimum(low + 1, self.size - 1), at - low
        columns, lines = (np.stack([low[:, axis], high[:, axis]], axis=1) for axis in (0, 1))
        across, along = (np.stack([1.0 - share[:, axis], share[:, axis]], axis=1) for axis in (0, 1))
        rows = (lines[:, :, None] * self.size + columns[:, None]).reshape(-1, 4)
        if len(self.copies):
            keys = faces[:, None] * self.size**2 + rows
            at_key = np.minimum(np.searchsorted(self.copies, keys), len(self.copies) - 1)
            rows = np.where(self.copies[at_key] == keys, self.copy_rows[at_key], rows)
        return Taps(rows, (along[:, :, None] * across[:, None]).reshape(-1, 4))


def in_texels(uv: Array, size: int) -> Array:
    """Coordinates in which the centre of texel (i, j) is (i, j)."""
    return np.asarray(np.clip(uv * size - 0.5, 0.0, size - 1.0))


@dataclass(frozen=True)
class Coverage:
    """Which faces read which texel: pairs of a texel [P] and a face [P], the row of each pair [P], and the chart of
    each face [F]. Faces that read one row are connected.
    """

    texels: Indices
    faces: Indices
    rows: Indices
    charts: Indices

    def space(self, corner_uv: Array, size: int) -> TextureSpace:
        """The texture space of this coverage."""
        copied = self.rows != self.texels
        keys = (self.faces * size**2 + self.texels)[copied]
        order = np.argsort(keys)
        return TextureSpace(size, corner_uv, keys[order], self.rows[copied][order])


def cover(corner_uv: Array, faces: Indices, size: int) -> Coverage:
    """The coverage of a texture of size² texels by faces [F,3] with coordinates corner_uv [F,3,2]."""
    corners = numbered_corners(corner_uv, faces)
    count = int(corners.max()) + 1
    charts = _components(np.repeat(np.arange(len(faces)), 3), corners.ravel(), len(faces), count)
    texels, covering = _pairs(in_texels(corner_uv, size), size)
    nodes, number = np.unique(texels[:, None] * count + corners[covering], return_inverse=True)
    pairs = len(texels)
    places = _components(np.repeat(np.arange(pairs), 3), number.ravel(), pairs, len(nodes))[:pairs]
    # The places of a texel in the order of their first face: the first keeps the texel, the others get copies.
    order = np.lexsort((places, texels))
    new = np.ones(pairs, np.bool_)
    new[1:] = (np.diff(texels[order]) != 0) | (np.diff(places[order]) != 0)
    first = np.ones(pairs, np.bool_)
    first[1:] = np.diff(texels[order]) != 0
    copy = np.cumsum(new & ~first)
    started = np.maximum.accumulate(np.where(new, np.arange(pairs), 0))
    rows = np.empty(pairs, np.int64)
    rows[order] = np.where(first[started], texels[order], size**2 - 1 + copy)
    return Coverage(texels, covering, rows, charts[: len(faces)])


def numbered_corners(corner_uv: Array, faces: Indices) -> Indices:
    """A number for each corner [F,3]; corners of one vertex with one pair of coordinates have the same, unless their
    faces have opposite orientations: there the coordinates are folded.
    """
    side = np.repeat(np.sign(uv_areas(corner_uv)), 3)
    rounded = np.round(corner_uv.reshape(-1, 2) * 2.0**24)
    keys = np.concatenate([faces.reshape(-1, 1), side[:, None], rounded], axis=1)
    return np.asarray(np.unique(keys, axis=0, return_inverse=True)[1].reshape(-1, 3))


def uv_areas(corner_uv: Array) -> Array:
    """The signed area of each face [F] in texture coordinates, negative for mirrored ones."""
    (x, y), (z, w) = (corner_uv[:, corner].T - corner_uv[:, 0].T for corner in (1, 2))
    return np.asarray(0.5 * (x * w - y * z))


def _components(left: Indices, right: Indices, lefts: int, rights: int) -> Indices:
    """The component of each of `lefts` + `rights` nodes, connected in pairs."""
    count = lefts + rights
    graph = coo_matrix((np.ones(len(left), np.int8), (left, right + lefts)), (count, count))
    return np.asarray(connected_components(graph, directed=False)[1], np.int64)


def _pairs(triangles: Array, size: int) -> tuple[Indices, Indices]:
    """The pairs of a texel and a triangle [F,3,2] that comes within one texel of its centre on both axes."""
    low = np.maximum(np.ceil(triangles.min(axis=1) - 1.0), 0).astype(np.int64)
    high = np.minimum(np.floor(triangles.max(axis=1) + 1.0), size - 1).astype(np.int64)
    widths = high - low + 1
    counts = widths.prod(axis=1)
    bounds = np.searchsorted(np.cumsum(counts), np.arange(_CANDIDATES, counts.sum() + _CANDIDATES, _CANDIDATES))
    starts = np.unique(np.concatenate([[0], np.minimum(bounds + 1, len(counts)), [len(counts)]]))
    found = []
    for first, last in pairwise(starts):
        face = np.repeat(np.arange(first, last), counts[first:last])
        number = np.arange(len(face)) - np.repeat(
            np.cumsum(counts[first:last]) - counts[first:last], counts[first:last]
        )
        cell = low[face] + np.stack([number % widths[face, 0], number // widths[face, 0]], axis=1)
        near = _near(triangles[face], cell)
        found.append((cell[near, 1] * size + cell[near, 0], face[near]))
    texels, faces = (np.concatenate(part) for part in zip(*found, strict=True))
    return texels, faces


def _near(triangles: Array, cell: Indices) -> NDArray[np.bool_]:
    """Whether squares of half side 1 about `cell` [N,2] meet triangles [N,3,2] inside: separating axes."""
    relative = triangles - cell[:, None]
    near = (relative.min(axis=1) < 1.0).all(axis=1) & (relative.max(axis=1) > -1.0).all(axis=1)
    for corner in range(3):
        edge = relative[:, (corner + 1) % 3] - relative[:, corner]
        normal = np.stack([edge[:, 1], -edge[:, 0]], axis=1)
        along = np.einsum("nkc,nc->nk", relative, normal)
        reach = np.abs(normal).sum(axis=1)
        near &= (along.min(axis=1) < reach) & (along.max(axis=1) > -reach) | (reach == 0.0)
    return np.asarray(near)


def dilate(values: NDArray[np.float32], trained: NDArray[np.bool_], coverage: Coverage, size: int) -> None:
    """Give rows [T,C] that are read but not `trained` [T] the values of the nearest trained row of their chart."""
    texel, chart = np.zeros(len(values), np.int64), np.full(len(values), -1)
    texel[coverage.rows], chart[coverage.rows] = coverage.texels, coverage.charts[coverage.faces]
    source, target = np.flatnonzero(trained & (chart >= 0)), np.flatnonzero(~trained & (chart >= 0))
    if not len(source) or not len(target):
        return
    places = np.stack([*np.divmod(texel, size), _FAR * chart], axis=1)
    values[target] = values[source[KDTree(places[source]).query(places[target])[1]]]
