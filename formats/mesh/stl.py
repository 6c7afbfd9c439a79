"""STL, ascii and binary (3D Systems, "StereoLithography Interface Specification", 1988).

Only the vertices are read: the right-hand rule gives a facet's normal, and many programs write zeros in its place.

No library: trimesh reads a truncated or cut-off ascii file as one without faces or with fewer of them, ends a solid at
any name that holds its keywords, and a binary file with bytes after its facets as one without faces.
"""

import os
import re
from array import array
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from formats.errors import MeshError, warn
from formats.mesh.text_numbers import number_remedy, with_plain_nan
from formats.text import without_byte_order_mark
from formats.triangle_soup import TriangleSoup

_HEADER, _FACET = 84, 50  # bytes: 80 of text and the number of facets; 12 float32 and two bytes of attributes
_USUAL = {b"facet": 5, b"outer": 2, b"vertex": 4, b"endloop": 1, b"endfacet": 1}
"""Most words of a line that begins with a keyword, unless further keywords follow on the line."""
_KEYWORD = re.compile(rb"\s(?=(?:facet|outer|vertex|endloop|endfacet|endsolid)\b)", re.IGNORECASE)
_BEGINNING = 1000  # bytes; in a binary file some of them are zeros


def read_stl(path: str | os.PathLike[str]) -> TriangleSoup:
    """Read an STL file; every triangle has vertices of its own.

    Raises:
        MeshError: the file is not STL, is truncated, or holds another number of facets than its header says.
    """
    with open(path, "rb") as file:
        content = file.read()
    corners = _ascii(content, path) if _is_text(content) else _binary(content, path)
    return TriangleSoup(corners, np.arange(len(corners)).reshape(-1, 3))


def _is_text(content: bytes) -> bool:
    """Whether the file is ascii. The header of a binary one may begin with the word solid, too."""
    if len(content) >= _HEADER and len(content) == _HEADER + _FACET * _facets(content):
        return False
    return b"\0" not in content[:_BEGINNING] or content[:2] in (b"\xff\xfe", b"\xfe\xff")


def _facets(content: bytes) -> int:
    return int.from_bytes(content[_HEADER - 4 : _HEADER], "little")


def _binary(content: bytes, path: str | os.PathLike[str]) -> NDArray[np.float64]:
    if len(content) < _HEADER:
        raise MeshError(f"{path}: is not an STL file, or truncated: found {len(content)} bytes; export it again")
    facets, surplus = _facets(content), len(content) - _HEADER - _FACET * _facets(content)
    if not 0 <= surplus < _FACET:
        raise MeshError(
            f"{path}: is damaged or not an STL file: its header says {facets} facets, its size is that of "
            f"{(len(content) - _HEADER) / _FACET:.6g}; copy or export it again"
        )
    if surplus:
        warn(f"{path}: {surplus} bytes after the last of {facets} facets are ignored")
    rows = np.frombuffer(
        content, np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("rest", "<u2")]), facets, 84
    )
    return rows["corners"].reshape(-1, 3).astype(np.float64)


def _statements(text: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield statements and their lines. A line may hold several: only the name of a solid ends with its line."""
    for line, statement in enumerate(text.splitlines(), start=1):
        words = statement.split()
        if words and len(words) > _USUAL.get(words[0].lower(), len(words)):
            for part in _KEYWORD.split(statement):
                yield line, part
        else:
            yield line, statement


def _ascii(content: bytes, path: str | os.PathLike[str]) -> NDArray[np.float64]:
    numbers = array("d")
    facets, ended = 0, False
    text = with_plain_nan(without_byte_order_mark(content, path, MeshError))
    for line, statement in _statements(text):
        words = statement.split()
        try:
            match [word.lower() for word in words[:1]]:
                case [] | [b"facet" | b"outer" | b"endfacet"]:
                    pass
                case [b"solid" | b"endsolid" as word]:
                    ended = word == b"endsolid"
                case [b"vertex"]:
                    x, y, z = words[1:]
                    numbers.extend((float(x), float(y), float(z)))
                case [b"endloop"] if len(numbers) == 9 * (facets + 1):
                    facets += 1
                case _:
                    raise ValueError
        except ValueError as cause:
            found = statement.decode("utf-8", "replace").strip()[:80]
            raise MeshError(
                f"{path}: line {line}: expected an STL facet of three vertices, found {found!r}; "
                f"{number_remedy(statement)}"
            ) from cause
    if not ended or len(numbers) != 9 * facets:
        raise MeshError(
            f"{path}: is truncated: it ends after {facets} facets without endsolid; copy or export it again"
        )
    return np.array(numbers, np.float64).reshape(-1, 3)
