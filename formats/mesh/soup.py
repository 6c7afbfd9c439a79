"""What the readers of PLY, OBJ and glTF hand over: vertices as the file numbers them, and triangles."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class TriangleSoup:
    """Triangles as a file holds them, nothing merged or checked.

    Attributes:
        positions: float64 [n,3].
        faces: int64 [F,3], indices into positions.
        corner_normals: float64 [F,3,3], or None if the file has none.
        corner_uv: float64 [F,3,2], or None if the file has none.
    """

    positions: NDArray[np.float64]
    faces: NDArray[np.int64]
    corner_normals: NDArray[np.float64] | None = None
    corner_uv: NDArray[np.float64] | None = None


def fan(sizes: NDArray[np.integer]) -> NDArray[np.int64]:
    """Cut polygons into triangle fans about their first corner.

    Args:
        sizes: number of corners of each polygon [P]; the corners of all polygons lie one after the other in one list.

    Returns:
        Places in that list [F,3], in the order of the polygons; polygons of fewer than three corners give no triangle.
    """
    starts = np.cumsum(sizes) - sizes
    triangles = np.maximum(sizes - 2, 0)
    start = np.repeat(starts, triangles)
    step = np.arange(len(start)) - np.repeat(np.cumsum(triangles) - triangles, triangles)
    return np.stack([start, start + step + 1, start + step + 2], axis=1).astype(np.int64)
