"""Tests whether the parts of a scene are inside their parents, by winding numbers and distances.

Why no library: trimesh tests containment by the parity of a ray's hits, which edges and gaps spoil, and its distances
need a further package, rtree.
"""

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from formats.errors import SceneError
from formats.mesh import Mesh
from formats.mesh.geometry import face_normals
from formats.scene.parts import Part
from prt_bake.jit.compilation import compiled
from prt_bake.jit.threads import in_threads

TOLERANCE = 1e-4
"""Tolerated protrusion of a part from its parent, in diagonals of the parent."""
_BEHIND = 1e-5  # distance behind a face, in diagonals
_GROUPS = 64  # of faces tested one after the other: usually the first face decides
_PAIRS = 1_000_000  # points times faces in memory at once
_MOST_PAIRS = 100_000_000  # points times faces tested in total


def protruding_parts(parts: tuple[Part, ...]) -> list[str]:
    """A remark for every part that protrudes from its parent by more than the tolerance; it is clipped there.

    Tests the vertices of the part, and the vertices of the parent that are inside the part; of large meshes a sample.
    """
    remarks = []
    for part in parts[1:]:
        parent = parts[part.parent]
        tested, parent_vertices = _sample(part.mesh, parent.mesh), _sample(parent.mesh, part.mesh)
        outside = tested[winding_numbers(parent.mesh, tested) < 0.5]
        swallowed = parent_vertices[winding_numbers(part.mesh, parent_vertices) > 0.5]
        protrusion = max(_farthest(parent.mesh, outside), _farthest(part.mesh, swallowed)) / parent.mesh.diagonal
        if protrusion > TOLERANCE:
            remarks.append(
                f"{part.name!r} sticks out of {parent.name!r} by {protrusion:.2g} of its diagonal ({len(outside)} of "
                f"{len(tested)} vertices lie outside); what sticks out is cut off"
            )
    return remarks


def refuse_outside(parts: tuple[Part, ...]) -> None:
    """Raise SceneError if a part has no volume inside its parent, whose cavities are outside of it."""
    for part in parts[1:]:
        parent = parts[part.parent]
        if not (_reaches_into(part.mesh, parent.mesh) or _reaches_into(parent.mesh, part.mesh)):
            raise SceneError(
                f"{part.mesh_path}: {part.name!r} has no volume inside {parent.name!r}: it lies beside it, or in a "
                f"cavity of it; move it, or remove the cavity from {parent.mesh_path}"
            )


def reaches_surface(mesh: Mesh, outer: Mesh) -> bool:
    """Whether a part reaches the surface of the mesh that contains it, or sticks out of it.

    Tests points just in front of its faces and of its vertices, and the vertices of the outer mesh, of large meshes a
    sample.
    """
    step = _BEHIND * mesh.diagonal
    every = max(1, -(-len(mesh.faces) * len(outer.faces) // _MOST_PAIRS))
    before_faces = mesh.positions[mesh.faces].mean(axis=1) + step * mesh.face_normals
    before_vertices = mesh.positions + step * mesh.normals
    points = np.concatenate([before_faces[::every], before_vertices[::every]])
    dents = _sample(outer, mesh)
    return bool((winding_numbers(outer, points) < 0.5).any() or (winding_numbers(mesh, dents) > 0.5).any())


def _reaches_into(mesh: Mesh, other: Mesh) -> bool:
    """Whether any point just behind a face is inside the other mesh; of large meshes a subset is tested."""
    faces = mesh.faces[:: max(1, -(-len(mesh.faces) * len(other.faces) // _MOST_PAIRS))]
    normals = face_normals(mesh.positions - mesh.center, faces)
    behind = mesh.positions[faces].mean(axis=1) - _BEHIND * mesh.diagonal * normals
    return any((winding_numbers(other, behind[k::_GROUPS]) > 0.5).any() for k in range(min(_GROUPS, len(behind))))


def winding_numbers(mesh: Mesh, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Winding numbers of a closed mesh about points [N,3]: 1 inside, 0 outside, 0, ½ or 1 on the surface.

    Sum of the faces' solid angles; Van Oosterom and Strackee, "The solid angle of a plane triangle" (1983).
    """
    turns = np.empty(len(points))
    in_threads(_sum_solid_angles, len(points), np.ascontiguousarray(points), mesh.positions, mesh.faces, turns, least=1)
    return turns


@compiled(nogil=True, error_model="numpy")
def _sum_solid_angles(first: Any, stop: Any, points: Any, positions: Any, faces: Any, turns: Any) -> None:
    for n in range(first, stop):
        x, y, z = points[n]
        total = 0.0
        for face in faces:
            a, b, c = positions[face[0]], positions[face[1]], positions[face[2]]
            a0, a1, a2 = a[0] - x, a[1] - y, a[2] - z
            b0, b1, b2 = b[0] - x, b[1] - y, b[2] - z
            c0, c1, c2 = c[0] - x, c[1] - y, c[2] - z
            length_a = math.sqrt(a0 * a0 + a1 * a1 + a2 * a2)
            length_b = math.sqrt(b0 * b0 + b1 * b1 + b2 * b2)
            length_c = math.sqrt(c0 * c0 + c1 * c1 + c2 * c2)
            volume = a0 * (b1 * c2 - b2 * c1) + a1 * (b2 * c0 - b0 * c2) + a2 * (b0 * c1 - b1 * c0)
            denominator = (
                length_a * length_b * length_c
                + (a0 * b0 + a1 * b1 + a2 * b2) * length_c
                + (b0 * c0 + b1 * c1 + b2 * c2) * length_a
                + (c0 * a0 + c1 * a1 + c2 * a2) * length_b
            )
            total += math.atan2(volume, denominator)
        turns[n] = total / (2.0 * math.pi)


def distances(mesh: Mesh, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distances of points [N,3] to the surface, in scene units."""
    nearest = np.full(len(points), np.inf)
    for rows, (a, b, c) in _blocks(mesh, points):
        to_edges = [_to_segment(start, end) for start, end in ((a, b), (b, c), (c, a))]
        normal = np.broadcast_to(mesh.face_normals, a.shape)
        height = np.einsum("nfi,nfi->nf", a, normal)
        # The signs show whether the foot of the perpendicular is in the face.
        sides = [np.einsum("nfi,nfi->nf", np.cross(start, end), normal) for start, end in ((a, b), (b, c), (c, a))]
        above = (np.minimum.reduce(sides) >= 0.0) & normal.any(axis=2)  # faces without area have edges alone
        to_faces = np.where(above, np.abs(height), np.inf)
        nearest[rows] = np.minimum.reduce([*to_edges, to_faces]).min(axis=1)
    return nearest


def _sample(mesh: Mesh, other: Mesh) -> NDArray[np.float64]:
    """The mesh's vertices, or a subset if testing all of them against the other's faces would take too long."""
    every = -(-len(mesh.positions) * len(other.faces) // _MOST_PAIRS)
    return mesh.positions[:: max(1, every)]


def _farthest(mesh: Mesh, points: NDArray[np.float64]) -> float:
    return float(distances(mesh, points).max(initial=0.0))


def _blocks(
    mesh: Mesh, points: NDArray[np.float64]
) -> Iterable[tuple[slice, tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]]]:
    """Slices of the points, and the faces' corners [n,F,3] relative to them."""
    corners = mesh.positions[mesh.faces]
    step = max(1, _PAIRS // len(corners))
    for start in range(0, len(points), step):
        rows = slice(start, start + step)
        a, b, c = (corners[None, :, k] - points[rows, None] for k in range(3))
        yield rows, (a, b, c)


def _to_segment(start: NDArray[np.float64], end: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distance of the origin to segments [n,F]."""
    along = end - start
    squared = np.maximum(np.einsum("nfi,nfi->nf", along, along), np.finfo(np.float64).tiny)
    share = -np.einsum("nfi,nfi->nf", start, along) / squared
    length: NDArray[np.float64] = np.linalg.norm(start + np.clip(share, 0.0, 1.0)[..., None] * along, axis=2)
    return length
