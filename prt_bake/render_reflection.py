"""Light reflected at the surface itself, as an addition to a picture: one sample at every point that is seen."""

import numpy as np
from numpy.typing import NDArray

from formats.errors import QueryError
from formats.mesh import Mesh
from prt_bake.camera import Visibility
from prt_bake.lighting import Lighting
from prt_bake.reflection import Reflector

Array = NDArray[np.float64]


class SurfaceReflection:
    """What the surface of an object reflects, at the points of a pass."""

    def __init__(
        self,
        mesh: Mesh,
        lighting: Lighting,
        eta: float,
        roughness: float | NDArray[np.floating],
        interpolated: bool = False,
        visibility: Visibility | None = None,
    ) -> None:
        """`roughness` is the GGX alpha, or a texture [H,W] of it; `interpolated`: the interface uses vertex normals.

        Raises QueryError for a texture on a mesh without texture coordinates.
        """
        if isinstance(roughness, np.ndarray) and mesh.corner_uv is None:
            raise QueryError("reflection: roughness is a texture, but the mesh has no texture coordinates")
        self._mesh, self._roughness, self._interpolated = mesh, roughness, interpolated
        self._reflector = Reflector(mesh, lighting, eta, visibility)

    def radiance(
        self, faces: NDArray[np.int64], barycentric: Array, outgoing: Array, keys: NDArray[np.uint64], seed: int
    ) -> Array:
        """Radiance [N,3] reflected at faces [N] at (u, v) [N,2] towards outgoing [N,3]; keys [N] name the numbers."""
        normals = self._mesh.face_normals[faces]
        if self._interpolated:
            normals = _at(self._mesh.normals[self._mesh.faces[faces]], barycentric)
            normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        return self._reflector.reflected(
            faces, barycentric, normals, outgoing, self._alpha(faces, barycentric), keys, seed
        )

    def _alpha(self, faces: NDArray[np.int64], barycentric: Array) -> Array:
        """Bilinear and repeating, t = 0 at the lower edge of the bottom row, as walks look it up."""
        if not isinstance(self._roughness, np.ndarray):
            return np.full(len(faces), float(self._roughness))
        assert self._mesh.corner_uv is not None
        texture = np.asarray(self._roughness, np.float64)
        height, width = texture.shape
        place = _at(self._mesh.corner_uv[faces], barycentric)
        x, y = place[:, 0] * width - 0.5, (1.0 - place[:, 1]) * height - 0.5
        left, top = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
        across, down = x - left, y - top
        above, below = (
            (1.0 - across) * texture[row % height, left % width] + across * texture[row % height, (left + 1) % width]
            for row in (top, top + 1)
        )
        return np.asarray((1.0 - down) * above + down * below)


def _at(corners: Array, barycentric: Array) -> Array:
    """Values of corners [N,3,K] interpolated to (u, v) [N,2]."""
    weights = np.concatenate([1.0 - barycentric.sum(axis=1, keepdims=True), barycentric], axis=1)
    return np.asarray(np.einsum("nk,nkc->nc", weights, corners))
