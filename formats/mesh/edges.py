"""Edges of a triangle mesh: which are open, wound inconsistently, or overfull; loose vertices that could be merged.

A surface is closed if at every edge as many faces traverse it one way as the other. Four faces or more may meet at an
edge: solids may touch there, but not overlap.

No library: trimesh calls an edge closed only if it has exactly two faces, and merges vertices anywhere, not only at
seams.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from formats.mesh.geometry import faces_without_area, normalise, signed_volume

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_MOST_NEIGHBOURS = 9  # vertices that a vertex is compared with when vertices are merged, itself included
_SAME_ANGLE = 1e-6  # faces that leave an edge at angles nearer than this lie on one another, in radians
_LEAST_VOLUME = 1e-12  # in cubed diagonals; a sheet with two sides has a volume of 0, the rounding of that either sign
_ROUNDINGS = 4.0  # loose vertices are merged within so many steps of float32 at the largest coordinate,
_MOST_OF_DIAGONAL = 1e-4  # and, far from the origin, within so many diagonals of the bounding box


@dataclass(frozen=True)
class Edges:
    """The undirected edges of a mesh.

    Attributes:
        ends: the vertices of each edge [E,2], the lower index first.
        uses: number of faces at each edge [E].
        directions: the sum of the directions in which they traverse it [E]: +1 from the first end, −1 back. 0 on a
            closed surface.
        of_side: the edge of each side of each face [F,3], from corner k to the next.
    """

    ends: Indices
    uses: Indices
    directions: Indices
    of_side: Indices

    @property
    def open(self) -> NDArray[np.bool_]:
        """Which edges have an odd number of faces [E]."""
        return np.asarray(self.uses % 2 == 1)

    @property
    def inconsistent(self) -> NDArray[np.bool_]:
        """Which edges have an even number of faces that traverse them more often one way than the other [E]."""
        return np.asarray((self.directions != 0) & ~self.open)

    @property
    def closed(self) -> bool:
        """Whether every edge is traversed as often one way as the other."""
        return not self.directions.any()


def edges_of(faces: NDArray[np.integer]) -> Edges:
    """Return the edges of faces [F,3]."""
    starts = faces.ravel().astype(np.int64)
    ends = np.roll(faces, -1, axis=1).ravel().astype(np.int64)
    count = int(faces.max()) + 1
    keys, of_side = np.unique(np.minimum(starts, ends) * count + np.maximum(starts, ends), return_inverse=True)
    of_side = of_side.ravel()
    return Edges(
        ends=np.stack([keys // count, keys % count], axis=1),
        uses=np.bincount(of_side),
        directions=np.bincount(of_side, np.sign(ends - starts)).astype(np.int64),
        of_side=of_side.reshape(-1, 3),
    )


def opens_edges(faces: NDArray[np.integer], dropped: NDArray[np.bool_]) -> bool:
    """Return whether faces lose their neighbours at any edge if the `dropped` ones [F] are removed."""
    edges = edges_of(faces)
    signs = np.sign(np.roll(faces, -1, axis=1).astype(np.int64) - faces)
    kept = ~dropped
    left = np.bincount(edges.of_side[kept].ravel(), signs[kept].ravel(), minlength=len(edges.ends))
    return bool(((edges.directions == 0) & (left != 0)).any())


def doubled_faces(faces: NDArray[np.integer]) -> Indices:
    """Return the faces that have the vertices of an earlier one, in any order, ascending."""
    ordered = np.sort(faces, axis=1)
    order = np.lexsort(ordered.T)
    same = (ordered[order[1:]] == ordered[order[:-1]]).all(axis=1)
    return np.sort(order[1:][same])


def two_sided_faces(faces: NDArray[np.integer]) -> Indices:
    """Return the faces that have the vertices of another one in the opposite order, ascending."""
    least = faces.argmin(axis=1)[:, None]
    rows = np.take_along_axis(faces, (least + np.arange(3)) % 3, axis=1)
    number = np.unique(np.concatenate([rows, rows[:, [0, 2, 1]]]), axis=0, return_inverse=True)[1].ravel()
    return np.flatnonzero(np.isin(number[: len(faces)], number[len(faces) :]))


def inside_out(positions: Array, faces: NDArray[np.integer]) -> bool:
    """Return whether the surface is closed and encloses a negative volume."""
    low, high = positions.min(axis=0), positions.max(axis=0)
    least = _LEAST_VOLUME * float(np.linalg.norm(high - low)) ** 3
    return signed_volume(positions - (low + 0.5 * (high - low)), faces) < -least and edges_of(faces).closed


def overlapping(positions: Array, faces: NDArray[np.integer], edges: Edges) -> Indices:
    """Return the edges of more than two faces at which faces lie on one another, or the solids between them overlap.

    Turning about the edge, one must leave a solid before one enters the next.
    """
    side = np.flatnonzero((edges.uses > 2)[edges.of_side.ravel()])
    edge = edges.of_side.ravel()[side]
    low, high = edges.ends[edge].T
    start, opposite = faces.ravel()[side], faces[side // 3, (side + 2) % 3]
    along = normalise(positions[high] - positions[low])
    across = normalise(np.cross(along, np.eye(3)[np.abs(along).argmin(axis=1)]))
    arm = normalise(positions[opposite] - positions[low])
    angle = np.arctan2((arm * np.cross(along, across)).sum(axis=1), (arm * across).sum(axis=1))
    order = np.lexsort((angle, edge))
    edge, angle, forward = edge[order], angle[order], (start == low)[order]
    first = np.flatnonzero(np.diff(edge, prepend=-1))
    last = np.append(first[1:], len(edge)) - 1
    following = np.arange(1, len(edge) + 1)
    following[last[: len(first)]] = first
    turn = (angle[following] - angle) % (2 * np.pi)
    wrong = (forward[following] == forward) | (np.minimum(turn, 2 * np.pi - turn) < _SAME_ANGLE)
    return np.unique(edge[wrong])


def welded(positions: Array, faces: Indices) -> tuple[Indices, float] | None:
    """Merge loose vertices that lie within a rounding to float32 of one another, if that closes the surface.

    Returns:
        For each vertex the one that takes its place [V], and the longest distance between two of them; None if the
        surface is closed, or is not closed by this.
    """
    edges = edges_of(faces)
    if edges.closed:
        return None
    box = np.stack([positions[faces].min(axis=(0, 1)), positions[faces].max(axis=(0, 1))])
    step = float(np.spacing(np.float32(np.abs(box).max())))
    reach = min(_ROUNDINGS * step, _MOST_OF_DIAGONAL * float(np.linalg.norm(box[1] - box[0])))
    target = _merged(positions, faces, loose_vertices(edges), reach)
    if target is None:
        return None
    moved = target != np.arange(len(target))
    return target, float(np.linalg.norm(positions[moved] - positions[target[moved]], axis=1).max())


def loose_vertices(edges: Edges) -> Indices:
    """Return the vertices at edges that are not traversed as often one way as the other, ascending."""
    return np.unique(edges.ends[edges.directions != 0])


def remedy(positions: Array, faces: NDArray[np.integer], edges: Edges) -> str:
    """Say what closes the open edges: merging the loose vertices, if they are near one another, or closing holes."""
    from scipy.spatial import cKDTree

    loose = loose_vertices(edges)
    nearest = cKDTree(positions[loose]).query(positions[loose], k=2)[0][:, 1]
    reach = float(f"{1.05 * nearest.max():.1e}")
    if _merged(positions, faces.astype(np.int64), loose, reach) is None:
        apart = f"of the {len(loose)} vertices there, the nearest two lie {nearest.min():.2g} apart"
        return f"close the holes ({apart}){_open_pieces(positions, faces, loose)}"
    return (
        f"the {len(loose)} vertices there lie up to {nearest.max():.2g} from one another: merging vertices by distance "
        f"{reach:.2g} closes the surface"
    )


def _open_pieces(positions: Array, faces: NDArray[np.integer], loose: Indices) -> str:
    """Say which pieces the loose vertices are of, if others are closed: an object with a ground plane, for example."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    count = len(positions)
    row, column = faces[:, [0, 1]].ravel(), faces[:, [1, 2]].ravel()
    links = coo_array((np.ones(len(row), np.int8), (row, column)), (count, count))
    piece = connected_components(links, directed=False)[1]
    pieces, unclosed = np.unique(piece[faces[:, 0]]), np.unique(piece[loose])
    if len(unclosed) == len(pieces):
        return ""
    first = positions[piece == unclosed[0]]
    low, high = (", ".join(f"{x:.4g}" for x in corner) for corner in (first.min(axis=0), first.max(axis=0)))
    verb = "is" if len(unclosed) == 1 else "are"
    return (
        f"; {len(unclosed)} of its {len(pieces)} pieces {verb} open, the first from ({low}) to ({high}): leave out "
        "what is not of the object, such as a ground"
    )


def _merged(positions: Array, faces: Indices, loose: Indices, reach: float) -> Indices | None:
    """Return the vertex that takes each one's place if loose ones within `reach` are merged and the surface is closed.

    None if it is not closed, or if a face loses its area.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    count = len(loose)
    others = cKDTree(positions[loose]).query(
        positions[loose], k=min(_MOST_NEIGHBOURS, count), distance_upper_bound=reach
    )[1]
    row, column = np.nonzero(others < count)
    links = coo_array((np.ones(len(row), np.int8), (row, others[row, column])), (count, count))
    group = connected_components(links, directed=False)[1]
    target = np.arange(len(positions))
    target[loose] = loose[np.unique(group, return_index=True)[1][group]]
    joined = target[faces]
    if not edges_of(joined).closed or faces_without_area(positions, joined).any():
        return None
    return target
