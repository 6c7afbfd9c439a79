"""The surface of an object as it reflects: where it is seen, and how much of the light from a direction it sends on."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from formats.errors import QueryError
from formats.mesh import Mesh
from prt_bake.mathematics.sphere import tangent_frame, to_local
from prt_bake.reflection.microfacet import fresnel, masking

Array = NDArray[np.float64]

SMOOTHEST = 1e-4
"""Below this alpha an interface is a mirror, for walks as well."""
SAME_INDEX = 1e-9
"""An index closer to 1 than this reflects nothing, for walks as well."""
_CLEARANCE = 1e-6
"""Of the diagonal: how far in front of its face a ray starts, some ten roundings of a position."""
_LEAST_COSINE = 1e-9


class Points(NamedTuple):
    """Points of the surface with an eye above their faces each: which of those asked for, the faces' normals, the
    interface's normals, and the direction to the eye `towards` in the frame of those and `tangents`.
    """

    rows: NDArray[np.int64]
    outwards: Array
    normals: Array
    tangents: Array
    towards: Array
    alpha: Array


class ReflectingSurface:
    """The microsurface of a mesh of index `eta` in a world of index 1.

    matched: whether it reflects nothing, eta being 1. Raises QueryError for an index that is not above 0.
    """

    def __init__(self, mesh: Mesh, eta: float) -> None:
        if not (eta > 0.0 and math.isfinite(eta)):
            raise QueryError(f"eta: {eta:g} where a finite index of refraction above 0 is expected")
        self.mesh, self.eta = mesh, float(eta)
        self.matched = abs(eta - 1.0) < SAME_INDEX

    def points(self, faces: NDArray[np.int64], normals: Array, outgoing: Array, alpha: Array) -> Points:
        """Those of the points on faces [N] whose face is seen along `outgoing` [N,3].

        normals [N,3] are the interface's; where one faces away from `outgoing` the face's own is taken, as walks do.
        """
        above = np.flatnonzero(_dot(self.mesh.face_normals[faces], outgoing) > 0.0)
        outwards, outgoing, normals = self.mesh.face_normals[faces[above]], outgoing[above], normals[above]
        normals = np.where(_dot(normals, outgoing)[:, None] > _LEAST_COSINE, normals, outwards)
        tangents = tangent_frame(normals)
        towards = to_local(outgoing, normals, tangents)
        towards[:, 2] = np.maximum(towards[:, 2], _LEAST_COSINE)
        return Points(above, outwards, normals, tangents, towards, alpha[above])

    def share(self, points: Points, facets: Array, local: Array, directions: Array) -> Array:
        """Of the light that comes along `directions` to facets, what they reflect and the microsurface lets by [N].

        Nothing comes from below the interface, nor from below the face.
        """
        above = (local[:, 2] > 0.0) & (_dot(directions, points.outwards) > 0.0)
        cosine = np.clip(_dot(points.towards, facets), 0.0, 1.0)
        seen = np.where(points.alpha >= SMOOTHEST, masking(local[:, 2], points.alpha), 1.0)
        return np.where(above, fresnel(cosine, self.eta) * seen, 0.0)

    def starts(self, faces: NDArray[np.int64], barycentric: Array) -> Array:
        """Where rays begin [N,3] that leave (u, v) [N,2] of faces [N]: just off the surface."""
        corners = self.mesh.positions[self.mesh.faces[faces]]
        weights = np.concatenate([1.0 - barycentric.sum(axis=1, keepdims=True), barycentric], axis=1)
        places = np.einsum("nk,nkc->nc", weights, corners)
        return np.asarray(places + _CLEARANCE * self.mesh.diagonal * self.mesh.face_normals[faces])


def _dot(a: Array, b: Array) -> Array:
    return np.asarray(np.einsum("ni,ni->n", a, b))
