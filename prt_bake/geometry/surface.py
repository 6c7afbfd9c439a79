"""Locates queries on a mesh. Training, estimates and bakes share this rule.

A position within 1e-4 diagonals of the surface is assigned to the face there. Of several faces in reach (at an edge or
a vertex) the one that faces ωo most is chosen, on a tie the one of lowest index. A position on an edge is moved
slightly into the chosen face, so that its value is the limit from inside that face.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from formats.errors import QueryError
from formats.mesh import Mesh

REACH = 1e-4
"""Largest distance of a position from the surface, in diagonals of the object."""
GRAZING = 1e-3
"""ωo·n of directions that are clamped to the horizon."""
_EDGE = 1e-4
"""Least barycentric distance of located positions from an edge."""


@dataclass(frozen=True)
class Location:
    """Queries on the surface: faces int64 [N], barycentric (u, v) [N,2], positions [N,3] on those faces."""

    faces: NDArray[np.int64]
    barycentric: NDArray[np.float64]
    positions: NDArray[np.float64]


class Surface:
    """Surface queries on a mesh, by a grid of faces that is built on first use."""

    def __init__(self, mesh: Mesh) -> None:
        """Wrap a mesh."""
        self.mesh = mesh
        self.reach = REACH * float(mesh.diagonal)

    @cached_property
    def _grid(self) -> Any:
        from prt_bake.geometry.surface_grid import build_grid

        return build_grid(self.mesh.positions, np.asarray(self.mesh.faces, np.int64), self.reach)

    @cached_property
    def _corner_normals(self) -> dict[str, NDArray[np.float64]]:
        """[F,3,3]: normals at the faces' corners, for flat and for interpolated normals."""
        faces = np.asarray(self.mesh.faces)
        flat = np.repeat(np.asarray(self.mesh.face_normals)[:, None], 3, axis=1)
        return {"face": np.ascontiguousarray(flat), "vertex": np.ascontiguousarray(self.mesh.normals[faces])}

    def normals(
        self, positions: NDArray[np.float64], outgoing: NDArray[np.float64], kind: Literal["face", "vertex"] = "face"
    ) -> NDArray[np.float64]:
        """Unit normals [N,3] at queries, of the face or interpolated between its vertices; 0 if no face is in reach."""
        from prt_bake.geometry.surface_grid import normals_of_chosen

        positions, outgoing = (np.ascontiguousarray(rows, np.float64) for rows in (positions, outgoing))
        normals = np.empty_like(positions)
        of_faces = np.asarray(self.mesh.face_normals)
        normals_of_chosen(self._grid, of_faces, self._corner_normals[kind], positions, outgoing, normals)
        return normals

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the mesh alone; copies build their own grid."""
        return Surface, (self.mesh,)

    def __deepcopy__(self, memo: dict[int, Any]) -> "Surface":
        """Itself, since it is immutable."""
        return self

    def find_faces(
        self, positions: NDArray[np.float64], outgoing: NDArray[np.float64]
    ) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
        """Face of each query (−1: none in reach), barycentric (u, v) [N,2], and ωo·n [N]."""
        from prt_bake.geometry.surface_grid import choose_faces

        positions, outgoing = (np.ascontiguousarray(rows, np.float64) for rows in (positions, outgoing))
        found: tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]] = choose_faces(
            self._grid, np.asarray(self.mesh.face_normals), positions, outgoing
        )
        return found

    def distance(self, position: NDArray[np.float64]) -> float:
        """Distance of one position [3] from the surface."""
        from prt_bake.geometry.surface_grid import distance_to_mesh

        return float(distance_to_mesh(self._grid, np.ascontiguousarray(position, np.float64)))

    def choose(
        self, positions: NDArray[np.float64], outgoing: NDArray[np.float64]
    ) -> tuple[Location, NDArray[np.float64]]:
        """Locations of queries and their ωo·n [N], which is 0 or negative below the horizon.

        Raises QueryError for positions out of reach of the surface, with their count and the first distance.
        """
        faces, barycentric, cosines = self.find_faces(positions, outgoing)
        lost = np.flatnonzero(faces < 0)
        if len(lost):
            first = int(lost[0])
            raise QueryError(
                f"positions: expected points within {self.reach:.3g} (1e-4 of the object's diagonal) of the surface, "
                f"found {len(lost)} of {len(positions)} farther away; the first, number {first}, is "
                f"{self.distance(positions[first]):.3g} away: take positions from the object's own mesh"
            )
        barycentric = _off_edges(barycentric)
        corners = self.mesh.positions[np.asarray(self.mesh.faces)[faces]]
        u, v = barycentric[:, :1], barycentric[:, 1:]
        return Location(
            faces, barycentric, (1 - u - v) * corners[:, 0] + u * corners[:, 1] + v * corners[:, 2]
        ), cosines

    def locate(self, positions: NDArray[np.float64], outgoing: NDArray[np.float64]) -> Location:
        """Locations of queries. Raises QueryError as `choose`, and for queries below the horizon."""
        location, cosines = self.choose(positions, outgoing)
        below = np.flatnonzero(~(cosines > 0.0))
        if len(below):
            first = int(below[0])
            raise QueryError(
                f"outgoing: expected ωo·n > 0, found {len(below)} of {len(cosines)} queries below the horizon of every "
                f"face at their position; the first is number {first} with ωo·n = {cosines[first]:.3g}: ωo points away "
                "from the surface, to the eye"
            )
        return location

    def locate_clamped(
        self, positions: NDArray[np.float64], outgoing: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], Location, int]:
        """Directions with those below the horizon clamped to ωo·n = 1e-3, the locations, and the number of clamped
        ones.
        """
        location, cosines = self.choose(positions, outgoing)
        below = ~(cosines >= GRAZING)
        normals = np.asarray(self.mesh.face_normals)[location.faces]
        clamped = np.where(below[:, None], clamp_to_horizon(outgoing, normals), outgoing)
        return clamped, location, int(below.sum())


def clamp_to_horizon(outgoing: NDArray[np.float64], normals: NDArray[np.float64]) -> NDArray[np.float64]:
    """Directions [N,3] rotated in the plane of direction and normal to ωo·n = 1e-3 (any plane for ωo = −n)."""
    cosine = np.sum(outgoing * normals, axis=-1, keepdims=True)
    horizontal = outgoing - cosine * normals
    length = np.linalg.norm(horizontal, axis=-1, keepdims=True)
    other = np.cross(normals, np.where(np.abs(normals[..., :1]) < 0.9, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]))
    other /= np.linalg.norm(other, axis=-1, keepdims=True)
    horizontal = np.where(length > 1e-12, horizontal / np.maximum(length, 1e-12), other)
    return np.asarray(GRAZING * normals + np.sqrt(1.0 - GRAZING**2) * horizontal)


def _off_edges(barycentric: NDArray[np.float64]) -> NDArray[np.float64]:
    full = np.concatenate([1.0 - barycentric.sum(axis=1, keepdims=True), barycentric], axis=1)
    full = np.maximum(full, _EDGE)
    full /= full.sum(axis=1, keepdims=True)
    return np.ascontiguousarray(full[:, 1:])
