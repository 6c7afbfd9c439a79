"""The bytes of a glTF file: its buffers, in the GLB chunk, in data URIs (RFC 2397) or in other files.

glTF 2.0, sections 2.8 (URIs) and 3.6.1 (buffers and buffer views).
"""

import base64
import re
from urllib.parse import unquote, unquote_to_bytes

from formats.mesh.gltf.container import COMPRESSIONS, GltfFile
from formats.mesh.gltf.names import find_file
from formats.mesh.gltf.schema import Buffer, BufferView

_SCHEME = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+:")  # at least two letters: C: is a drive


class Buffers:
    """The buffers of a file, each read when it is first needed."""

    def __init__(self, file: GltfFile) -> None:
        self._file = file
        self._loaded: dict[int, memoryview] = {}

    @property
    def bytes_read(self) -> int:
        """The number of bytes that have been read: of the file itself, and of its buffers."""
        return self._file.size + sum(len(data) for data in self._loaded.values())

    def view(self, index: int, where: str) -> tuple[memoryview, BufferView]:
        """Return the bytes of a buffer view, and its record.

        Raises:
            MeshError: it does not exist, lies outside of its buffer or is compressed, or the buffer cannot be read.
        """
        view = self._file.entry("buffer view", self._file.records.bufferViews, index, where)
        place = f"bufferViews[{index}]"
        buffer = self._file.entry("buffer", self._file.records.buffers, view.buffer, place)
        compression = next((name for name in COMPRESSIONS if name in view.extensions), None)
        if compression and not self._has_data(view.buffer, buffer):
            raise self._file.compressed(place, compression)
        if view.byteOffset + view.byteLength > buffer.byteLength:
            raise self._file.fault(
                place,
                f"ends at byte {view.byteOffset + view.byteLength} of buffer {view.buffer}, "
                f"which has {buffer.byteLength}",
            )
        if view.buffer not in self._loaded:
            self._loaded[view.buffer] = self._load(view.buffer, buffer)
        return self._loaded[view.buffer][view.byteOffset : view.byteOffset + view.byteLength], view

    def _has_data(self, index: int, buffer: Buffer) -> bool:
        return buffer.uri is not None or (index == 0 and self._file.binary is not None)

    def _load(self, index: int, buffer: Buffer) -> memoryview:
        where = f"buffers[{index}]"
        if not self._has_data(index, buffer):
            raise self._file.fault(where, "has neither a uri nor the binary chunk of a .glb file")
        if buffer.uri is None:
            data = self._file.binary or memoryview(b"")
        elif buffer.uri[:5].lower() == "data:":
            data = memoryview(self._decode(buffer.uri, where))
        else:
            data = memoryview(self._read(buffer.uri, buffer.byteLength, where))
        if len(data) < buffer.byteLength:
            remedy = "copy or export it again"
            raise self._file.fault(where, f"has {len(data)} bytes, expected {buffer.byteLength}", remedy)
        return data[: buffer.byteLength]

    def _decode(self, uri: str, where: str) -> bytes:
        """Return the content of a data URI, base64 or percent-encoded."""
        head, _, body = uri.partition(",")
        content = unquote_to_bytes(body)
        if not head.lower().replace(" ", "").endswith(";base64"):
            return content
        compact = b"".join(content.split()).rstrip(b"=")
        try:
            return base64.b64decode(compact + b"=" * (-len(compact) % 4), validate=True)
        except ValueError as cause:
            raise self._file.fault(f"{where}.uri", f"is not base64: {cause}") from cause

    def _read(self, uri: str, length: int, where: str) -> bytes:
        """Return the first `length` bytes of a file; its name is relative to that of the glTF file."""
        if _SCHEME.match(uri):
            remedy = "save it beside the glTF file, or export as .glb"
            raise self._file.fault(f"{where}.uri", f"expected the name of a file, found {uri[:80]!r}", remedy)
        try:
            path = find_file(self._file.path, uri)
            if path is not None:
                with open(path, "rb") as file:
                    return file.read(min(length, path.stat().st_size))
        except (OSError, ValueError) as cause:  # ValueError: the name has a zero byte
            raise self._file.fault(f"{where}.uri", f"cannot be read: {uri[:80]!r}: {cause}") from cause
        remedy = "copy it to its place beside the glTF file, or export as .glb"
        raise self._file.fault(f"{where}.uri", f"there is no file {unquote(uri)[:80]!r}", remedy)
