"""What the trainer asks: points all over the surface, every direction of view, every direction of incidence.

Positions are uniform over the area, or, of a share of the queries, over the faces: meshes have small faces where there
is detail, and a bake asks at every vertex alike. A share lies on vertices and edges, seen from the hemisphere about the
vertex normal and taken to a face by the rule of `prt_bake.geometry.surface`, since a bake asks there. Views are uniform
over the hemisphere, directions of incidence a small lattice turned at random for each query (uniform each, and spread
over the sphere together).
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
"""The usual share of queries on vertices (half of it) and edges (half)."""
_QUERY_STREAM = 0x51
_NUMBERS = 9


@dataclass(frozen=True)
class Queries:
    """N queries: positions [N,3] and outgoing [N,3] in object space, incident [N,D,3], and where they lie."""

    keys: NDArray[np.uint64]
    positions: Array
    outgoing: Array
    incident: Array
    location: Location


class QuerySource:
    """Draws numbered queries from a scene: the n-th depends on the seed and n alone."""

    def __init__(
        self,
        prepared: PreparedScene,
        directions: int,
        seed: int,
        face_share: float = 0.0,
        edge_share: float = EDGE_SHARE,
    ) -> None:
        """`directions` of incidence a query; `face_share` of the queries has every face alike, large or small;
        `edge_share` lies on vertices and edges.
        """
        self.prepared = prepared
        self.lattice = fibonacci(directions)
        self.seed = seed
        self._face_share, self._edge_share = face_share, edge_share

    @property
    def _mesh(self) -> Mesh:
        return self.prepared.surface.mesh

    @cached_property
    def _area_to_here(self) -> Array:
        areas = np.asarray(self._mesh.face_areas, np.float64)
        return np.asarray(np.cumsum(areas) / areas.sum())

    def draw(self, first: int, count: int) -> Queries:
        """Queries number first … first + count − 1."""
        keys = np.arange(first, first + count, dtype=np.uint64)
        u = uniforms((_QUERY_STREAM, self.seed, keys.astype(np.int64)), _NUMBERS)
        mesh = self._mesh
        faces = self._faces(u[:, 0])
        barycentric = _in_triangle(u[:, 1], u[:, 2])
        normals = np.array(mesh.face_normals)[faces]
        positions = _interpolate(mesh.positions, mesh.faces, faces, barycentric)
        on_edge = u[:, 3] < self._edge_share
        moved = _to_edge(barycentric[on_edge], u[on_edge, 3] < 0.5 * self._edge_share)
        positions[on_edge] = _interpolate(mesh.positions, mesh.faces, faces[on_edge], moved)
        seen_about = _interpolate(mesh.normals, mesh.faces, faces[on_edge], moved)
        normals[on_edge] = seen_about / np.maximum(np.linalg.norm(seen_about, axis=1, keepdims=True), 1e-9)
        outgoing = _hemisphere(normals, u[:, 4], u[:, 5])
        location = Location(faces.astype(np.int64), np.ascontiguousarray(barycentric[:, 1:]), positions)
        if on_edge.any():
            outgoing[on_edge], found, _bent = self.prepared.surface.above_horizon(positions[on_edge], outgoing[on_edge])
            location.faces[on_edge], location.barycentric[on_edge] = found.faces, found.barycentric
        incident = np.einsum("nij,dj->ndi", rotations(u[:, 6:9]), self.lattice)
        return Queries(keys, positions, outgoing, np.ascontiguousarray(incident), location)

    def _faces(self, u: Array) -> NDArray[np.int64]:
        """A face for each uniform number."""
        last, share = len(self._mesh.faces) - 1, self._face_share
        by_area = np.searchsorted(self._area_to_here, (u - share) / (1.0 - share) if share < 1.0 else u, side="right")
        if share == 0.0:
            return np.minimum(by_area, last)
        return np.minimum(np.where(u < share, (u / share * (last + 1)).astype(np.int64), by_area), last)

    def for_kernel(self, queries: Queries) -> tuple[Any, ...]:
        """The same queries as the kernels take them."""
        return self.prepared.queries(queries.location, queries.outgoing, queries.keys)


def _in_triangle(u: Array, v: Array) -> Array:
    root = np.sqrt(u)
    return np.stack([1.0 - root, root * (1.0 - v), root * v], axis=1)


def _to_edge(barycentric: Array, to_vertex: NDArray[np.bool_]) -> Array:
    """Barycentric coordinates with the smallest made 0, or all but the largest."""
    order = np.argsort(barycentric, axis=1)
    moved = barycentric.copy()
    rows = np.arange(len(moved))
    moved[rows, order[:, 0]] = 0.0
    moved[rows[to_vertex], order[to_vertex, 1]] = 0.0
    return np.asarray(moved / moved.sum(axis=1, keepdims=True))


def _interpolate(values: Array, corners: NDArray[Any], faces: NDArray[Any], barycentric: Array) -> Array:
    return np.asarray(np.einsum("nk,nkc->nc", barycentric, values[corners[faces]]))


def _hemisphere(normals: Array, u: Array, v: Array) -> Array:
    """Uniform directions above each normal: uniform over the sphere, and mirrored up."""
    z, phi = 1.0 - 2.0 * u, 2.0 * np.pi * v
    r = np.sqrt(np.maximum(0.0, 1.0 - z * z))
    d = np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=1)
    cosine = np.sum(d * normals, axis=1, keepdims=True)
    d = np.where(cosine < 0.0, d - 2.0 * cosine * normals, d)
    return np.asarray(d / np.linalg.norm(d, axis=1, keepdims=True))
