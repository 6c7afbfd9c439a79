"""Light reflected at the surface as an addition to a picture: one sample at every visible point."""

import numpy as np
from numpy.typing import NDArray

from formats.errors import QueryError
from formats.mesh import Mesh, texture_fault
from prt_bake.geometry.camera import Visibility
from prt_bake.lights.lighting import Lighting
from prt_bake.reflection.finish import Normals, chosen_normals, surface_points
from prt_bake.reflection.reflector import Reflector
from prt_bake.rendering.object_points import ObjectPoints

Array = NDArray[np.float64]


class SurfaceReflection:
    """Samples the light reflected at the surface of an object, at the points of a pass."""

    def __init__(
        self,
        mesh: Mesh,
        lighting: Lighting,
        eta: float,
        roughness: float | NDArray[np.floating],
        normals: Normals | None = None,
        visibility: Visibility | None = None,
    ) -> None:
        """`roughness` is the GGX alpha, a number or a texture [H,W]; `normals` are as in `chosen_normals`.

        Raises QueryError for a texture on a mesh without texture coordinates, or with unusable ones.
        """
        if isinstance(roughness, np.ndarray) and mesh.corner_uv is None:
            raise QueryError(
                "reflection: roughness is a texture, but the mesh has no texture coordinates; unwrap the mesh, or "
                "render without reflection"
            )
        if isinstance(roughness, np.ndarray) and (fault := texture_fault(mesh)):
            raise QueryError(f"reflection: roughness is a texture, but {fault}")
        self._mesh, self._roughness = mesh, np.asarray(roughness, np.float64)
        self.normals = chosen_normals(mesh, normals)
        self._reflector = Reflector(mesh, lighting, eta, visibility)

    def radiance(self, points: ObjectPoints, seed: int) -> Array:
        """Radiance [N,3] reflected at the points towards the eye."""
        faces, barycentric, outgoing, keys = points
        on_surface = surface_points(self._mesh, faces, barycentric, outgoing, self.normals, self._roughness)
        return self._reflector.reflected(on_surface, keys, seed)


def reflection_identity(surface: SurfaceReflection | None) -> dict[str, str]:
    """What a checkpoint states about the reflection: the kind of its normals."""
    return {} if surface is None else {"normals of the reflection": surface.normals}
