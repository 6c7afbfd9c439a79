"""Writes binary glTF 2.0 (https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html): JSON and one buffer.

Own writer: trimesh writes neither normalised integers nor a mesh's extras, pygltflib leaves accessors to its caller.
"""

import json
import os
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from formats.atomic import replacing
from formats.errors import StorageError

_MAGIC, _VERSION, _JSON, _BINARY = 0x46546C67, 2, 0x4E4F534A, 0x004E4942
_VERTICES, _INDICES = 34962, 34963
_COMPONENTS = {"int8": 5120, "uint8": 5121, "uint16": 5123, "uint32": 5125, "float32": 5126}
_TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
_ALIGNMENT = 4
_LARGEST = 2**32 - 1
"""Bytes of a file: its length is stored in 32 bits."""


class Buffer:
    """The binary part of a file, with the lists `accessors` and `views` of its JSON.

    `content`, `accessors` and `views` may be those of a file that is extended.
    """

    def __init__(
        self, content: bytes = b"", accessors: list[dict[str, Any]] | None = None, views: list[Any] | None = None
    ) -> None:
        self.accessors = accessors if accessors is not None else []
        self.views = views if views is not None else []
        self._parts = [content]
        self._length = len(content)

    def add_vertices(self, values: NDArray[Any], bounds: bool = False, normalised: bool = False) -> int:
        """Add an attribute [V,n] and return its accessor; rows are padded to 4 bytes, `bounds` adds min and max."""
        row = values.shape[1] * values.itemsize
        padding = -row % _ALIGNMENT
        content = values
        if padding:
            content = np.zeros((len(values), row + padding), np.uint8)
            content[:, :row] = np.ascontiguousarray(values).view(np.uint8).reshape(len(values), row)
        view = self._add_view(content, {"target": _VERTICES, **({"byteStride": row + padding} if padding else {})})
        extents = {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()} if bounds else {}
        return self._add_accessor(view, values, extents | ({"normalized": True} if normalised else {}))

    def add_indices(self, faces: NDArray[np.integer], vertices: int) -> int:
        """Add the triangles [F,3] and return their accessor."""
        kind = np.uint16 if vertices < 2**16 else np.uint32
        indices = np.ascontiguousarray(faces, kind).reshape(-1, 1)
        return self._add_accessor(self._add_view(indices, {"target": _INDICES}), indices, {})

    def content(self) -> bytes:
        """The bytes of the buffer."""
        return b"".join(self._parts)

    def _add_view(self, values: NDArray[Any], entries: dict[str, Any]) -> int:
        gap = -self._length % _ALIGNMENT
        content = np.ascontiguousarray(values).tobytes()
        self._parts += [b"\0" * gap, content]
        view = {"buffer": 0, "byteOffset": self._length + gap, "byteLength": len(content)}
        self._length += gap + len(content)
        self.views.append(view | entries)
        return len(self.views) - 1

    def _add_accessor(self, view: int, values: NDArray[Any], entries: dict[str, Any]) -> int:
        kind = _COMPONENTS[values.dtype.name]
        accessor = {"bufferView": view, "componentType": kind, "count": len(values), "type": _TYPES[values.shape[1]]}
        self.accessors.append(accessor | entries)
        return len(self.accessors) - 1


def write_glb(path: str | os.PathLike[str], document: dict[str, Any], buffer: Buffer) -> None:
    """Write a file atomically; its accessors, bufferViews and buffers are those of `buffer`.

    Raises StorageError if it cannot be written or is larger than the format allows, and ValueError for numbers that are
    not finite.
    """
    binary = buffer.content()
    document = document | {
        "accessors": buffer.accessors,
        "bufferViews": buffer.views,
        "buffers": [{"byteLength": len(binary)}],
    }
    text = json.dumps(document, ensure_ascii=False, allow_nan=False, separators=(",", ":")).encode()
    text += b" " * (-len(text) % _ALIGNMENT)
    binary += b"\0" * (-len(binary) % _ALIGNMENT)
    length = 12 + 8 + len(text) + 8 + len(binary)
    if length > _LARGEST:
        raise StorageError(
            f"{path}: would have {length / 1e9:.1f} GB, and binary glTF ends at {_LARGEST / 1e9:.1f}; export a lower "
            "degree, 8-bit numbers or one light"
        )
    with replacing(path) as part, open(part, "wb") as file:
        file.write(struct.pack("<III", _MAGIC, _VERSION, length))
        file.write(struct.pack("<II", len(text), _JSON) + text)
        file.write(struct.pack("<II", len(binary), _BINARY))
        file.write(binary)
