"""Opens a glTF file: the chunks of GLB (glTF 2.0, chapter 4), the JSON, its version and its required extensions."""

import json
import os
import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TypeVar

from pydantic import BaseModel, ValidationError

from formats.errors import MeshError, warn
from formats.mesh.gltf.schema import Gltf, Head
from formats.text import without_byte_order_mark

COMPRESSIONS = ("KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_meshopt_compression")
_UNDERSTOOD = ("EXT_mesh_gpu_instancing", "KHR_mesh_quantization", "KHR_node_visibility", "KHR_texture_transform")
# Extensions that move no triangle: materials, textures, lights, animation, metadata, and simpler or coarser copies.
_WITHOUT_GEOMETRY = (
    *("KHR_materials_", "KHR_texture_", "KHR_lights_", "KHR_technique", "EXT_texture_", "EXT_lights_"),
    *("ADOBE_materials_", "NV_materials_", "MSFT_texture_", "MSFT_packing_", "MSFT_lod", "KHR_animation_pointer"),
    *("KHR_xmp", "KHR_audio", "KHR_interactivity", "KHR_node_hoverability", "KHR_node_selectability", "AGI_"),
    *("EXT_structural_metadata", "EXT_mesh_features", "EXT_instance_features", "FB_geometry_metadata", "GODOT_"),
    *("EXT_mesh_manifold", "EXT_mesh_primitive_edge_visibility", "CESIUM_primitive_outline"),
)
_JSON, _BINARY = 0x4E4F534A, 0x004E4942

Entry = TypeVar("Entry", bound=BaseModel)


@dataclass(frozen=True)
class GltfFile:
    """A glTF file whose JSON has been read.

    Attributes:
        path: the file.
        records: its JSON.
        binary: the binary chunk of a GLB file, or None.
        size: length of the file in bytes.
        text: the JSON of a GLB file as it is stored, or None.
    """

    path: str | os.PathLike[str]
    records: Gltf
    binary: memoryview | None
    size: int
    text: bytes | None
    _remarks: dict[str, dict[str, None]] = field(default_factory=dict)

    def fault(self, where: str, sentence: str, remedy: str = "export the file again") -> MeshError:
        """Return the error for a place in the JSON, as in `meshes[0].primitives[1].indices`."""
        return MeshError(f"{self.path}: {where}: {sentence}; {remedy}")

    def compressed(self, where: str, extension: str) -> MeshError:
        """Return the error for compressed geometry."""
        return self.fault(where, f"the geometry is compressed by {extension}", "export it without mesh compression")

    def entry(self, name: str, entries: Sequence[Entry], index: int, where: str) -> Entry:
        """Return an element of one of the file's arrays; `name` is the word for it in errors.

        Raises:
            MeshError: there is no such element.
        """
        if index >= len(entries):
            raise self.fault(where, f"{name} {index} does not exist, the file has {len(entries)}")
        return entries[index]

    def node(self, index: int) -> str:
        """Return the place of a node and its name, if it has one."""
        name = self.records.nodes[index].name
        return f"nodes[{index}] ({name!r:.80})" if isinstance(name, str) and name else f"nodes[{index}]"

    def remark(self, where: str, sentence: str) -> None:
        """Keep a remark on a primitive for `warn_of_remarks`."""
        self._remarks.setdefault(sentence, {})[where] = None

    def warn_of_remarks(self) -> None:
        """Warn once for each remark, with the number of primitives."""
        for sentence, places in self._remarks.items():
            others = f" and {len(places) - 1} more" if len(places) > 1 else ""
            warn(f"{self.path}: {next(iter(places))}{others}: {sentence}")


def open_gltf(path: str | os.PathLike[str]) -> GltfFile:
    """Read the JSON of a glTF file. `extensionsRequired` is examined before anything else.

    Raises:
        MeshError: the file is not glTF 2.0, is truncated, or requires an extension that is not supported.
    """
    with open(path, "rb") as file:
        content = file.read()
    is_glb = content[:4] == b"glTF"
    text, binary = _chunks(content, path) if is_glb else (content, None)
    text = without_byte_order_mark(text, path, MeshError).rstrip(b"\0")  # some writers add a mark, or pad with zeros
    _refuse_other_versions(_parse(Head, text, path), path)
    return GltfFile(path, _parse(Gltf, text, path), binary, len(content), text if is_glb else None)


def _chunks(content: bytes, path: str | os.PathLike[str]) -> tuple[bytes, memoryview | None]:
    """Return the JSON and the binary chunk of a GLB file; chunks of other types are skipped."""
    truncated = f"{path}: is truncated: it is a binary glTF file of {len(content)} bytes, and"
    if len(content) < 12:
        raise MeshError(f"{truncated} its header has 12; copy or export it again")
    version, length = struct.unpack_from("<II", content, 4)
    if version != 2:
        raise MeshError(f"{path}: is binary glTF of version {version}; expected version 2; export it as glTF 2.0")
    if length > len(content):
        raise MeshError(f"{truncated} its header names {length}; copy or export it again")
    wrong_header = f"{path}: the header of the binary glTF file names {length} bytes; expected {len(content)}, its size"
    if length < min(20, len(content)):
        raise MeshError(f"{wrong_header}; export it again")
    chunks: list[tuple[int, memoryview]] = []
    start = 12
    while start + 8 <= length:
        size, kind = struct.unpack_from("<II", content, start)
        end = start + 8 + size
        if end > length and start % 4:  # the chunk before does not count its padding, so this is no start
            found = f"the chunk before byte {start} of the binary glTF file has {len(chunks[-1][1])} bytes"
            raise MeshError(f"{path}: {found}; expected a multiple of 4, with padding; export it again")
        if length < end <= len(content):
            raise MeshError(f"{wrong_header}; export it again")
        if end > length:
            raise MeshError(f"{truncated} chunk {len(chunks)} ends at byte {end}; copy or export it again")
        chunks.append((kind, memoryview(content)[start + 8 : end]))
        start = end
    if not chunks or chunks[0][0] != _JSON:
        raise MeshError(f"{path}: the first chunk of the binary glTF file is not JSON; export it again")
    binary = [chunk for kind, chunk in chunks if kind == _BINARY]
    if len(binary) > 1:
        raise MeshError(f"{path}: has {len(binary)} binary chunks; expected one in binary glTF; export it again")
    return bytes(chunks[0][1]), binary[0] if binary else None


def _parse(kind: type[Entry], text: bytes, path: str | os.PathLike[str]) -> Entry:
    try:
        return kind.model_validate_json(text)
    except ValidationError as cause:
        error = cause.errors(include_url=False)[0]
        keys = (f"[{part}]" if isinstance(part, int) else f".{part!r:.40}".replace("'", "") for part in error["loc"])
        place = "".join(keys).lstrip(".")
        if not place:
            _refuse_other_encodings(text, path)
            raise MeshError(f"{path}: is not glTF, or its JSON is damaged: {error['msg']}; export it again") from cause
        if error["type"] == "missing":
            raise MeshError(f"{path}: {place}: is missing; export the glTF file again") from cause
        if error["type"] == "too_long":
            most = error["ctx"]["max_length"]
            raise MeshError(f"{path}: {place}: expected at most {most} entries, found more; export less") from cause
        expected = (
            "0 or more" if error["type"] == "greater_than_equal" else error["msg"].replace("Input should be ", "")
        )
        found = f"expected {expected}, found {error['input']!r:.80}"
        raise MeshError(f"{path}: {place}: {found}; export the glTF file again") from cause


def _refuse_other_encodings(text: bytes, path: str | os.PathLike[str]) -> None:
    """Raise MeshError if the text is not UTF-8, but JSON with one byte for each letter."""
    try:
        text.decode("utf-8")
    except UnicodeDecodeError as cause:
        try:
            json.loads(text.decode("latin-1"))
        except (ValueError, RecursionError):
            return
        found = f"found the byte {text[cause.start]:#x} at byte {cause.start}, as in Latin-1"
        raise MeshError(f"{path}: expected JSON in UTF-8, {found}; save it again with the encoding UTF-8") from cause


def _refuse_other_versions(head: Head, path: str | os.PathLike[str]) -> None:
    """Raise MeshError for another version, and for a required extension that is not supported."""
    version = head.asset.minVersion or head.asset.version
    if version.split(".")[0] != "2" or head.asset.minVersion not in (None, "2.0"):
        raise MeshError(f"{path}: asset: is glTF {version!r:.20}; expected version 2.0; export it as glTF 2.0")
    for name in head.extensionsRequired:
        if name in COMPRESSIONS:
            raise MeshError(
                f"{path}: extensionsRequired: the geometry is compressed by {name}; export it without mesh compression"
            )
        if name not in _UNDERSTOOD and not name.startswith(_WITHOUT_GEOMETRY):
            raise MeshError(
                f"{path}: extensionsRequired: {name!r:.80} is not supported, and the geometry may depend on it; "
                f"export the file without it"
            )
