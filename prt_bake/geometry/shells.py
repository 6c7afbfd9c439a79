"""Closed surfaces whose inside is ambiguous: faces that cross or coincide, and shells nested with the same winding."""

import os
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from formats.errors import MeshError, warn
from formats.mesh import Mesh
from formats.mesh.edges import edges_of
from prt_bake.geometry.coincident_faces import common_points, near_faces
from prt_bake.geometry.nesting import winding_numbers

Array = NDArray[np.float64]

_UNITE = "unite its shells in a mesh editor (boolean union)"
_ROUNDS = 16
"""Most hits that are followed along an edge."""
_STEP = 1e-5
"""Distance behind a hit, in radii of the object, at which an edge is followed further."""
_ROUNDING = 1e-12
_TESTED = 400
"""Most faces behind which winding numbers are computed."""
_MOST_PAIRS = 4_000_000
"""Tested faces times all faces, about a second."""
_BEHIND = 1e-8
"""Distance behind a face, in diagonals: nearer than any other face but those that coincide with it."""


def ambiguity(mesh: Mesh, size: float | None = None) -> tuple[str, bool]:
    """What makes the inside of a closed mesh ambiguous and how to mend it, and whether light in it is wrong.

    ("", False) if no faces cross or coincide and shells are nested as cavities are. Faces that merely cross, in folds
    narrower than a face, change little light. `size`: longest side of the whole object, by default that of the mesh.
    """
    shell = shells(mesh)
    edges, faces = crossings(mesh)
    near, coincide = near_faces(mesh, size or float(np.ptp(mesh.bounds, axis=0).max()))
    if not len(edges) and not len(near) and shell.max() == 0:
        return "", False
    tested, winding = _winding_behind_faces(mesh, shell, near[~coincide])
    wrong = np.abs(winding - 1.0) > 0.5
    if coincide.any() and not (len(edges) and wrong.any()):
        count, (where,) = len(np.unique(near[coincide])), common_points(mesh, near[coincide][:1])
        return (
            f"{count} of its faces lie on one another, within a millionth of its size, the first at {_point(where)}; "
            f"{_UNITE}, or remove doubled faces and inner walls"
        ), True
    if len(edges):
        of_vertex = np.zeros(len(mesh.positions), np.int64)
        of_vertex[mesh.faces] = shell[:, None]
        apart = (of_vertex[edges[:, 0]] != shell[faces]).any()
        what = f"some of its {shell.max() + 1} shells overlap" if apart else "its surface crosses itself"
        number, where = len(np.unique(edges, axis=0)), mesh.positions[edges[0]].mean(axis=0)
        return f"{what}: {number} edges pass through faces, the first at {_point(where)}; {_UNITE}", bool(wrong.any())
    if not wrong.any():
        return "", False
    first = int(wrong.argmax())
    found = f"one of its {shell.max() + 1} shells, at {_point(mesh.positions[mesh.faces[tested[first], 0]])},"
    if winding[first] < 1.0:
        return f"{found} is wound inside out and is no cavity of another; flip its faces", True
    return f"{found} is in another and not wound as a cavity; {_UNITE}", True


def refuse_ambiguous(mesh: Mesh, path: str | os.PathLike[str], size: float | None = None) -> None:
    """Raise MeshError if light in a closed mesh is wrong, and warn if faces merely cross. `size` as in `ambiguity`."""
    what, volume = ambiguity(mesh, size)
    if volume:
        raise MeshError(f"{path}: {what}")
    if what:
        warn(f"{path}: {what}; light may be wrong there")


def _winding_behind_faces(
    mesh: Mesh, shell: NDArray[np.int64], near: NDArray[np.int64]
) -> tuple[NDArray[np.int64], Array]:
    """Some faces, at least one of each shell, and the winding numbers just behind them.

    Faces that are near others, pairs [N,2], are tested where they are.
    """
    number = int(np.clip(_MOST_PAIRS // len(mesh.faces), 32, _TESTED))
    spread = np.linspace(0, len(mesh.faces) - 1, number).astype(np.int64)
    one_each = np.unique(shell, return_index=True)[1]
    tested = np.unique(np.concatenate([spread, one_each]))
    near = near[:: max(1, -(-len(near) // number))]
    points = np.concatenate([mesh.positions[mesh.faces[tested]].mean(axis=1), common_points(mesh, near)])
    tested = np.concatenate([tested, near[:, 1]])
    return tested, winding_numbers(mesh, points - _BEHIND * mesh.diagonal * mesh.face_normals[tested])


def _point(position: Array) -> str:
    return "(" + ", ".join(f"{x:.4g}" for x in position) + ")"


def shells(mesh: Mesh) -> NDArray[np.int64]:
    """The connected part [F] that each face belongs to, counted from 0. Shells may touch at vertices."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    edges, faces = edges_of(mesh.faces), np.arange(len(mesh.faces))
    nodes = len(faces) + len(edges.ends)  # of a graph of faces, then edges
    start, end = np.repeat(faces, 3), len(faces) + edges.of_side.ravel()
    graph = coo_array((np.ones(len(start), np.int8), (start, end)), (nodes, nodes))
    return np.asarray(connected_components(graph, directed=False)[1][: len(faces)], np.int64)


def crossings(mesh: Mesh) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Edges [N,2] that pass through the inside of faces [N] which share no vertex with them.

    Embree finds candidates along each edge; signed volumes in float64 confirm them, so that faces that touch are none.
    """
    ends = np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1).astype(np.int64)
    keys = np.unique(ends[:, 0] * len(mesh.positions) + ends[:, 1])
    edges = np.stack(np.divmod(keys, len(mesh.positions)), axis=1)
    found = [(edges[rows], faces) for rows, faces in _hits_along(mesh, edges)]
    if not found:
        return np.zeros((0, 2), np.int64), np.zeros(0, np.int64)
    crossing, faces = (np.concatenate(parts) for parts in zip(*found, strict=True))
    sure = _passes_through(mesh, crossing, faces)
    return crossing[sure], faces[sure]


def _hits_along(mesh: Mesh, edges: NDArray[np.int64]) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Rows of edges and the faces that they meet, one after the other."""
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    positions = (mesh.positions - mesh.center) / (0.5 * mesh.diagonal)
    scene = EmbreeScene(robust=True)
    tree = TriangleMesh(scene, positions.astype(np.float32), np.ascontiguousarray(mesh.faces, np.int32))
    start, along = positions[edges[:, 0]], positions[edges[:, 1]] - positions[edges[:, 0]]
    length = np.linalg.norm(along, axis=1)
    along /= length[:, None]
    done, rows = np.zeros(len(edges)), np.arange(len(edges))
    for _ in range(_ROUNDS):
        origins = (start[rows] + done[rows, None] * along[rows]).astype(np.float32)
        rest = (length[rows] - done[rows]).astype(np.float32)
        hit = scene.run(origins, along[rows].astype(np.float32), rest, query="INTERSECT", output=True)
        reached = hit["primID"] >= 0
        rows, distance = rows[reached], hit["tfar"][reached]
        yield rows, hit["primID"][reached].astype(np.int64)
        done[rows] += distance + _STEP
        rows = rows[done[rows] < length[rows]]
        if not len(rows):
            break
    del tree


def _passes_through(mesh: Mesh, edges: NDArray[np.int64], faces: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Whether edges [N,2] cross the inside of faces [N]. The volume with a vertex that they share is exactly 0."""
    corners = mesh.faces[faces].astype(np.int64)
    (p, q), (a, b, c) = (np.moveaxis(mesh.positions[index] - mesh.center, 1, 0) for index in (edges, corners))

    def volume(*four: Array) -> Array:
        first, second, third = (four[k] - four[3] for k in range(3))
        scale = np.linalg.norm(first, axis=1) * np.linalg.norm(second, axis=1) * np.linalg.norm(third, axis=1)
        found = np.einsum("ni,ni->n", first, np.cross(second, third))
        return np.where(np.abs(found) > _ROUNDING * scale, found, 0.0)

    sides = volume(a, b, c, p) * volume(a, b, c, q) < 0.0
    turns = np.stack([np.sign(volume(p, q, *pair)) for pair in ((a, b), (b, c), (c, a))])
    # Of mirrored shells an edge may pass through the edge of a face: one turn is 0. Two are 0 at a vertex: they touch.
    inside = (turns != 0.0).sum(axis=0) > 1
    return np.asarray(sides & inside & ((turns >= 0.0).all(axis=0) | (turns <= 0.0).all(axis=0)))
