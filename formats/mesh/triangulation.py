"""Polygons to triangles. Every corner of a polygon is a corner of its triangles, so that no crack opens.

A polygon that its fan about the first corner fills keeps that fan; convex ones always do. Any other is projected along
its Newell normal (Sutherland et al., "A characterization of ten hidden-surface algorithms", 1974) and divided so that
its worst triangle is as good as possible, by dynamic programming over its diagonals (Klincsek, "Minimal triangulations
of polygonal domains", 1980). If no triangle is turned over, they cover the projection exactly once, because the winding
number of an outline is the sum of those of its triangles.

No library: mapbox_earcut and Shapely leave collinear corners out, where neighbouring faces then come apart.
"""

import os
from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from formats.errors import MeshError, warn
from formats.mesh.geometry import MOST_COORDINATE, SLIVER, normalise
from formats.triangle_soup import fan

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]

MOST_CORNERS = 1000
"""Most corners of a polygon that its fan does not fill; the time grows with the cube of their number."""
_ROUNDING = 1e-5  # triangles of less negative quality are turned over by rounding only
_PLANAR = 1e-3  # height over width; the edges of flatter polygons meet in space where they meet in the projection
_BLOCK = 200_000  # corners in memory at once
_MOST_ENTRIES = 4_000_000  # of tables in memory at once


def refuse_absent(
    corners: Indices, sizes: Indices, count: int, path: str | os.PathLike[str], name: Callable[[int], str], base: int
) -> None:
    """Raise MeshError if corners [C] of polygons are none of `count` vertices.

    Args:
        corners: as for `triangulate`, from 0.
        sizes: number of corners of each polygon [P].
        count: number of vertices.
        path: the file.
        name: returns the line or row of the polygon with this index.
        base: the number of the first vertex in the file's own counting, which the message uses.
    """
    absent = (corners < 0) | (corners >= count)
    if not absent.any():
        return
    ends = np.cumsum(sizes)
    wrong = np.unique(np.searchsorted(ends, np.flatnonzero(absent), side="right"))
    first = int(wrong[0])
    found = (corners[ends[first] - sizes[first] : ends[first]] + base).tolist()
    shifted = base == 0 and corners.min() == 1 and corners.max() == count
    advice = "the file seems to count from 1, PLY counts from 0" if shifted else "export the mesh again"
    raise MeshError(
        f"{path}: {len(wrong)} of {len(sizes)} faces use vertices that do not exist, the first is {name(first)} with "
        f"corners {found}; expected numbers from {base} to {count - 1 + base}; {advice}"
    )


def triangulate(positions: Array, corners: Indices, sizes: Indices, place: Callable[[int], str]) -> Indices:
    """Divide polygons into triangles.

    Args:
        positions: vertices [V,3].
        corners: the vertices at the corners of all polygons, concatenated [C].
        sizes: number of corners of each polygon [P].
        place: returns the file and the line or row of the polygon with this index, for messages.

    Returns:
        Indices into `corners` [F,3], in polygon order. Polygons without area, and those with vertices that do not exist
        or are not finite, are fans. Corners that repeat the one before are left out where the fan fails.

    Raises:
        MeshError: a polygon crosses itself, or has more than MOST_CORNERS corners and its fan fails.
    """
    triangles = fan(sizes)
    unfilled = _unfilled(positions, corners, sizes)
    if len(unfilled) == 0:
        return triangles
    owners = np.repeat(np.arange(len(sizes)), np.maximum(sizes - 2, 0))
    kept = ~np.isin(owners, unfilled)
    divided, owner_lists = [triangles[kept]], [owners[kept]]
    crossing, folded = [], []
    for polygons, members in _equal_groups(positions, corners, sizes, unfilled, place):
        local, crosses, folds = _divide(positions[corners[members]])
        divided.append(np.take_along_axis(members, local.reshape(len(members), -1), axis=1).reshape(-1, 3))
        owner_lists.append(np.repeat(polygons, local.shape[1]))
        crossing.append(polygons[crosses])
        folded.append(polygons[folds])
    _report(np.concatenate(crossing), np.concatenate(folded), sizes, place)
    order = np.argsort(np.concatenate(owner_lists), kind="stable")
    return np.concatenate(divided)[order]


def _report(crossing: Indices, folded: Indices, sizes: Indices, place: Callable[[int], str]) -> None:
    if len(crossing):
        first = int(crossing.min())
        raise MeshError(
            f"{place(first)}: the outline of a face of {sizes[first]} corners crosses itself ({len(crossing)} in all); "
            f"expected simple polygons: correct them, or triangulate the mesh in its editor"
        )
    if len(folded):
        warn(
            f"{place(int(folded.min()))}: a face is bent so far that its outline crosses itself seen from the front "
            f"({len(folded)} in all); it was divided where it bends least, triangulate the mesh in its editor to choose"
        )


def _unfilled(positions: Array, corners: Indices, sizes: Indices) -> Indices:
    """Return the polygons that have area and that their fan about the first corner does not fill."""
    large, starts = np.flatnonzero(sizes > 3), np.cumsum(sizes) - sizes
    if len(large) == 0 or len(positions) == 0:  # `read_mesh` reports vertices that do not exist
        return large[:0]
    blocks = np.array_split(large, int(sizes[large].sum()) // _BLOCK + 1)
    found = [
        block[_fan_fails(positions, corners[_members(starts[block], sizes[block])], sizes[block])]
        for block in blocks
        if len(block)
    ]
    return np.concatenate(found)


def _members(starts: Indices, sizes: Indices) -> Indices:
    """Return the indices of the corners of polygons in the list of all corners, concatenated."""
    return np.repeat(starts - np.cumsum(sizes) + sizes, sizes) + np.arange(sizes.sum())


def _fan_fails(positions: Array, corners: Indices, sizes: Indices) -> Mask:
    """Mark polygons [P] with area whose fan has a triangle without area or turned over, or goes round its corner."""
    exists = (corners >= 0) & (corners < len(positions))
    points = positions[np.where(exists, corners, 0)]
    usable = exists & (np.abs(points) <= MOST_COORDINATE).all(axis=1)
    triangles, owner = fan(sizes), np.repeat(np.arange(len(sizes)), sizes - 2)

    def total(values: NDArray[np.generic]) -> Array:
        return np.bincount(owner, values, minlength=len(sizes)).astype(np.float64)

    with np.errstate(all="ignore"):  # coordinates that are too large or not finite; `read_mesh` reports them
        start, first, second = (points[triangles[:, corner]] for corner in range(3))
        first, second = first - start, second - start
        vectors = np.cross(first, second)
        normals = normalise(np.stack([total(vectors[:, axis]) for axis in range(3)], axis=1))[owner]
        doubled = _dot(vectors, normals)
        longest = np.maximum(np.maximum(_dot(first, first), _dot(second, second)), _dot(second - first, second - first))
        angles = np.arctan2(doubled, _dot(first, second) - _dot(first, normals) * _dot(second, normals))
        wrong = ~(doubled > SLIVER * longest)
        has_area = np.sqrt(_dot(vectors, vectors)) > SLIVER * longest
    whole = np.logical_and.reduceat(usable, np.cumsum(sizes) - sizes)
    fails: Mask = (total(wrong) > 0) | (total(angles) > 2 * np.pi - 1e-9)
    return whole & (total(has_area) > 0) & fails


def _equal_groups(
    positions: Array, corners: Indices, sizes: Indices, polygons: Indices, place: Callable[[int], str]
) -> Iterator[tuple[Indices, Indices]]:
    """Yield groups of polygons [n] with equal numbers of corners, and the indices of these corners [n,k].

    Corners at the position of the corner before them are left out.
    """
    members = _members((np.cumsum(sizes) - sizes)[polygons], sizes[polygons])
    owner = np.repeat(polygons, sizes[polygons])
    ends = np.cumsum(sizes[polygons])
    before = np.roll(members, 1)
    before[ends - sizes[polygons]] = members[ends - 1]
    kept = (positions[corners[members]] != positions[corners[before]]).any(axis=1)
    members, owner = members[kept], owner[kept]
    counts = np.bincount(owner, minlength=len(sizes))[polygons]
    if counts.max() > MOST_CORNERS:
        first = int(polygons[counts > MOST_CORNERS][0])
        raise MeshError(
            f"{place(first)}: a face of {sizes[first]} corners is not convex; expected at most {MOST_CORNERS} corners: "
            f"triangulate the mesh in its editor"
        )
    for count in np.unique(counts):
        chosen = polygons[counts == count]
        rows = members[np.isin(owner, chosen)].reshape(-1, count)
        for start in range(0, len(chosen), step := max(1, _MOST_ENTRIES // count**2)):
            yield chosen[start : start + step], rows[start : start + step]


def _divide(points: Array) -> tuple[Indices, Mask, Mask]:
    """Divide polygons [P,n,3].

    Returns:
        Corners of their triangles [P,n-2,3]; which polygons cross themselves in space, and which only in projection.
    """
    points = points - points[:, :1]
    points /= np.abs(points).max(axis=(1, 2), keepdims=True)
    vectors = np.cross(points[:, 1:-1], points[:, 2:]).sum(axis=1)
    normals = normalise(vectors)
    side = normalise(np.cross(normals, np.eye(3)[np.abs(normals).argmin(axis=1)]))
    plane = np.stack([side, np.cross(normals, side)], axis=2)
    flat = points @ plane
    split, worst = _best_splits(flat)
    has_front = np.linalg.norm(vectors, axis=1) > SLIVER
    simple = has_front & (worst > -_ROUNDING) & (np.abs(_turning(flat) - 2 * np.pi) < 1)
    bent = has_front & (np.ptp(np.einsum("pnk,pk->pn", points, normals), axis=1) > _PLANAR)
    return _triangles(split), ~simple & ~bent, ~simple & bent


def _turning(flat: Array) -> Array:
    """Return the sum of the exterior angles of polygons [P,n,2]; 2π for a simple one, counter-clockwise."""
    edges = np.roll(flat, -1, axis=1) - flat
    following = np.roll(edges, -1, axis=1)
    angles: Array = np.arctan2(_cross(edges, following), _dot(edges, following)).sum(axis=1)
    return angles


def _best_splits(flat: Array) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Return the third corner of the best triangle at each diagonal, and the quality of the worst triangle [P].

    Tables [P,n,n] have an entry for the diagonal from each corner to the one a number of steps ahead (or back). The
    quality of a triangle is twice its area, negative if it is turned over, over the sum of its edges' squares. It is
    rounded to float32, so that ties are resolved alike on every machine.
    """
    count, n, _ = flat.shape
    corner, steps = np.arange(n)[:, None], np.arange(n)
    x, y = (flat[:, np.minimum(corner + steps, n - 1), axis] - flat[:, :, None, axis] for axis in range(2))
    ahead = x * x + y * y
    back = np.square(flat[:, np.maximum(corner - steps, 0)] - flat[:, :, None]).sum(axis=3)
    best_ahead, best_back = np.full((2, count, n, n), np.inf, np.float32)
    split = np.zeros((count, n, n), np.int32)
    for gap in range(2, n):
        # Triangles of corner i, each of the corners k between, and corner j = i + gap, for all i.
        i, j, to_k, from_k, whole = (
            np.s_[: n - gap],
            np.s_[gap:],
            np.s_[1:gap],
            np.s_[gap - 1 : 0 : -1],
            np.s_[gap : gap + 1],
        )
        doubled = x[:, i, to_k] * y[:, i, whole] - y[:, i, to_k] * x[:, i, whole]
        squares = ahead[:, i, to_k] + back[:, j, from_k] + (ahead[:, i, whole] + np.finfo(np.float64).tiny)
        quality = (doubled / squares).astype(np.float32)
        worst = np.minimum(np.minimum(best_ahead[:, i, to_k], best_back[:, j, from_k]), quality)
        choice = worst.argmax(axis=2)
        split[:, i, gap] = corner[: n - gap, 0] + 1 + choice
        best_ahead[:, i, gap] = best_back[:, j, gap] = np.take_along_axis(worst, choice[..., None], axis=2)[..., 0]
    return split, best_ahead[:, 0, n - 1]


def _triangles(split: NDArray[np.int32]) -> Indices:
    """Collect the triangles [P,n-2,3] from the third corners at the diagonals."""
    count, n, _ = split.shape
    rows, top = np.arange(count), np.zeros(count, np.int64)
    pending = np.zeros((count, n, 2), np.int64)  # a stack of diagonals for each polygon
    pending[:, 0] = 0, n - 1
    triangles = np.empty((count, n - 2, 3), np.int64)
    for step in range(n - 2):
        i, j = pending[rows, top].T
        k = split[rows, i, j - i].astype(np.int64)
        triangles[:, step] = np.stack([i, k, j], axis=1)
        top -= 1
        for low, high in ((k, j), (i, k)):
            has_triangle = high - low > 1
            top += has_triangle
            pending[rows[has_triangle], top[has_triangle]] = np.stack([low, high], axis=1)[has_triangle]
    return triangles


def _dot(a: Array, b: Array) -> Array:
    products: Array = (a * b).sum(axis=-1)
    return products


def _cross(a: Array, b: Array) -> Array:
    products: Array = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return products
