"""Triangle soups, the common result of the PLY, OBJ, STL and glTF readers."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class SoupPart:
    """Copies of one primitive in a soup, one after another, for the words of errors.

    Attributes:
        place: where the primitive is in the file, as in "nodes[0], meshes[0].primitives[1]".
        first_vertex: the first of its vertices in the soup.
        first_face: the first of its faces.
        copies: how many of it there are.
        faces: number of faces of a copy.
        numbers: for each vertex of a copy its number in the primitive [n].
    """

    place: str
    first_vertex: int
    first_face: int
    copies: int
    faces: int
    numbers: NDArray[np.int64] | range

    def words(self, copy: int) -> str:
        """Return the place, and which copy it is of several."""
        return f" of {self.place}, copy {copy}" if self.copies > 1 else f" of {self.place}"


@dataclass(frozen=True)
class TriangleSoup:
    """Triangles as stored in a file, with nothing merged or checked.

    Attributes:
        positions: float64 [n,3].
        faces: int64 [F,3], indices into positions.
        corner_normals: float64 [F,3,3], or None.
        corner_uv: float64 [F,3,2], or None.
        parts: what the soup was joined from, in its order, if the file has several numberings of vertices and faces.
    """

    positions: NDArray[np.float64]
    faces: NDArray[np.int64]
    corner_normals: NDArray[np.float64] | None = None
    corner_uv: NDArray[np.float64] | None = None
    parts: tuple[SoupPart, ...] = ()

    def vertex_in_file(self, vertex: int) -> str:
        """Return words for a vertex by its number in the file, or in its part of the file: "vertex 5 of nodes[0]"."""
        part = next((part for part in reversed(self.parts) if part.first_vertex <= vertex), None)
        if part is None:
            return f"vertex {vertex}"
        copy, local = divmod(vertex - part.first_vertex, len(part.numbers))
        return f"vertex {part.numbers[local]}{part.words(copy)}"

    def face_in_file(self, face: int) -> str:
        """Return words for a face and its corners, as `vertex_in_file`."""
        corners = self.faces[face].tolist()
        part = next((part for part in reversed(self.parts) if part.first_face <= face), None)
        if part is None:
            return f"face {face} with corners {corners}"
        copy, local = divmod(face - part.first_face, part.faces)
        corners = [int(part.numbers[(corner - part.first_vertex) % len(part.numbers)]) for corner in corners]
        return f"face {local}{part.words(copy)} with corners {corners}"


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
