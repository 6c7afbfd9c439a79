"""glTF: which texture coordinates are read, and how they are transformed."""

import contextlib

import numpy as np
import pytest

from formats.errors import InputWarning
from formats.mesh.gltf import read_gltf
from tests.formats.mesh.gltf_files import FACES, TETRAHEDRON, GltfBuilder, refused, tetrahedron


def test_textures_are_used_with_their_coordinates(tmp_path):
    builder = GltfBuilder()
    first, second = np.arange(8).reshape(4, 2) / 8, np.arange(8)[::-1].reshape(4, 2) / 8
    sets = {"TEXCOORD_0": builder.accessor(first), "TEXCOORD_1": builder.accessor(second)}
    builder.node(mesh=builder.mesh({**builder.solid(**sets), "material": 0}))
    quadrant = {"offset": [0, 1], "rotation": np.pi / 2, "scale": [0.5, 0.5]}
    builder.json["materials"] = [{"normalTexture": {"index": 0, "texCoord": 1}}]
    soup = read_gltf(builder.write(tmp_path / "second.glb"))
    assert soup.corner_uv is not None
    np.testing.assert_allclose(soup.corner_uv, (second * [1, -1] + [0, 1])[FACES], atol=1e-15)
    # The first example of the extension: the lower left quarter of the image, turned by a right angle.
    texture = {"index": 0, "texCoord": 1, "extensions": {"KHR_texture_transform": {**quadrant, "texCoord": 0}}}
    builder.json["materials"] = [{"pbrMetallicRoughness": {"baseColorTexture": texture}}]
    with pytest.warns(InputWarning, match="KHR_texture_transform is applied"):
        soup = read_gltf(builder.write(tmp_path / "quarter.glb"))
    u, v = first.T
    assert soup.corner_uv is not None
    np.testing.assert_allclose(soup.corner_uv, np.stack([v / 2, u / 2], axis=1)[FACES], atol=1e-15)


@pytest.mark.parametrize(
    ("core", "keys", "read"),
    [
        ({}, {"KHR_materials_volume": ["thicknessTexture"]}, "in the extension"),
        (
            {},
            {"KHR_materials_transmission": [], "KHR_materials_pbrSpecularGlossiness": ["diffuseTexture"]},
            "extension",
        ),
        ({"occlusionTexture": {"index": 0}}, {"KHR_materials_sheen": ["sheenColorTexture"]}, "core, with a warning"),
        ({"pbrMetallicRoughness": {"metallicRoughnessTexture": {"index": 0}}}, {"ACME": ["aTexture"]}, "core"),
        ({}, {"ACME": ["colour", "textures"]}, "none"),
    ],
)
def test_textures_of_extensions_follow_those_of_the_core(tmp_path, core, keys, read):
    builder = GltfBuilder()
    uv = np.arange(8).reshape(4, 2) / 8
    sets = {f"TEXCOORD_{k}": builder.accessor(uv + k) for k in range(2)}
    builder.node(mesh=builder.mesh({**builder.solid(**sets), "material": 0}))
    texture = {"index": 0, "texCoord": 1, "extensions": {"KHR_texture_transform": {"offset": [0, 0], "scale": [16, 1]}}}
    factors = {"thicknessFactor": 1, "textures": 3, "emptyTexture": 0}
    extensions = {name: {**factors, **dict.fromkeys(names, texture)} for name, names in keys.items()}
    builder.json["materials"] = [{**core, "extensions": extensions}]
    path = builder.write(tmp_path / "extension.glb")
    warned = {"core": "", "none": "", "core, with a warning": "different coordinates, the first one's are read"}
    sentence = warned.get(read, "KHR_texture_transform is applied to the texture coordinates")
    with pytest.warns(InputWarning, match=sentence) if sentence else contextlib.nullcontext():
        soup = read_gltf(path)
    moved = (uv + 1) * [16, 1] if "extension" in read else uv
    assert soup.corner_uv is not None
    np.testing.assert_allclose(soup.corner_uv, (moved * [1, -1] + [0, 1])[FACES], atol=1e-15)


def test_a_damaged_texture_of_an_extension_is_named(tmp_path):
    builder = tetrahedron()
    builder.json["materials"] = [{"extensions": {"KHR_materials_volume": {"thicknessTexture": {"texCoord": -1}}}}]
    place = "materials[0].extensions.KHR_materials_volume.thicknessTexture.texCoord: expected 0 or more, found -1"
    assert place in refused(builder.write(tmp_path / "damaged.glb"))


def test_texture_coordinates_of_different_sets_are_named(tmp_path):
    builder = GltfBuilder()
    sets = {f"TEXCOORD_{k}": builder.accessor(np.full((4, 2), k / 4)) for k in range(2)}
    parts = [{**builder.solid(TETRAHEDRON + 5 * k, **sets), "material": k} for k in range(2)]
    builder.json["materials"] = [{"emissiveTexture": {"index": 0, "texCoord": k}} for k in range(2)]
    builder.node(mesh=builder.mesh(*parts))
    with pytest.warns(InputWarning, match="texture coordinates of different sets, .*: TEXCOORD_0, TEXCOORD_1"):
        read_gltf(builder.write(tmp_path / "sets.glb"))
