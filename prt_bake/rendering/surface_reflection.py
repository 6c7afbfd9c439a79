"""Light reflected at the surface itself, as an addition to a picture: one sample at every point that is seen."""

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from formats.errors import QueryError
from formats.mesh import Mesh
from prt_bake.geometry.camera import Visibility
from prt_bake.lights.lighting import Lighting
from prt_bake.reflection.finish import interface_alpha, interface_normals
from prt_bake.reflection.reflector import Reflector

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
        self._mesh, self._roughness = mesh, np.asarray(roughness, np.float64)
        self._normals: Literal["face", "vertex"] = "vertex" if interpolated else "face"
        self._reflector = Reflector(mesh, lighting, eta, visibility)

    def radiance(
        self, faces: NDArray[np.int64], barycentric: Array, outgoing: Array, keys: NDArray[np.uint64], seed: int
    ) -> Array:
        """Radiance [N,3] reflected at faces [N] at (u, v) [N,2] towards outgoing [N,3]; keys [N] name the numbers."""
        normals = interface_normals(self._mesh, faces, barycentric, self._normals)
        alpha = interface_alpha(self._mesh, faces, barycentric, self._roughness)
        return self._reflector.reflected(faces, barycentric, normals, outgoing, alpha, keys, seed)
