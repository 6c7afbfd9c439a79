"""The reflecting surface of an object: its points in local frames, and its reflectance."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from formats.errors import QueryError
from formats.mesh import Mesh
from prt_bake.mathematics.sphere import tangent_frame, to_local
from prt_bake.reflection.finish import SurfacePoints
from prt_bake.reflection.microfacet import fresnel, masking

Array = NDArray[np.float64]

SMOOTHEST = 1e-4
"""Below this alpha an interface is a mirror, as in walks."""
SAME_INDEX = 1e-9
"""An index closer to 1 than this reflects nothing, as in walks."""
_CLEARANCE = 1e-6
"""Distance of ray origins from their face over the mesh's diagonal: about ten rounding errors of a position."""
_MIN_COSINE = 1e-9


class FrontPoints(NamedTuple):
    """Surface points whose face is seen from its outer side.

    rows [M]: their indices among all points. face_normals, normals (of the interface), tangents [M,3]. towards [M,3]:
    direction to the eye in the local frame of normal and tangent. alpha [M]: GGX roughness.
    """

    rows: NDArray[np.int64]
    face_normals: Array
    normals: Array
    tangents: Array
    towards: Array
    alpha: Array

    def subset(self, chosen: NDArray[np.generic]) -> "FrontPoints":
        """The points chosen by a mask or by indices."""
        return FrontPoints._make(part[chosen] for part in self)


class ReflectingSurface:
    """The microsurface of a mesh of index `eta` in a world of index 1.

    matched: whether `eta` is 1, so that nothing is reflected. Raises QueryError for an index that is not positive.
    """

    def __init__(self, mesh: Mesh, eta: float) -> None:
        if not (eta > 0.0 and math.isfinite(eta)):
            raise QueryError(f"eta: expected a finite index of refraction above 0, found {eta:g}")
        self.mesh, self.eta = mesh, float(eta)
        self.matched = abs(eta - 1.0) < SAME_INDEX

    def front_points(self, points: SurfacePoints) -> FrontPoints:
        """The points whose face is seen from its outer side.

        A face normal replaces an interface normal that faces away from the eye, as in walks.
        """
        rows = np.flatnonzero(_dot(self.mesh.face_normals[points.faces], points.outgoing) > 0.0)
        face_normals, outgoing = self.mesh.face_normals[points.faces[rows]], points.outgoing[rows]
        facing = _dot(points.normals[rows], outgoing)[:, None] > _MIN_COSINE
        normals = np.where(facing, points.normals[rows], face_normals)
        tangents = tangent_frame(normals)
        towards = to_local(outgoing, normals, tangents)
        towards[:, 2] = np.maximum(towards[:, 2], _MIN_COSINE)
        return FrontPoints(rows, face_normals, normals, tangents, towards, points.alpha[rows])

    def reflectance(self, points: FrontPoints, facets: Array, local: Array, directions: Array) -> Array:
        """Fresnel reflectance of facets [N,3] times the masking of the incident `directions` [N,3], `local` in frames.

        0 for directions below the interface or below the face.
        """
        above = (local[:, 2] > 0.0) & (_dot(directions, points.face_normals) > 0.0)
        cosine = np.clip(_dot(points.towards, facets), 0.0, 1.0)
        unmasked = np.where(points.alpha >= SMOOTHEST, masking(local[:, 2], points.alpha), 1.0)
        return np.where(above, fresnel(cosine, self.eta) * unmasked, 0.0)

    def ray_origins(self, faces: NDArray[np.int64], barycentric: Array) -> Array:
        """Origins [N,3], just off the surface, of rays that leave (u, v) [N,2] of faces [N]."""
        corners = self.mesh.positions[self.mesh.faces[faces]]
        weights = np.concatenate([1.0 - barycentric.sum(axis=1, keepdims=True), barycentric], axis=1)
        positions = np.einsum("nk,nkc->nc", weights, corners)
        return np.asarray(positions + _CLEARANCE * self.mesh.diagonal * self.mesh.face_normals[faces])


def _dot(a: Array, b: Array) -> Array:
    return np.asarray(np.einsum("ni,ni->n", a, b))
