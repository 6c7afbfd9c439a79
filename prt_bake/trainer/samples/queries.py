"""Training queries: random points on the surface, view directions and directions of incidence.

Positions are uniform over the area. A share of the queries is uniform over the faces instead: meshes have small faces
where there is detail, and a bake evaluates every vertex. Another share lies on vertices and edges, as in a bake; its
views are about the vertex normal, and its faces follow the rule of `prt_bake.geometry.surface`. Views are uniform over
the hemisphere. Directions of incidence are a small lattice, rotated at random for each query: each is uniform over the
sphere, and together they are evenly spread.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from formats.mesh import Mesh
from prt_bake.geometry.surface import Location
from prt_bake.mathematics.directions import rotations
from prt_bake.mathematics.random import uniforms
from prt_bake.mathematics.sphere import fibonacci
from prt_bake.tracer.prepared import PreparedScene

Array = NDArray[np.float64]

EDGE_SHARE = 0.1
"""Default share of the queries on vertices (half of it) and on edges (the other half)."""
_QUERY_STREAM = 0x51
_NUMBERS = 9


@dataclass(frozen=True)
class Queries:
    """N queries: keys [N], positions and outgoing [N,3] in object space, incident [N,D,3], locations on the mesh."""

    keys: NDArray[np.uint64]
    positions: Array
    outgoing: Array
    incident: Array
    location: Location

    def select(self, rows: slice) -> "Queries":
        """Some of the queries."""
        location = Location(self.location.faces[rows], self.location.barycentric[rows], self.location.positions[rows])
        return Queries(self.keys[rows], self.positions[rows], self.outgoing[rows], self.incident[rows], location)


class QuerySource:
    """Draws numbered queries of a scene; query n depends on the seed and n alone."""

    def __init__(
        self,
        prepared: PreparedScene,
        directions: int,
        seed: int,
        face_share: float = 0.0,
        edge_share: float = EDGE_SHARE,
    ) -> None:
        """Queries have `directions` directions of incidence.

        `face_share` of them are uniform over the faces, the others over the area. `edge_share` of them are moved to
        vertices and edges.
        """
        self.prepared = prepared
        self.lattice = fibonacci(directions)
        self.seed = seed
        self._face_share, self._edge_share = face_share, edge_share

    @property
    def _mesh(self) -> Mesh:
        return self.prepared.surface.mesh

    @cached_property
    def _cumulative_area(self) -> Array:
        areas = np.asarray(self._mesh.face_areas, np.float64)
        return np.asarray(np.cumsum(areas) / areas.sum())

    def draw(self, first: int, count: int) -> Queries:
        """Queries first … first + count − 1."""
        keys = np.arange(first, first + count, dtype=np.uint64)
        u = uniforms((_QUERY_STREAM, self.seed, keys.astype(np.int64)), _NUMBERS)
        mesh = self._mesh
        faces = self._faces(u[:, 0])
        barycentric = _in_triangle(u[:, 1], u[:, 2])
        normals = np.asarray(mesh.face_normals)[faces]
        positions = _interpolate(mesh.positions, mesh.faces, faces, barycentric)
        on_edge = u[:, 3] < self._edge_share
        moved = _to_edge(barycentric[on_edge], u[on_edge, 3] < 0.5 * self._edge_share)
        positions[on_edge] = _interpolate(mesh.positions, mesh.faces, faces[on_edge], moved)
        shading = _interpolate(mesh.normals, mesh.faces, faces[on_edge], moved)
        normals[on_edge] = shading / np.maximum(np.linalg.norm(shading, axis=1, keepdims=True), 1e-9)
        outgoing = _hemisphere(normals, u[:, 4], u[:, 5])
        location = Location(faces.astype(np.int64), np.ascontiguousarray(barycentric[:, 1:]), positions)
        if on_edge.any():
            surface = self.prepared.surface
            outgoing[on_edge], found, _clamped = surface.locate_clamped(positions[on_edge], outgoing[on_edge])
            location.faces[on_edge], location.barycentric[on_edge] = found.faces, found.barycentric
        incident = np.einsum("nij,dj->ndi", rotations(u[:, 6:9]), self.lattice)
        return Queries(keys, positions, outgoing, np.ascontiguousarray(incident), location)

    def _faces(self, u: Array) -> NDArray[np.int64]:
        """A face [N] for each uniform number [N]."""
        last, share = len(self._mesh.faces) - 1, self._face_share
        by_area = np.searchsorted(
            self._cumulative_area, (u - share) / (1.0 - share) if share < 1.0 else u, side="right"
        )
        if share == 0.0:
            return np.minimum(by_area, last)
        return np.minimum(np.where(u < share, (u / share * (last + 1)).astype(np.int64), by_area), last)

    def for_kernel(self, queries: Queries) -> tuple[Any, ...]:
        """The queries as arguments of the kernels."""
        return self.prepared.queries(queries.location, queries.outgoing, queries.keys)


def _in_triangle(u: Array, v: Array) -> Array:
    root = np.sqrt(u)
    return np.stack([1.0 - root, root * (1.0 - v), root * v], axis=1)


def _to_edge(barycentric: Array, to_vertex: NDArray[np.bool_]) -> Array:
    """Barycentric coordinates with the smallest set to 0 (on an edge), or all but the largest (`to_vertex`)."""
    order = np.argsort(barycentric, axis=1)
    moved = barycentric.copy()
    rows = np.arange(len(moved))
    moved[rows, order[:, 0]] = 0.0
    moved[rows[to_vertex], order[to_vertex, 1]] = 0.0
    return np.asarray(moved / moved.sum(axis=1, keepdims=True))


def _interpolate(values: Array, corners: NDArray[Any], faces: NDArray[Any], barycentric: Array) -> Array:
    return np.asarray(np.einsum("nk,nkc->nc", barycentric, values[corners[faces]]))


def _hemisphere(normals: Array, u: Array, v: Array) -> Array:
    """Directions uniform over the hemisphere about each normal: uniform over the sphere, mirrored upwards."""
    z, phi = 1.0 - 2.0 * u, 2.0 * np.pi * v
    r = np.sqrt(np.maximum(0.0, 1.0 - z * z))
    d = np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=1)
    cosine = np.sum(d * normals, axis=1, keepdims=True)
    d = np.where(cosine < 0.0, d - 2.0 * cosine * normals, d)
    return np.asarray(d / np.linalg.norm(d, axis=1, keepdims=True))
