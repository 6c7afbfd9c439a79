"""Meshes for PyVista."""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from formats.extras import require

if TYPE_CHECKING:
    import pyvista


def polydata(
    positions: NDArray[np.float64], faces: NDArray[np.integer], normals: NDArray[np.float64]
) -> "pyvista.PolyData":
    """Return a `pyvista.PolyData` of these vertices [V,3], triangles [F,3] and vertex normals [V,3] ("Normals").

    Raises PrtbakeError if PyVista is not installed.
    """
    require("to_pyvista", "pyvista")
    import pyvista

    mesh = pyvista.PolyData.from_regular_faces(np.array(positions), np.array(faces))
    mesh.point_data.active_normals = normals.astype(np.float32)
    return mesh
