"""The header of a PLY file (Greg Turk, "The PLY Polygon File Format", 1994: http://paulbourke.net/dataformats/ply/).

Lines may end in LF, CR LF or CR. Integers of 64 bits and halves are not in the standard, but in files.
"""

import os
import re

from formats.errors import MeshError
from formats.mesh.ply_body import Element, Property

_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4"},
    **{"double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float32": "f4", "float64": "f8", "int64": "i8", "uint64": "u8", "float16": "f2", "half": "f2"},
}
_BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}
_DIGITS = 18  # of the number of rows; any such number fits into int64


def read_header(content: bytes, path: str | os.PathLike[str]) -> tuple[str, list[Element], int]:
    """Return the byte order (empty for ascii), the elements in file order and the offset of the body.

    Raises:
        MeshError: the file is not PLY, its header has no end, or a line is malformed.
    """
    first_line = re.match(rb"ply[ \t]*(\r\n|\n|\r)", content)
    if first_line is None:
        raise MeshError(f"{path}: is not a PLY file: expected 'ply' in the first line, found {content[:4]!r}")
    line_end = b"\r" if first_line[1] == b"\r" else b"\n"
    encoding: str | None = None
    elements: list[Element] = []
    number, start = 1, first_line.end()
    while True:
        number, end = number + 1, content.find(line_end, start)
        if end < 0:
            raise MeshError(f"{path}: the PLY header has no line end_header; the file is truncated, export it again")
        line, start = content[start:end].decode("ascii", "replace").strip(), end + 1
        match line.split():
            case ["end_header", *_]:
                break
            case ["format", name, *_] if name in _BYTE_ORDERS:
                encoding = _BYTE_ORDERS[name]
            case words:
                _add_line(words, elements, f"{path}: line {number} of the PLY header")
    if encoding is None:
        raise MeshError(f"{path}: the PLY header has no format line; expected ascii or binary")
    return encoding, elements, start


def _add_line(words: list[str], elements: list[Element], place: str) -> None:
    """Add an element or a property to the elements."""
    match words:
        case [] | ["comment" | "obj_info", *_]:
            return
        case ["element", name, rows] if (
            rows.isdecimal() and len(rows) <= _DIGITS and all(element.name != name for element in elements)
        ):
            elements.append(Element(name, int(rows)))
            return
        case ["property", "list", count_kind, kind, name] if elements and {count_kind, kind} <= _TYPES.keys():
            added = Property(name, _TYPES[kind], _TYPES[count_kind])
        case ["property", kind, name] if elements and kind in _TYPES:
            added = Property(name, _TYPES[kind])
        case _:
            raise MeshError(
                f"{place}: expected format, a new element or a property of a known type, "
                f"found {' '.join(words)!r:.80}; export the mesh again"
            )
    if any(known.name == added.name for known in elements[-1].properties):
        raise MeshError(
            f"{place}: the element {elements[-1].name} has the property {added.name!r} twice; export it again"
        )
    elements[-1].properties.append(added)
