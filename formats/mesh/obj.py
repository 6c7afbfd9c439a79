"""Wavefront OBJ (Advanced Visualizer manual, appendix B1: http://paulbourke.net/dataformats/obj/).

Vertices, texture coordinates, normals and polygons are read; materials, groups, lines, curves and free-form surfaces
are ignored.

No library: trimesh reads a file with a damaged vertex as a point cloud, accepts index 0, fails at a comment after a
face, names no line in its errors and writes 8 decimals.
"""

import os
from array import array
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from formats.errors import MeshError, warn
from formats.mesh.text_numbers import number_remedy, with_plain_nan
from formats.mesh.triangulation import refuse_absent, triangulate
from formats.text import without_byte_order_mark
from formats.triangle_soup import TriangleSoup

_MISSING = -(2**31)  # a corner without texture coordinate or normal
_UNWRAP = "the others' are not used, unwrap the whole mesh if a texture needs them"
_READ = (b"v", b"vt", b"vn", b"f", b"fo", b"surf")


class _AbsentVertexError(IndexError):
    """A vertex, counted backwards, that is before the first one; its argument is the number as written."""


class _Tables:
    """The content of a file; positions, texture coordinates and normals have separate indices."""

    def __init__(self) -> None:
        self.v, self.vt, self.vn = array("d"), array("d"), array("d")
        self.corners = array("q")  # three indices per corner, from 0: position, texture coordinate, normal
        self.sizes, self.lines = array("q"), array("q")  # number of corners and line of each face
        self.curved = 0  # line of the first free-form surface

    def add_statement(self, line: int, words: list[bytes]) -> None:
        """Add the words of one statement; raises ValueError, IndexError or OverflowError if they are malformed."""
        match words[0]:
            case b"v":
                self.v.extend((float(words[1]), float(words[2]), float(words[3])))
            case b"vn":
                self.vn.extend((float(words[1]), float(words[2]), float(words[3])))
            case b"vt":
                self.vt.extend((float(words[1]), float(words[2]) if len(words) > 2 else 0.0))
            case b"f" | b"fo":
                for word in words[1:]:
                    self.corners.extend(self._corner(word))
                self.sizes.append(len(words) - 1)
                self.lines.append(line)
            case b"surf":
                self.curved = self.curved or line

    def _corner(self, word: bytes) -> tuple[int, int, int]:
        parts = [*word.split(b"/"), b"", b""]
        position = _index(parts[0], len(self.v) // 3)
        if position == _MISSING:
            raise ValueError
        if position < 0:
            raise _AbsentVertexError(int(parts[0]))
        return position, _index(parts[1], len(self.vt) // 2), _index(parts[2], len(self.vn) // 3)


def read_obj(path: str | os.PathLike[str]) -> TriangleSoup:
    """Read an OBJ file. Polygons are triangulated; vertices keep the numbering of the file.

    Raises:
        MeshError: the file is not text, a line is malformed, or a polygon crosses itself (the message names the line).
    """
    with open(path, "rb") as file:
        content = without_byte_order_mark(file.read(), path, MeshError)
    if b"\0" in content:
        raise MeshError(f"{path}: is not an OBJ file: expected text, found binary data; export it again")
    tables = _Tables()
    for number, words in _statements(with_plain_nan(content)):
        try:
            tables.add_statement(number, words)
        except _AbsentVertexError as cause:
            raise MeshError(
                f"{path}: line {number}: a face uses vertex {cause.args[0]}, but only {len(tables.v) // 3} vertices "
                f"come before it; export the mesh again"
            ) from cause
        except (ValueError, IndexError, OverflowError) as cause:
            found = b" ".join(words).decode("utf-8", "replace")[:80]
            raise MeshError(
                f"{path}: line {number}: expected an OBJ statement, found {found!r}; {number_remedy(found.encode())}"
            ) from cause
    return _soup(tables, path)


def _statements(content: bytes) -> Iterator[tuple[int, list[bytes]]]:
    """Yield the words of each statement that is read, and the number of its last line; a final backslash continues it.

    Paths in other statements and comments may end in a backslash, too.
    """
    words: list[bytes] = []
    number = 0
    for number, line in enumerate(content.splitlines(), start=1):
        words += line.split(b"#", 1)[0].split()
        if not words or words[0] not in _READ:
            words = []
        elif words[-1].endswith(b"\\"):
            words[-1:] = [words[-1][:-1]] if words[-1] != b"\\" else []
        else:
            yield number, words
            words = []
    if words:
        yield number, words


def write_obj(
    path: str | os.PathLike[str],
    positions: NDArray[np.float64],
    faces: NDArray[np.integer],
    normals: NDArray[np.float64],
    uv: NDArray[np.float64] | None,
) -> None:
    """Write OBJ text with 17 digits, which preserve float64 exactly.

    `uv` is [V,2], or [F,3,2] if seams need one pair per corner, or None.
    """
    pairs, corners = _index_uv(uv, faces)
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


def _index_uv(
    uv: NDArray[np.float64] | None, faces: NDArray[np.integer]
) -> tuple[NDArray[np.float64], NDArray[np.integer]]:
    """Return the distinct texture coordinates [n,2] and the index of each corner's pair [F,3]."""
    if uv is None:
        return np.zeros((0, 2)), faces
    if uv.ndim == 2:
        return uv, faces
    pairs, index = np.unique(uv.reshape(-1, 2), axis=0, return_inverse=True)
    return pairs, index.reshape(-1, 3)


def _index(word: bytes, count: int) -> int:
    """Convert the file's index, from 1 or backwards from -1, to one from 0."""
    if not word:
        return _MISSING
    index = int(word)
    if index == 0:
        raise ValueError
    return index - 1 if index > 0 else count + index


def _soup(tables: _Tables, path: str | os.PathLike[str]) -> TriangleSoup:
    if tables.curved:
        found = f"{path}: line {tables.curved}: is a free-form surface, such as NURBS"
        if not tables.sizes:
            raise MeshError(f"{found}; expected polygons; export it as a polygon mesh")
        warn(f"{found}, and ignored; export the whole object as a polygon mesh")
    positions = np.array(tables.v, np.float64).reshape(-1, 3)
    corners = np.array(tables.corners, np.int64).reshape(-1, 3)
    sizes = np.array(tables.sizes, np.int64)
    refuse_absent(corners[:, 0], sizes, len(positions), path, lambda face: f"line {tables.lines[face]}", base=1)
    triangles = triangulate(positions, corners[:, 0], sizes, lambda face: f"{path}: line {tables.lines[face]}")
    pairs = np.array(tables.vt, np.float64).reshape(-1, 2)
    _warn_of_missing_values(tables, corners[:, 1], sizes, len(pairs), path, "texture coordinates", _UNWRAP)
    uv = _corner_values(pairs, corners[triangles, 1])
    vectors = np.array(tables.vn, np.float64).reshape(-1, 3)
    _warn_of_missing_values(tables, corners[:, 2], sizes, len(vectors), path, "normals", "those of the faces are used")
    normals = _corner_values(vectors, corners[triangles, 2])
    return TriangleSoup(positions, corners[triangles, 0], normals, uv)


def _warn_of_missing_values(
    tables: _Tables,
    index: NDArray[np.int64],
    sizes: NDArray[np.int64],
    rows: int,
    path: str | os.PathLike[str],
    what: str,
    instead: str,
) -> None:
    """Warn if some corners have values and others have none, or values that do not exist."""
    missing = (index < 0) | (index >= rows)
    if missing.any() and (index != _MISSING).any():
        face = int(np.searchsorted(np.cumsum(sizes), missing.argmax(), side="right"))
        warn(
            f"{path}: {missing.sum()} of {len(missing)} corners of faces have no {what}, the first in line "
            f"{tables.lines[face]}; {instead}"
        )


def _corner_values(rows: NDArray[np.float64], index: NDArray[np.int64]) -> NDArray[np.float64] | None:
    """Return the row of each corner, or None if any corner has none."""
    if index.size == 0 or index.min() < 0 or index.max() >= len(rows):
        return None
    return rows[index]
