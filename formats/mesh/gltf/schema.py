"""The part of a glTF file's JSON that geometry needs (glTF 2.0, chapter 5, "Properties Reference").

Names are those of the standard. Everything else in the file is skipped: cameras, animations, images, extras.
"""

from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

Element = TypeVar("Element")
Many = Annotated[tuple[Element, ...], Field(fail_fast=True)]  # one error is enough: a damaged file may have millions
Index = Annotated[int, Field(ge=0)]
Number = Annotated[float, Field(allow_inf_nan=False)]
Pair = tuple[Number, Number]


class Record(BaseModel):
    """A JSON object; unknown keys are skipped."""

    model_config = ConfigDict(extra="ignore", frozen=True)


class Asset(Record):
    """The version of glTF, as in "2.0"."""

    version: str
    minVersion: str | None = None


class Head(Record):
    """What decides whether the rest can be read."""

    asset: Asset
    extensionsRequired: Many[str] = ()


class Buffer(Record):
    """A block of bytes: a file, a data URI, or the second chunk of a GLB file."""

    byteLength: Index
    uri: str | None = None


class BufferView(Record):
    """A range of a buffer."""

    buffer: Index
    byteOffset: Index = 0
    byteLength: Index
    byteStride: Index | None = None
    extensions: dict[str, Any] = {}


class SparseIndices(Record):
    """Where the indices of a sparse accessor's values lie."""

    bufferView: Index
    byteOffset: Index = 0
    componentType: int


class SparseValues(Record):
    """Where the values of a sparse accessor lie."""

    bufferView: Index
    byteOffset: Index = 0


class Sparse(Record):
    """Elements that replace those of the accessor."""

    count: Index
    indices: SparseIndices
    values: SparseValues


class Accessor(Record):
    """An array of numbers in a buffer view; zeros if it has none."""

    bufferView: Index | None = None
    byteOffset: Index = 0
    componentType: int
    normalized: bool = False
    count: Index
    type: str
    sparse: Sparse | None = None


class TextureTransform(Record):
    """KHR_texture_transform."""

    offset: Pair = (0.0, 0.0)
    rotation: Number = 0.0
    scale: Pair = (1.0, 1.0)
    texCoord: Index | None = None


class TextureExtensions(Record):
    """The extensions of a texture that concern its coordinates."""

    KHR_texture_transform: TextureTransform | None = None


class Texture(Record):
    """A use of a texture by a material."""

    texCoord: Index = 0
    extensions: TextureExtensions = TextureExtensions()


class Roughness(Record):
    """The two textures of the metallic-roughness model."""

    baseColorTexture: Texture | None = None
    metallicRoughnessTexture: Texture | None = None


def _textures(extension: Any) -> dict[str, Any]:
    """Return the textures among the values of a material's extension: the objects whose keys end in "Texture"."""
    values = extension.items() if isinstance(extension, dict) else ()
    return {key: value for key, value in values if key.endswith("Texture") and isinstance(value, dict)}


class Material(Record):
    """The textures of a material; those of an extension by their keys, as in KHR_materials_volume: thicknessTexture."""

    pbrMetallicRoughness: Roughness = Roughness()
    normalTexture: Texture | None = None
    occlusionTexture: Texture | None = None
    emissiveTexture: Texture | None = None
    extensions: dict[str, Annotated[dict[str, Texture], BeforeValidator(_textures)]] = {}


class Primitive(Record):
    """Triangles, lines or points of one material; `targets` are the morph targets."""

    attributes: dict[str, Index]
    indices: Index | None = None
    material: Index | None = None
    mode: int = 4
    targets: Many[dict[str, Index]] = ()
    extensions: dict[str, Any] = {}


class Mesh(Record):
    """Primitives, and the default weights of their morph targets."""

    primitives: Many[Primitive]
    weights: Many[Number] | None = None


class Instancing(Record):
    """EXT_mesh_gpu_instancing: accessors of translations, rotations and scales."""

    attributes: dict[str, Index]


class Visibility(Record):
    """KHR_node_visibility."""

    visible: bool = True


class NodeExtensions(Record):
    """The extensions of a node that concern its geometry."""

    EXT_mesh_gpu_instancing: Instancing | None = None
    KHR_node_visibility: Visibility = Visibility()


class Node(Record):
    """A node of the scene's tree: a transform, and perhaps a mesh."""

    name: Any = None
    children: Many[Index] = ()
    matrix: Many[Number] | None = None
    translation: tuple[Number, Number, Number] = (0.0, 0.0, 0.0)
    rotation: tuple[Number, Number, Number, Number] = (0.0, 0.0, 0.0, 1.0)
    scale: tuple[Number, Number, Number] = (1.0, 1.0, 1.0)
    mesh: Index | None = None
    skin: Index | None = None
    weights: Many[Number] | None = None
    extensions: NodeExtensions = NodeExtensions()


class Skin(Record):
    """The nodes that move the vertices of a mesh."""

    joints: Many[Index]
    inverseBindMatrices: Index | None = None


class Scene(Record):
    """The roots of one scene."""

    nodes: Many[Index] = ()


class Gltf(Record):
    """The whole file."""

    scene: Index | None = None
    scenes: Many[Scene] = ()
    nodes: Annotated[Many[Node], Field(max_length=100_000)] = ()
    skins: Many[Skin] = ()
    meshes: Many[Mesh] = ()
    materials: Many[Material] = ()
    accessors: Many[Accessor] = ()
    bufferViews: Many[BufferView] = ()
    buffers: Many[Buffer] = ()
