"""Where a query lies on the object: its face, by the rule that trainer, estimates and bake share.

A position within 1e-4 of the object's diagonal is taken to the face there; of several that are that near (an edge, a
vertex) the one that faces ωo most is taken, the lowest index on a tie. On an edge the position is moved a hair
towards the middle of the chosen face: the value there is the limit from inside that face.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from formats.errors import QueryError
from formats.mesh import Mesh

REACH = 1e-4
"""How far off the surface a position may lie, in diagonals of the object."""
GRAZING = 1e-3
"""The least ωo·n that a bent direction gets."""
_EDGE = 1e-4
"""Barycentric coordinates are kept at least this far from an edge."""


@dataclass(frozen=True)
class Location:
    """Queries on the surface: faces int64 [N], barycentric (u, v) [N,2], positions [N,3] on those faces."""

    faces: NDArray[np.int64]
    barycentric: NDArray[np.float64]
    positions: NDArray[np.float64]


class Surface:
    """A mesh made ready to tell which face a position lies on."""

    def __init__(self, mesh: Mesh) -> None:
        """Keep the mesh; the grid of faces is built on first use."""
        self.mesh = mesh
        self.reach = REACH * float(mesh.diagonal)

    @cached_property
    def _grid(self) -> Any:
        from prt_bake.geometry.surface_grid import build_grid

        return build_grid(self.mesh.positions, np.asarray(self.mesh.faces, np.int64), self.reach)

    @cached_property
    def _corner_normals(self) -> dict[str, NDArray[np.float64]]:
        """[F,3,3]: each face's own normal at its three corners, or those of its vertices."""
        faces = np.asarray(self.mesh.faces)
        flat = np.repeat(np.asarray(self.mesh.face_normals)[:, None], 3, axis=1)
        return {"face": np.ascontiguousarray(flat), "vertex": np.ascontiguousarray(self.mesh.normals[faces])}

    def normals(
        self, positions: NDArray[np.float64], outgoing: NDArray[np.float64], kind: Literal["face", "vertex"] = "face"
    ) -> NDArray[np.float64]:
        """Unit normals [N,3] where queries lie, of the face or interpolated between its vertices; zero where no face is
        within reach.
        """
        from prt_bake.geometry.surface_grid import normals_of_chosen

        positions, outgoing = (np.ascontiguousarray(rows, np.float64) for rows in (positions, outgoing))
        normals = np.empty_like(positions)
        of_faces = np.asarray(self.mesh.face_normals)
        normals_of_chosen(self._grid, of_faces, self._corner_normals[kind], positions, outgoing, normals)
        return normals

    def __reduce__(self) -> tuple[Any, ...]:
        """Copies in other processes build their own grid."""
        return Surface, (self.mesh,)

    def __deepcopy__(self, memo: dict[int, Any]) -> "Surface":
        """Itself: nothing in it ever changes."""
        return self

    def in_reach(
        self, positions: NDArray[np.float64], outgoing: NDArray[np.float64]
    ) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
        """The face of each query (−1: none is within reach), its barycentric (u, v) [N,2] and ωo·n of it [N]."""
        from prt_bake.geometry.surface_grid import choose_faces

        positions, outgoing = (np.ascontiguousarray(rows, np.float64) for rows in (positions, outgoing))
        found: tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]] = choose_faces(
            self._grid, np.asarray(self.mesh.face_normals), positions, outgoing
        )
        return found

    def distance(self, position: NDArray[np.float64]) -> float:
        """How far one position [3] lies from the surface."""
        from prt_bake.geometry.surface_grid import distance_to_mesh

        return float(distance_to_mesh(self._grid, np.ascontiguousarray(position, np.float64)))

    def choose(
        self, positions: NDArray[np.float64], outgoing: NDArray[np.float64]
    ) -> tuple[Location, NDArray[np.float64]]:
        """The face of each query and ωo·n of it [N], negative or zero where the query lies below its horizon.

        Raises QueryError where a position is farther from the surface than the reach, with the distance.
        """
        faces, barycentric, cosines = self.in_reach(positions, outgoing)
        lost = np.flatnonzero(faces < 0)
        if len(lost):
            first = int(lost[0])
            raise QueryError(
                f"positions: {len(lost)} of {len(positions)} do not lie on the surface; the first is number {first}, "
                f"{self.distance(positions[first]):.3g} away, where at most {self.reach:.3g} (1e-4 of the "
                "object's diagonal) is allowed: take positions from the object's own mesh"
            )
        barycentric = _off_the_edges(barycentric)
        corners = self.mesh.positions[np.asarray(self.mesh.faces)[faces]]
        u, v = barycentric[:, :1], barycentric[:, 1:]
        return Location(
            faces, barycentric, (1 - u - v) * corners[:, 0] + u * corners[:, 1] + v * corners[:, 2]
        ), cosines

    def locate(self, positions: NDArray[np.float64], outgoing: NDArray[np.float64]) -> Location:
        """Like `choose`, but a query below the horizon raises QueryError with the count and the first index."""
        location, cosines = self.choose(positions, outgoing)
        below = np.flatnonzero(~(cosines > 0.0))
        if len(below):
            first = int(below[0])
            raise QueryError(
                f"outgoing: {len(below)} of {len(cosines)} queries lie below the horizon of every face at their "
                f"position; the first is number {first} with ωo·n = {cosines[first]:.3g}, where more than 0 is needed: "
                "ωo points away from the surface, to the eye"
            )
        return location

    def above_horizon(
        self, positions: NDArray[np.float64], outgoing: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], Location, int]:
        """Directions with those below the horizon bent up to ωo·n = 1e-3 in their own plane, the location, how many
        bent.
        """
        location, cosines = self.choose(positions, outgoing)
        below = ~(cosines >= GRAZING)
        normals = np.asarray(self.mesh.face_normals)[location.faces]
        bent = np.where(below[:, None], bend_up(outgoing, normals), outgoing)
        return bent, location, int(below.sum())


def bend_up(outgoing: NDArray[np.float64], normals: NDArray[np.float64]) -> NDArray[np.float64]:
    """Directions [N,3] turned in the plane of direction and normal until ωo·n = 1e-3 (any plane for ωo = −n)."""
    cosine = np.sum(outgoing * normals, axis=-1, keepdims=True)
    flat = outgoing - cosine * normals
    length = np.linalg.norm(flat, axis=-1, keepdims=True)
    other = np.cross(normals, np.where(np.abs(normals[..., :1]) < 0.9, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]))
    other /= np.linalg.norm(other, axis=-1, keepdims=True)
    flat = np.where(length > 1e-12, flat / np.maximum(length, 1e-12), other)
    return np.asarray(GRAZING * normals + np.sqrt(1.0 - GRAZING**2) * flat)


def _off_the_edges(barycentric: NDArray[np.float64]) -> NDArray[np.float64]:
    full = np.concatenate([1.0 - barycentric.sum(axis=1, keepdims=True), barycentric], axis=1)
    full = np.maximum(full, _EDGE)
    full /= full.sum(axis=1, keepdims=True)
    return np.ascontiguousarray(full[:, 1:])
