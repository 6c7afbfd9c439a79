"""Meshes for PyVista."""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from formats.errors import requires_pyvista

if TYPE_CHECKING:
    import pyvista


def polydata(
    positions: NDArray[np.float64], faces: NDArray[np.integer], normals: NDArray[np.float64]
) -> "pyvista.PolyData":
    """Return a `pyvista.PolyData` of these vertices [V,3], triangles [F,3] and vertex normals [V,3] ("Normals").

    Raises PrtbakeError if PyVista is not installed.
    """
    with requires_pyvista("to_pyvista"):
        import pyvista
    mesh = pyvista.PolyData.from_regular_faces(np.array(positions), np.array(faces))
    mesh.point_data.active_normals = normals.astype(np.float32)
    return mesh
