"""The arrays of a glTF file: accessors, also sparse, normalised and interleaved (glTF 2.0, section 3.6.2).

Every range is checked against its buffer before memory is allocated. `rows` are the elements to return, if not all.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from formats.mesh.gltf.buffers import Buffers
from formats.mesh.gltf.container import GltfFile
from formats.mesh.gltf.schema import Accessor, Sparse

_COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
_UNSIGNED: dict[int, np.dtype[Any]] = {5121: np.dtype("u1"), 5123: np.dtype("<u2"), 5125: np.dtype("<u4")}
_NUMBERS: dict[int, np.dtype[Any]] = {5120: np.dtype("i1"), 5122: np.dtype("<i2"), 5126: np.dtype("<f4"), **_UNSIGNED}

Stored = NDArray[Any]  # of one of these types
Rows = NDArray[np.int64] | None


@dataclass(frozen=True)
class _Layout:
    """Elements in a buffer view; `packed`: not interleaved with others."""

    kind: np.dtype[Any]
    components: int
    packed: bool = False

    @property
    def size(self) -> int:
        return self.kind.itemsize * self.components


class Accessors:
    """The accessors of a file. `where` is the place of the reference, for errors: `meshes[0].primitives[0].indices`."""

    def __init__(self, file: GltfFile) -> None:
        self._file = file
        self._buffers = Buffers(file)

    @property
    def bytes_read(self) -> int:
        """The number of bytes of the file and of the buffers that have been read."""
        return self._buffers.bytes_read

    def record(self, index: int, where: str) -> Accessor:
        """Return the record of an accessor; raises MeshError if it does not exist."""
        return self._file.entry("accessor", self._file.records.accessors, index, where)

    def floats(
        self, index: int, shape: str, where: str, count: int | None = None, rows: Rows = None
    ) -> NDArray[np.float64]:
        """Return `count` elements of type `shape` as rows [count,components]; normalised integers are scaled.

        Raises:
            MeshError: the accessor does not exist, has another type or count, or lies outside of its buffer.
        """
        values = self._elements(index, shape, where, count, rows)
        if values.dtype.kind == "f" or not self.record(index, where).normalized:
            return values.astype(np.float64)
        scaled: NDArray[np.float64] = np.maximum(values / np.float64(np.iinfo(values.dtype).max), -1.0)
        return scaled

    def integers(
        self, index: int, shape: str, where: str, count: int | None = None, rows: Rows = None, packed: bool = False
    ) -> NDArray[np.integer]:
        """Return elements of unsigned integers as rows [count,components]; raises as `floats`."""
        values = self._elements(index, shape, where, count, rows, packed)
        if values.dtype.kind != "u" or self.record(index, where).normalized:
            raise self._file.fault(where, f"accessor {index} does not hold unsigned integers")
        return values

    def indices(self, index: int, where: str, vertices: int) -> NDArray[np.int64]:
        """Return the corners of a primitive [count], each below `vertices`; raises as `floats`."""
        stored = self.integers(index, "SCALAR", where, packed=True)[:, 0]
        restart = np.iinfo(stored.dtype).max
        if (stored == restart).any():
            raise self._file.fault(where, f"contains {restart}, the mark that restarts a strip, which glTF forbids")
        outside = stored >= vertices
        if outside.any():
            raise self._file.fault(
                where,
                f"{outside.sum()} of {len(stored)} indices are vertices that do not exist, the first is "
                f"{stored[outside.argmax()]}, expected less than {vertices}",
            )
        return stored.astype(np.int64)

    def _elements(
        self, index: int, shape: str, where: str, count: int | None, rows: Rows, packed: bool = False
    ) -> Stored:
        """Return elements as they are stored, with sparse values replaced."""
        accessor = self.record(index, where)
        place = f"{where} (accessors[{index}])"
        if accessor.type != shape:
            raise self._file.fault(place, f"expected type {shape}, found {accessor.type[:20]!r}")
        if accessor.componentType not in _NUMBERS:
            known = ", ".join(map(str, _NUMBERS))
            raise self._file.fault(place, f"componentType: expected one of {known}, found {accessor.componentType}")
        if count is not None and accessor.count != count:
            raise self._file.fault(place, f"expected {count} elements, found {accessor.count}")
        layout = _Layout(_NUMBERS[accessor.componentType], _COMPONENTS[shape], packed)
        values = self._base(accessor, layout, place)
        if accessor.sparse is not None:
            chosen, replacements = self._sparse(accessor.sparse, accessor.count, layout, place)
            values = values.copy()
            values[chosen] = replacements
        return values if rows is None else values[rows]

    def _base(self, accessor: Accessor, layout: _Layout, place: str) -> Stored:
        """Return the elements without sparse values: zeros if there is no buffer view."""
        if accessor.bufferView is not None:
            return self._stored(accessor.bufferView, accessor.byteOffset, accessor.count, layout, place)
        # Only elements that triangles use are of worth, and an index takes at least a byte.
        if accessor.count > self._buffers.bytes_read:
            raise self._file.fault(place, f"has {accessor.count} elements, more than the file has bytes")
        return np.zeros((accessor.count, layout.components), layout.kind)

    def _sparse(self, sparse: Sparse, count: int, layout: _Layout, place: str) -> tuple[NDArray[np.int64], Stored]:
        """Return the indices of the sparse values [n], ascending and below `count`, and the values [n,components]."""
        indices, values = sparse.indices, sparse.values
        where = f"{place}.sparse.indices"
        if indices.componentType not in _UNSIGNED:
            known = ", ".join(map(str, _UNSIGNED))
            raise self._file.fault(where, f"componentType: expected one of {known}, found {indices.componentType}")
        unsigned = _Layout(_UNSIGNED[indices.componentType], 1, packed=True)
        stored = self._stored(indices.bufferView, indices.byteOffset, sparse.count, unsigned, where)
        chosen = stored[:, 0].astype(np.int64)
        if (np.diff(chosen) <= 0).any() or (chosen >= count).any():
            raise self._file.fault(where, f"expected ascending indices below {count}")
        packed = _Layout(layout.kind, layout.components, packed=True)
        where = f"{place}.sparse.values"
        return chosen, self._stored(values.bufferView, values.byteOffset, sparse.count, packed, where)

    def _stored(self, view_index: int, offset: int, count: int, layout: _Layout, place: str) -> Stored:
        """Return elements of a buffer view [count,components], without a copy."""
        data, view = self._buffers.view(view_index, place)
        stride = view.byteStride or layout.size
        if stride < layout.size or (layout.packed and stride != layout.size):
            expected = f"none or {layout.size}" if layout.packed else f"at least {layout.size}"
            where = f"{place}: bufferViews[{view_index}].byteStride"
            raise self._file.fault(where, f"expected {expected}, found {stride}")
        if count == 0:
            return np.zeros((0, layout.components), layout.kind)
        end = offset + stride * (count - 1) + layout.size
        if end > len(data):
            place = f"{place}: ends at byte {end} of bufferViews[{view_index}]"
            raise self._file.fault(place, f"expected at most its {len(data)} bytes")
        return np.ndarray((count, layout.components), layout.kind, data, offset, (stride, layout.kind.itemsize))
