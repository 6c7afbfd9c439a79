"""Builds small glTF files, feature by feature, without a library."""

import base64
import copy
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from formats.errors import MeshError
from formats.mesh.gltf import read_gltf

COMPONENTS = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
SHAPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}

TETRAHEDRON = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


class GltfBuilder:
    """The JSON of a glTF file, `json`, and the bytes of its only buffer, `data`."""

    def __init__(self) -> None:
        self.data = b""
        self.json: dict[str, Any] = {"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": []}]}
        self.json |= {"nodes": [], "meshes": [], "accessors": [], "bufferViews": []}

    def view(self, content: bytes, **keys: Any) -> int:
        """Append bytes as a buffer view."""
        self.data += b"\0" * (-len(self.data) % 4)
        self.json["bufferViews"].append({"buffer": 0, "byteOffset": len(self.data), "byteLength": len(content), **keys})
        self.data += content
        return len(self.json["bufferViews"]) - 1

    def accessor(self, values: Any, kind: str = "f4", **keys: Any) -> int:
        """Append an array [n] or [n,k] as an accessor."""
        array = np.asarray(values).astype(f"<{kind}")
        record = {"bufferView": self.view(array.tobytes()), "componentType": COMPONENTS[kind], "count": len(array)}
        record["type"] = SHAPES[array.shape[1] if array.ndim == 2 else 1]
        self.json["accessors"].append({**record, **keys})
        return len(self.json["accessors"]) - 1

    def sparse(self, count: int, index: Any, values: Any, kind: str = "f4", index_kind: str = "u2", **keys: Any) -> int:
        """Append a sparse accessor of zeros, or of the buffer view in `keys`."""
        replaced = np.asarray(values).astype(f"<{kind}")
        record = {
            "count": len(replaced),
            "indices": {
                "bufferView": self.view(np.asarray(index).astype(f"<{index_kind}").tobytes()),
                "componentType": COMPONENTS[index_kind],
            },
            "values": {"bufferView": self.view(replaced.tobytes())},
        }
        shape = SHAPES[replaced.shape[1] if replaced.ndim == 2 else 1]
        accessor = {"componentType": COMPONENTS[kind], "count": count, "type": shape, "sparse": record}
        self.json["accessors"].append({**accessor, **keys})
        return len(self.json["accessors"]) - 1

    def mesh(self, *primitives: dict[str, Any], **keys: Any) -> int:
        """Append a mesh."""
        self.json["meshes"].append({"primitives": list(primitives), **keys})
        return len(self.json["meshes"]) - 1

    def node(self, root: bool = True, **keys: Any) -> int:
        """Append a node, to the scene if it is a root."""
        self.json["nodes"].append(keys)
        index = len(self.json["nodes"]) - 1
        if root:
            self.json["scenes"][0]["nodes"].append(index)
        return index

    def solid(
        self, positions: Any = TETRAHEDRON, faces: Any = FACES, kind: str = "u2", **attributes: int
    ) -> dict[str, Any]:
        """Return a primitive of indexed triangles."""
        corners = self.accessor(np.ravel(faces), kind)
        return {"attributes": {"POSITION": self.accessor(positions), **attributes}, "indices": corners}

    def glb(self, extra: bytes = b"", binary: bytes | None = None) -> bytes:
        """Return a binary file; `extra` are further chunks."""
        content = self.data if binary is None else binary
        content += b"\0" * (-len(content) % 4)
        record = copy.deepcopy(self.json)
        record.setdefault("buffers", [{"byteLength": len(self.data)}])
        return pack(json.dumps(record).encode(), content, extra)

    def write(self, path: Path) -> Path:
        """Write `.glb`, or `.gltf` with its buffer as a data URI."""
        if path.suffix == ".glb":
            path.write_bytes(self.glb())
            return path
        uri = "data:application/octet-stream;base64," + base64.b64encode(self.data).decode()
        path.write_text(json.dumps({"buffers": [{"byteLength": len(self.data), "uri": uri}], **self.json}))
        return path


def pack(text: bytes, binary: bytes | None, extra: bytes = b"") -> bytes:
    """Return a binary glTF file of a JSON chunk and a binary one."""
    text += b" " * (-len(text) % 4)
    body = struct.pack("<II", len(text), 0x4E4F534A) + text
    if binary is not None:
        body += struct.pack("<II", len(binary), 0x004E4942) + binary
    body += extra
    return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body


def tetrahedron(**node: Any) -> GltfBuilder:
    """A file of one tetrahedron."""
    builder = GltfBuilder()
    builder.node(mesh=builder.mesh(builder.solid()), **node)
    return builder


def refused(path: Path) -> str:
    """Return the sentence with which a file is refused, without the file's name."""
    with pytest.raises(MeshError) as caught:
        read_gltf(path)
    name, _, sentence = str(caught.value).partition(": ")
    assert name == str(path)
    assert "\n" not in sentence
    assert ";" in sentence
    return sentence


def corners(mesh: Any) -> NDArray[np.float64]:
    """The corners of all faces [F,3,3], each face begun at its lowest corner, the faces sorted."""
    triangles = mesh.positions[mesh.faces]
    begun = np.array([np.roll(face, -min(range(3), key=lambda k: tuple(face[k])), axis=0) for face in triangles])
    return begun[np.lexsort(begun.reshape(len(begun), 9).T[::-1])]
