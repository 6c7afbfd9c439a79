"""Triangle soups, the common result of the PLY, OBJ and glTF readers."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class TriangleSoup:
    """Triangles as stored in a file, with nothing merged or checked.

    Attributes:
        positions: float64 [n,3].
        faces: int64 [F,3], indices into positions.
        corner_normals: float64 [F,3,3], or None.
        corner_uv: float64 [F,3,2], or None.
    """

    positions: NDArray[np.float64]
    faces: NDArray[np.int64]
    corner_normals: NDArray[np.float64] | None = None
    corner_uv: NDArray[np.float64] | None = None


def fan(sizes: NDArray[np.integer]) -> NDArray[np.int64]:
    """Triangulate polygons as fans about their first corner.

    Args:
        sizes: number of corners of each polygon [P]; the corners of all polygons are concatenated in one list.

    Returns:
        Indices into that list [F,3], in polygon order; a polygon of fewer than three corners has no triangle.
    """
    starts = np.cumsum(sizes) - sizes
    triangles = np.maximum(sizes - 2, 0)
    start = np.repeat(starts, triangles)
    step = np.arange(len(start)) - np.repeat(np.cumsum(triangles) - triangles, triangles)
    return np.stack([start, start + step + 1, start + step + 2], axis=1).astype(np.int64)
