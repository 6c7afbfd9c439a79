"""Wavefront OBJ: vertices, texture coordinates, normals and polygons; materials, groups and curves are passed over.

Format: "Object Files (.obj)", Wavefront Advanced Visualizer manual, appendix B1, http://paulbourke.net/dataformats/obj/.

No library: trimesh reads a file with a damaged vertex as a point cloud, accepts index 0, fails at a comment after a
face, names no line in its errors and writes 8 decimals.
"""

import os
from array import array

import numpy as np
from numpy.typing import NDArray

from formats.errors import MeshError
from formats.mesh.soup import TriangleSoup, fan

_MISSING = -(2**31)  # a corner without texture coordinate or normal


class _Tables:
    """What the lines of a file add up to; positions, texture coordinates and normals are numbered apart."""

    def __init__(self) -> None:
        self.v, self.vt, self.vn = array("d"), array("d"), array("d")
        self.corners = array("q")  # three numbers a corner: position, texture coordinate, normal, from 0
        self.sizes = array("q")

    def take(self, words: list[str]) -> None:
        """Take the words of one line; raises ValueError or IndexError where they make no sense."""
        match words[0]:
            case "v":
                self.v.extend((float(words[1]), float(words[2]), float(words[3])))
            case "vn":
                self.vn.extend((float(words[1]), float(words[2]), float(words[3])))
            case "vt":
                self.vt.extend((float(words[1]), float(words[2]) if len(words) > 2 else 0.0))
            case "f":
                for word in words[1:]:
                    self.corners.extend(self._corner(word))
                self.sizes.append(len(words) - 1)

    def _corner(self, word: str) -> tuple[int, int, int]:
        parts = [*word.split("/"), "", ""]
        position = _index(parts[0], len(self.v) // 3)
        if position == _MISSING:
            raise ValueError
        return position, _index(parts[1], len(self.vt) // 2), _index(parts[2], len(self.vn) // 3)


def read_obj(path: str | os.PathLike[str]) -> TriangleSoup:
    """Read an OBJ file; polygons are cut into fans, vertices keep the file's numbering.

    Raises:
        MeshError: the file is no OBJ text, or a line is damaged (the line is named).
    """
    with open(path, "rb") as file:
        content = file.read()
    if b"\0" in content:
        raise MeshError(f"{path}: is not an OBJ file: it is not text")
    tables = _Tables()
    lines = content.decode("utf-8", "replace").replace("\\\r\n", " ").replace("\\\n", " ").splitlines()
    for number, line in enumerate(lines, start=1):
        words = line.split("#", 1)[0].split()
        if not words:
            continue
        try:
            tables.take(words)
        except (ValueError, IndexError) as cause:
            raise MeshError(f"{path}: line {number} is not understood: {line.strip()[:80]!r}") from cause
    return _soup(tables)


def write_obj(
    path: str | os.PathLike[str],
    positions: NDArray[np.float64],
    faces: NDArray[np.integer],
    normals: NDArray[np.float64],
    uv: NDArray[np.float64] | None,
) -> None:
    """Write OBJ text with 17 digits, so that reading it gives the same float64 numbers back.

    `uv` is [V,2], or [F,3,2] where seams need one pair a corner, or None.
    """
    pairs, corners = _numbered(uv, faces)
    rows = [f"v {x:.17g} {y:.17g} {z:.17g}" for x, y, z in positions]
    rows += [f"vn {x:.17g} {y:.17g} {z:.17g}" for x, y, z in normals]
    rows += [f"vt {u:.17g} {v:.17g}" for u, v in pairs]
    corner = "{0}//{0}" if uv is None else "{0}/{1}/{0}"
    rows += [
        "f " + " ".join(corner.format(index + 1, pair + 1) for index, pair in zip(face, textured, strict=True))
        for face, textured in zip(faces.tolist(), corners.tolist(), strict=True)
    ]
    with open(path, "w", encoding="ascii", newline="\n") as file:
        file.write("\n".join([*rows, ""]))


def _numbered(
    uv: NDArray[np.float64] | None, faces: NDArray[np.integer]
) -> tuple[NDArray[np.float64], NDArray[np.integer]]:
    """Return the pairs to write [n,2] and each corner's place among them [F,3]."""
    if uv is None:
        return np.zeros((0, 2)), faces
    if uv.ndim == 2:
        return uv, faces
    pairs, places = np.unique(uv.reshape(-1, 2), axis=0, return_inverse=True)
    return pairs, places.reshape(-1, 3)


def _index(word: str, count: int) -> int:
    """Turn the file's index, from 1 or counted back from -1, into one from 0."""
    if not word:
        return _MISSING
    index = int(word)
    if index == 0:
        raise ValueError
    return index - 1 if index > 0 else count + index


def _soup(tables: _Tables) -> TriangleSoup:
    positions = np.array(tables.v, np.float64).reshape(-1, 3)
    corners = np.array(tables.corners, np.int64).reshape(-1, 3)[fan(np.array(tables.sizes, np.int64))]
    uv = _looked_up(np.array(tables.vt, np.float64).reshape(-1, 2), corners[..., 1])
    normals = _looked_up(np.array(tables.vn, np.float64).reshape(-1, 3), corners[..., 2])
    return TriangleSoup(positions, corners[..., 0], normals, uv)


def _looked_up(rows: NDArray[np.float64], index: NDArray[np.int64]) -> NDArray[np.float64] | None:
    """Return the rows at every corner, or None unless every corner has one."""
    if index.size == 0 or index.min() < 0 or index.max() >= len(rows):
        return None
    return rows[index]
