"""Whether the parts of a scene lie inside their parents: winding numbers, and distances of what sticks out.

No library: trimesh tests containment by the parity of a ray's hits, which edges and gaps spoil, and its distances need
a further package, rtree.
"""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from formats.mesh import Mesh
from formats.scene.parts import Part

TOLERANCE = 1e-4
"""How far a part may stick out of its parent unnoticed, in diagonals of the parent."""
_PAIRS = 1_000_000  # points times faces held in memory at once
_MOST_PAIRS = 100_000_000  # points times faces tested in all


def sticking_out(parts: tuple[Part, ...]) -> list[str]:
    """Return a sentence for every part that sticks out of its parent by more than the tolerance; it is clipped there.

    Tested are the vertices of the part, and those of the parent that the part holds; of large meshes an even sample.
    """
    sentences = []
    for part in parts[1:]:
        parent = parts[part.parent]
        tested, parent_s = _sample(part.mesh, parent.mesh), _sample(parent.mesh, part.mesh)
        outside = tested[winding(parent.mesh, tested) < 0.5]
        swallowed = parent_s[winding(part.mesh, parent_s) > 0.5]
        out = max(_farthest(parent.mesh, outside), _farthest(part.mesh, swallowed)) / parent.mesh.diagonal
        if out > TOLERANCE:
            sentences.append(
                f"{part.name!r} sticks out of {parent.name!r} by {out:.2g} of its diagonal ({len(outside)} of "
                f"{len(tested)} vertices lie outside); what sticks out is cut off"
            )
    return sentences


def winding(mesh: Mesh, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how often a closed mesh winds about each point [N]: 1 inside, 0 outside; on it, either or ½.

    Van Oosterom and Strackee, "The solid angle of a plane triangle" (1983), summed over the faces.
    """
    turns = np.zeros(len(points))
    for rows, (a, b, c) in _blocks(mesh, points):
        length_a, length_b, length_c = (np.linalg.norm(corner, axis=2) for corner in (a, b, c))
        volume = np.einsum("nfi,nfi->nf", a, np.cross(b, c))
        dots = [np.einsum("nfi,nfi->nf", *pair) for pair in ((a, b), (b, c), (c, a))]
        below = length_a * length_b * length_c + dots[0] * length_c + dots[1] * length_a + dots[2] * length_b
        turns[rows] = np.arctan2(volume, below).sum(axis=1) / (2.0 * np.pi)
    return turns


def distances(mesh: Mesh, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distance of each point [N] to the nearest point of the surface, in scene units."""
    nearest = np.full(len(points), np.inf)
    for rows, (a, b, c) in _blocks(mesh, points):
        to_edges = [_to_segment(start, end) for start, end in ((a, b), (b, c), (c, a))]
        normal = np.broadcast_to(mesh.face_normals, a.shape)
        height = np.einsum("nfi,nfi->nf", a, normal)
        # Along the normal the heights cancel: the signs tell whether the foot of the perpendicular lies in the face.
        sides = [np.einsum("nfi,nfi->nf", np.cross(start, end), normal) for start, end in ((a, b), (b, c), (c, a))]
        to_faces = np.where(np.minimum.reduce(sides) >= 0.0, np.abs(height), np.inf)
        nearest[rows] = np.minimum.reduce([*to_edges, to_faces]).min(axis=1)
    return nearest


def _sample(mesh: Mesh, other: Mesh) -> NDArray[np.float64]:
    """The mesh's vertices, or every so many of them where testing all against the other's faces would take too long."""
    every = -(-len(mesh.positions) * len(other.faces) // _MOST_PAIRS)
    return mesh.positions[:: max(1, every)]


def _farthest(mesh: Mesh, points: NDArray[np.float64]) -> float:
    return float(distances(mesh, points).max(initial=0.0))


def _blocks(
    mesh: Mesh, points: NDArray[np.float64]
) -> Iterable[tuple[slice, tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]]]:
    """Yield rows of points, and the corners of every face as seen from each of them [n,F,3]."""
    corners = mesh.positions[mesh.faces]
    step = max(1, _PAIRS // len(corners))
    for start in range(0, len(points), step):
        rows = slice(start, start + step)
        a, b, c = (corners[None, :, k] - points[rows, None] for k in range(3))
        yield rows, (a, b, c)


def _to_segment(start: NDArray[np.float64], end: NDArray[np.float64]) -> NDArray[np.float64]:
    """The distance of the origin to segments [n,F]."""
    along = end - start
    share = -np.einsum("nfi,nfi->nf", start, along) / np.einsum("nfi,nfi->nf", along, along)
    length: NDArray[np.float64] = np.linalg.norm(start + np.clip(share, 0.0, 1.0)[..., None] * along, axis=2)
    return length
