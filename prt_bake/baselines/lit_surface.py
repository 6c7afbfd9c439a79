"""Where a surface is lit: shadow rays by Embree, and cosines to the normal. A BRDF reflects nothing else."""

from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from formats.mesh import Mesh
from prt_bake.geometry.camera import Visibility
from prt_bake.geometry.surface import Surface

Array = NDArray[np.float64]
Normals = Literal["face", "vertex"]

_OFFSET = 1e-4
"""Distance of the origins of shadow rays from the surface, in diagonals of the object."""


class Points(NamedTuple):
    """Points of views: the normals of shading and of the faces [N,3], and the origins of shadow rays [N,3]."""

    normals: Array
    face_normals: Array
    origins: Array

    def select(self, rows: Any) -> "Points":
        """Some of the points."""
        return Points(*(array[rows] for array in self))


class LitSurface:
    """The surface of an object that lies in the light of distant sources."""

    def __init__(self, mesh: Mesh, normals: Normals = "face") -> None:
        """Shading has the normals of faces, or those interpolated between vertices."""
        self.mesh, self._kind = mesh, normals
        self._surface, self._visibility = Surface(mesh), Visibility(mesh)

    def __reduce__(self) -> tuple[Any, ...]:
        """The rays' acceleration structure is not pickled, but built again."""
        return type(self), (self.mesh, self._kind)

    def points(self, positions: Array, outgoing: Array) -> Points:
        """Points at positions [N,3] seen along outgoing [N,3]; raises QueryError for positions off the surface."""
        location, _cosines = self._surface.choose(positions, outgoing)
        faces = np.asarray(self.mesh.face_normals)[location.faces]
        normals = faces
        if self._kind == "vertex":
            u, v = location.barycentric[:, :1], location.barycentric[:, 1:]
            corners = self.mesh.normals[np.asarray(self.mesh.faces)[location.faces]]
            mixed = (1.0 - u - v) * corners[:, 0] + u * corners[:, 1] + v * corners[:, 2]
            length = np.linalg.norm(mixed, axis=1, keepdims=True)
            normals = np.where(length > 1e-9, mixed / np.maximum(length, 1e-9), faces)
        return Points(normals, faces, location.positions + _OFFSET * self.mesh.diagonal * faces)

    def visible(self, points: Points, incident: Array) -> NDArray[np.bool_]:
        """V(x, ωi) [N,D] for incident [N,D,3]: whether light from there is above the horizon and not occluded."""
        above: NDArray[np.bool_] = np.einsum("ndc,nc->nd", incident, points.normals) > 0.0
        above &= np.einsum("ndc,nc->nd", incident, points.face_normals) > 0.0
        rows, columns = np.nonzero(above)
        above[rows, columns] = self._visibility.first_hits(points.origins[rows], incident[rows, columns]).faces < 0
        return above

    def lambert(self, points: Points, incident: Array) -> Array:
        """V max(n·ωi, 0) / π [N,D] for incident [N,D,3]: Ŝ [1/sr] of a white Lambert surface."""
        cosines = np.einsum("ndc,nc->nd", incident, points.normals)
        return np.where(self.visible(points, incident), cosines / np.pi, 0.0)

    def off_surface(self, mesh: Mesh) -> NDArray[np.int64]:
        """Numbers of the vertices of `mesh` that are off this surface."""
        faces, _barycentric, _cosines = self._surface.find_faces(mesh.positions, mesh.normals)
        return np.flatnonzero(faces < 0)
