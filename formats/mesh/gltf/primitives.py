"""The primitives of a mesh: topology, vertex attributes and morph targets (glTF 2.0, section 3.7.2)."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from formats.mesh.gltf.accessors import Accessors
from formats.mesh.gltf.container import COMPRESSIONS, GltfFile
from formats.mesh.gltf.part import Part
from formats.mesh.gltf.schema import Primitive, Texture, TextureTransform

Array = NDArray[np.float64]

_TRIANGLES, _STRIP, _FAN = 4, 5, 6


def read_primitive(
    file: GltfFile, accessors: Accessors, primitive: Primitive, where: str, weights: Sequence[float], shared: bool
) -> Part | None:
    """Return the triangles of a primitive, with its morph targets added by their weights; None if it has no triangle.

    Points and lines are left out with a remark. Of vertices that it shares with other primitives (`shared`), as
    where one mesh has many materials, only those that it uses are read.

    Raises:
        MeshError: an accessor does not fit, is compressed or out of range, or the mode is unknown.
    """
    if not 0 <= primitive.mode <= _FAN:
        raise file.fault(f"{where}.mode", f"expected 0 to {_FAN}, found {primitive.mode}")
    if primitive.mode < _TRIANGLES:
        file.remark(where, "points and lines are ignored, only triangles are read")
        return None
    _refuse_missing_data(file, accessors, primitive, where)
    attributes = primitive.attributes
    if "POSITION" not in attributes:
        file.remark(where, "is ignored, since it has no attribute POSITION")
        return None
    if primitive.targets and len(weights) not in (0, len(primitive.targets)):
        raise file.fault(where, f"has {len(primitive.targets)} morph targets, but the mesh has {len(weights)} weights")
    count = accessors.record(attributes["POSITION"], f"{where}.attributes.POSITION").count
    corners = None if primitive.indices is None else accessors.indices(primitive.indices, f"{where}.indices", count)
    rows = None
    if shared and corners is not None:
        rows, corners = np.unique(corners, return_inverse=True)

    def read(name: str, shape: str) -> Array:
        values = accessors.floats(attributes[name], shape, f"{where}.attributes.{name}", count, rows)
        for number, (target, weight) in enumerate(zip(primitive.targets, weights, strict=False)):
            if weight and name in target:
                place = f"{where}.targets[{number}].{name}"
                values += weight * accessors.floats(target[name], shape, place, count, rows)
        return values

    positions = read("POSITION", "VEC3")
    if corners is None:
        corners = np.arange(count)
    if primitive.mode == _TRIANGLES and len(corners) % 3:
        raise file.fault(where, f"expected three corners for each triangle, found {len(corners)} corners in all")
    faces = _triangulate(corners, primitive.mode, positions)
    if len(faces) == 0:
        return None
    normals = read("NORMAL", "VEC3") if "NORMAL" in attributes else None
    name, transform = _texture_coordinates(file, primitive, where)
    uv = _upwards(read(name, "VEC2"), transform) if name in attributes else None
    return Part(positions, faces, normals, uv, name, rows, where)


def _refuse_missing_data(file: GltfFile, accessors: Accessors, primitive: Primitive, where: str) -> None:
    """Raise MeshError if positions or indices have no values in the file, as in compressed primitives."""
    places = {
        f"{where}.indices": primitive.indices,
        f"{where}.attributes.POSITION": primitive.attributes.get("POSITION"),
    }
    compression = next((name for name in COMPRESSIONS if name in primitive.extensions), None)
    for place, index in places.items():
        record = None if index is None else accessors.record(index, place)
        if record is None or record.bufferView is not None or record.sparse is not None or record.count == 0:
            continue
        if compression:
            raise file.compressed(where, compression)
        raise file.fault(place, f"accessor {index} has no values, neither a bufferView nor sparse ones")


def _triangulate(corners: NDArray[np.int64], mode: int, positions: Array) -> NDArray[np.int64]:
    """Return the triangles [F,3] of a list, strip or fan of corners.

    Triangles of a strip or fan with two corners at one place are dropped: they lead from one strip to the next.
    """
    if mode == _TRIANGLES:
        return corners.reshape(-1, 3)
    if mode == _STRIP:
        faces = np.stack([corners[:-2], corners[1:-1], corners[2:]], axis=1)
        faces[1::2] = faces[1::2, ::-1]  # the winding alternates
    else:
        faces = np.stack([corners[1:-1], corners[2:], np.repeat(corners[:1], len(corners[2:]))], axis=1)
    places = positions[faces]
    links: NDArray[np.bool_] = (places == np.roll(places, 1, axis=1)).all(axis=2).any(axis=1)
    return faces[~links]


def _texture_coordinates(file: GltfFile, primitive: Primitive, where: str) -> tuple[str, TextureTransform]:
    """Return the attribute of the texture coordinates that the material uses, and their transform.

    They are those of the base colour, else of the roughness, else of another core texture, else of a texture of an
    extension, else TEXCOORD_0.
    """
    if primitive.material is None:
        return "TEXCOORD_0", TextureTransform()
    material = file.entry("material", file.records.materials, primitive.material, f"{where}.material")
    model = material.pbrMetallicRoughness
    textures = [texture for texture in (model.baseColorTexture, model.metallicRoughnessTexture) if texture]
    others = [material.normalTexture, material.emissiveTexture, material.occlusionTexture]
    others += [texture for extension in material.extensions.values() for texture in extension.values()]
    uses = [_use(texture) for texture in textures or others if texture]
    if not uses:
        return "TEXCOORD_0", TextureTransform()
    if any(use != uses[0] for use in uses):
        file.remark(where, "has textures with different coordinates, the first one's are read")
    name, transform = uses[0]
    if name in primitive.attributes and transform != TextureTransform():
        file.remark(where, "KHR_texture_transform is applied to the texture coordinates")
    return name, transform


def _use(texture: Texture) -> tuple[str, TextureTransform]:
    transform = texture.extensions.KHR_texture_transform or TextureTransform()
    number = texture.texCoord if transform.texCoord is None else transform.texCoord
    return f"TEXCOORD_{number}", transform.model_copy(update={"texCoord": None})


def _upwards(uv: Array, transform: TextureTransform) -> Array:
    """Apply a texture transform to texture coordinates [n,2] whose v points down; return them with v upwards.

    The rotation is counter-clockwise as seen on the image, as viewers read it; the listing in the extension's text has
    the other sign (https://github.com/KhronosGroup/glTF/issues/1563).
    """
    if transform == TextureTransform():
        return np.stack([uv[:, 0], 1.0 - uv[:, 1]], axis=1)
    cosine, sine = np.cos(transform.rotation), np.sin(transform.rotation)
    u, v = uv[:, 0] * transform.scale[0], uv[:, 1] * transform.scale[1]
    across = cosine * u + sine * v + transform.offset[0]
    down = cosine * v - sine * u + transform.offset[1]
    return np.stack([across, 1.0 - down], axis=1)
