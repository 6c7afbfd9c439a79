"""The rows of a PLY file, ascii or binary: single values and lists of varying length.

Format: http://paulbourke.net/dataformats/ply/. No library, for the reasons in `formats.mesh.ply`.
"""

import os
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from formats.errors import MeshError
from formats.mesh.text_numbers import number_remedy, with_plain_nan


@dataclass(frozen=True)
class Property:
    """One property of an element; `kind` and `count_kind` are NumPy type codes without byte order."""

    name: str
    kind: str
    count_kind: str = ""  # type of a list's length; empty for a single value


@dataclass
class Element:
    """One element of the header: `rows` rows with these properties, in file order."""

    name: str
    rows: int
    properties: list[Property] = field(default_factory=list)


@dataclass(frozen=True)
class Lists:
    """The lists of one property: their lengths int64 [rows], and the values of all lists, concatenated."""

    sizes: NDArray[np.int64]
    values: NDArray[np.float64]


Columns = dict[str, NDArray[np.float64] | Lists]


class PlyBody:
    """The body of a PLY file, read element by element. An ascii body is converted to binary float64 first."""

    def __init__(self, content: bytes, byte_order: str, path: str | os.PathLike[str]) -> None:
        """Open the bytes after the header; `byte_order` is "<", ">" or, for ascii, empty."""
        self._path = path
        self._order = byte_order or "="
        self._text = not byte_order
        self._bytes = _numbers(content, path).tobytes() if self._text else content
        self._offset = 0

    def columns(self, element: Element) -> Columns:
        """Return the next element's properties by name.

        Raises:
            MeshError: the body ends before the element's last row.
        """
        if not element.properties:
            return {}
        start = self._offset
        sizes = self._read_rows(element, min(element.rows, 1))[1]
        self._offset = start
        # Nearly every file has lists of one length (triangles); those are read in one step.
        table = self._uniform_columns(element, [int(column[0]) if len(column) else 0 for column in sizes])
        if table is not None:
            return table
        values, lengths = self._read_rows(element, element.rows)
        return {
            entry.name: Lists(np.array(lengths[i], np.int64), _concatenate(values[i]))
            if entry.count_kind
            else _concatenate(values[i])
            for i, entry in enumerate(element.properties)
        }

    @property
    def surplus(self) -> int:
        """Bytes after the last element that was read, or numbers of an ascii file; white space does not count."""
        rest = self._bytes[self._offset :]
        return len(rest) // 8 if self._text else len(rest.strip())

    def _uniform_columns(self, element: Element, sizes: list[int]) -> Columns | None:
        fields: list[Any] = []
        for i, (entry, size) in enumerate(zip(element.properties, sizes, strict=True)):
            if entry.count_kind:
                fields.append((f"count {i}", self._type(entry.count_kind)))
            fields.append((f"values {i}", self._type(entry.kind), (size if entry.count_kind else 1,)))
        layout = np.dtype(fields)
        if self._offset + element.rows * layout.itemsize > len(self._bytes):
            return None
        table = np.frombuffer(self._bytes, layout, element.rows, self._offset)
        columns: Columns = {}
        for i, (entry, size) in enumerate(zip(element.properties, sizes, strict=True)):
            values = table[f"values {i}"].astype(np.float64).ravel()
            if entry.count_kind and (table[f"count {i}"] != size).any():
                return None
            columns[entry.name] = Lists(np.full(element.rows, size, np.int64), values) if entry.count_kind else values
        self._offset += element.rows * layout.itemsize
        return columns

    def _read_rows(self, element: Element, rows: int) -> tuple[list[list[NDArray[np.float64]]], list[list[int]]]:
        """Read row by row; return for each property the values of every row, and the length of every list."""
        values: list[list[NDArray[np.float64]]] = [[] for _ in element.properties]
        lengths: list[list[int]] = [[] for _ in element.properties]
        for row in range(rows):
            for i, entry in enumerate(element.properties):
                length = float(self._read_values(entry.count_kind, 1, element, row)[0]) if entry.count_kind else 1.0
                if not (length >= 0 and length.is_integer()):
                    raise MeshError(
                        f"{self._path}: is damaged: row {row} of element {element.name} has a list of length "
                        f"{length:g}; export it again"
                    )
                lengths[i].append(int(length))
                values[i].append(self._read_values(entry.kind, int(length), element, row))
        return values, lengths

    def _read_values(self, kind: str, count: int, element: Element, row: int) -> NDArray[np.float64]:
        type_ = self._type(kind)
        if self._offset + count * type_.itemsize > len(self._bytes):
            raise MeshError(
                f"{self._path}: is truncated: it ends in row {row} of element {element.name}, expected {element.rows} "
                f"rows; copy or export it again"
            )
        values = np.frombuffer(self._bytes, type_, count, self._offset).astype(np.float64)
        self._offset += count * type_.itemsize
        return values

    def _type(self, kind: str) -> np.dtype[Any]:
        return np.dtype(np.float64) if self._text else np.dtype(kind).newbyteorder(self._order)  # type: ignore[arg-type]


def _numbers(body: bytes, path: str | os.PathLike[str]) -> NDArray[np.float64]:
    try:
        return np.array(with_plain_nan(body).split(), dtype=np.float64)
    except ValueError as cause:
        raise MeshError(f"{path}: the PLY body is damaged: {cause}; {number_remedy(str(cause).encode())}") from cause


def _concatenate(rows: list[NDArray[np.float64]]) -> NDArray[np.float64]:
    return np.concatenate(rows) if rows else np.zeros(0)
