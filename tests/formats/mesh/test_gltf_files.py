"""glTF: containers, buffers and extensions."""

import base64
import json
import struct
from unicodedata import normalize
from urllib.parse import quote

import pytest

from formats.errors import InputWarning, MeshError
from formats.mesh import read_mesh
from formats.mesh.gltf import read_gltf
from tests.formats.mesh.gltf_files import pack, refused, tetrahedron


def test_every_container_gives_the_same_mesh(tmp_path):
    builder = tetrahedron()
    expected = read_mesh(builder.write(tmp_path / "plain.glb")).content_hash
    text = json.dumps({**builder.json, "buffers": [{"byteLength": len(builder.data)}]}).encode()
    unknown = struct.pack("<II4s", 4, 0x12345678, b"more")
    spaced = text.replace(b"5126", b"5.126e3").replace(b'"count": 4', b'"count": 4.0')
    for number, content in enumerate(
        (
            builder.glb(extra=unknown),
            builder.glb(binary=builder.data + b"\0\0\0"),
            builder.glb() + b"trailing bytes",
            pack(b"\xef\xbb\xbf" + text, builder.data),
            pack(text + b"\0" * (-len(text) % 4), builder.data),
            pack(spaced, builder.data),
        )
    ):
        (tmp_path / f"{number}.gltf").write_bytes(content)
        assert read_mesh(tmp_path / f"{number}.gltf").content_hash == expected


def test_buffers_in_other_files_are_found_by_their_names(tmp_path):
    builder = tetrahedron()
    expected = read_mesh(builder.write(tmp_path / "plain.glb")).content_hash
    name = "my mesh é #1 100%41.bin"
    (tmp_path / "deep").mkdir()
    (tmp_path / name).write_bytes(builder.data + b"more than is declared")
    uris = [f"../{quote(name)}", f"../{name}", f"..\\{quote(name)}", str(tmp_path / name), quote(str(tmp_path / name))]
    encoded = base64.b64encode(builder.data).decode()
    uris += [f"data:;base64,{encoded.rstrip('=')}", f"data:application/gltf-buffer;base64,{quote(encoded)}"]
    uris += [f"data:application/octet-stream,{quote(builder.data)}", f"data:model/gltf-buffer; base64, {encoded}"]
    uris += [f"../{quote(normalize('NFD', name))}", f"../{normalize('NFD', name)}"]
    for uri in uris:
        builder.json["buffers"] = [{"byteLength": len(builder.data), "uri": uri}]
        (tmp_path / "deep" / "mesh.gltf").write_text(json.dumps(builder.json))
        assert read_mesh(tmp_path / "deep" / "mesh.gltf").content_hash == expected, uri


@pytest.mark.parametrize(
    ("uri", "sentence"),
    [
        ("https://example.com/mesh.bin", r"buffers\[0\].uri: expected the name of a file, found 'https://example.com"),
        ("file:///tmp/mesh.bin", "expected the name of a file"),
        ("missing%20file.bin", "there is no file 'missing file.bin'; copy it"),
        ("", "there is no file"),
        ("a" * 5000, "buffers.0..uri: cannot be read"),
        ("zero%00byte", "buffers.0..uri"),
        ("/dev/zero", "there is no file '/dev/zero'"),
        ("short.bin", r"buffers\[0\]: has 10 bytes, expected 72; copy or export it again"),
        ("data:;base64,*", "is not base64"),
        ("data:;base64,AAAA", r"buffers\[0\]: has 3 bytes, expected 72"),
    ],
)
def test_a_buffer_that_cannot_be_read_is_named(tmp_path, uri, sentence):
    builder = tetrahedron()
    assert len(builder.data) == 72
    (tmp_path / "short.bin").write_bytes(builder.data[:10])
    builder.json["buffers"] = [{"byteLength": 72, "uri": uri}]
    (tmp_path / "mesh.gltf").write_text(json.dumps(builder.json))
    with pytest.raises(MeshError, match=sentence):
        read_gltf(tmp_path / "mesh.gltf")
    refused(tmp_path / "mesh.gltf")


def test_containers_that_are_no_gltf_are_refused(tmp_path):
    content = tetrahedron().glb()
    binary = struct.pack("<II4s", 4, 0x004E4942, b"more")
    text = json.dumps({**tetrahedron().json, "scene": "Sphère"}, ensure_ascii=False)
    size = struct.unpack_from("<I", content, 12)[0]
    short = content[:8] + struct.pack("<I", len(content) - 8) + content[12:]
    longer = content[:8] + struct.pack("<II", len(content) + 4, size + 1)  # the JSON has a byte more, and 3 of padding
    unpadded = longer + content[16 : 20 + size] + b"    " + content[20 + size :]
    cases = {
        b"": "is not glTF, or its JSON is damaged",
        b'{"asset": {"version": "2.0"}, "nodes": [' + b"1," * 10**5 + b"1]}": r"nodes\[0\]: expected an object",
        b'{"asset": {"version": "2.0"}, "nodes": [' + b"{}," * 10**5 + b"{}]}": "nodes: expected at most 100000",
        b"[]": "is not glTF, or its JSON is damaged",
        b"PK\3\4": "is not glTF",
        b"[" * 9999: "is not glTF",
        b"{}": "asset: is missing; export",
        b'{"asset": {"version": "1.0"}}': "is glTF '1.0'; expected version 2.0",
        b'{"asset": {"version": "2.1", "minVersion": "2.1"}}': "is glTF '2.1'; expected version 2.0",
        content[:11]: "is truncated: it is a binary glTF file of 11 bytes",
        content[:12]: "is truncated",
        content[:-1]: "is truncated",
        content[:4] + b"\1" + content[5:]: "binary glTF of version 1",
        content.replace(b"JSON", b"json"): "the first chunk of the binary glTF file is not JSON",
        content[:14] + b"\xff" + content[15:]: "is truncated.*chunk 0 ends at",
        content[:8] + b"\0\0\0\0" + content[12:]: f"header .* names 0 bytes; expected {len(content)}, its size; export",
        short: f"names {len(content) - 8} bytes; expected {len(content)}, its size",
        unpadded: f"the chunk before byte {21 + size} .* has {size + 1} bytes; expected a multiple of 4, with padding",
        text.encode("utf-16"): "expected text in UTF-8, found UTF-16; save it again with the encoding UTF-8",
        text.encode("latin-1"): "expected JSON in UTF-8, found the byte 0xe8 at byte .*, as in Latin-1; save it again",
        tetrahedron().glb(extra=binary): "has 2 binary chunks",
        pack(tetrahedron().glb()[20:], None): "is not glTF",
        b'{"asset": {"version": "2.0"}}': "",
    }
    for number, (start, sentence) in enumerate(cases.items()):
        path = tmp_path / f"{number}.glb"
        path.write_bytes(start)
        if sentence:
            with pytest.raises(MeshError, match=sentence):
                read_gltf(path)
            refused(path)
    with pytest.warns(InputWarning), pytest.raises(MeshError, match="has no faces"):
        read_gltf(path)


def test_required_extensions_are_examined_first(tmp_path):
    for name, sentence in {
        "KHR_draco_mesh_compression": "compressed by KHR_draco_mesh_compression; export it without mesh compression",
        "EXT_meshopt_compression": "compressed by EXT_meshopt_compression; export it without mesh compression",
        "KHR_meshopt_compression": "compressed by KHR_meshopt_compression",
        "EXT_mesh_primitive_restart": "extensionsRequired: 'EXT_mesh_primitive_restart' is not supported",
        "ACME_voxels": "extensionsRequired: 'ACME_voxels' is not supported",
    }.items():
        builder = tetrahedron()
        builder.json |= {"extensionsRequired": ["KHR_node_visibility", name], "nodes": "damaged"}
        assert sentence in refused(builder.write(tmp_path / "required.glb"))


def test_extensions_without_geometry_may_be_required(tmp_path):
    builder = tetrahedron()
    names = ["KHR_materials_unlit", "KHR_texture_basisu", "KHR_lights_punctual", "KHR_xmp_json_ld", "EXT_texture_webp"]
    names += ["EXT_mesh_primitive_edge_visibility", "KHR_mesh_quantization", "KHR_texture_transform"]
    builder.json["extensionsRequired"] = names
    assert len(read_gltf(builder.write(tmp_path / "required.glb")).faces) == 4


def test_compression_that_is_not_required_is_named_if_there_is_no_other_data(tmp_path):
    builder = tetrahedron()
    primitive = builder.json["meshes"][0]["primitives"][0]
    primitive["extensions"] = {"KHR_draco_mesh_compression": {"bufferView": 0}}
    assert len(read_gltf(builder.write(tmp_path / "whole.glb")).faces) == 4
    del builder.json["accessors"][0]["bufferView"]
    assert "compressed by KHR_draco_mesh_compression" in refused(builder.write(tmp_path / "draco.glb"))
    builder = tetrahedron()
    builder.json["buffers"] = [{"byteLength": 72}, {"byteLength": 72}]
    builder.json["bufferViews"][1] |= {"buffer": 1, "extensions": {"EXT_meshopt_compression": {"buffer": 0}}}
    assert "bufferViews[1]: the geometry is compressed by EXT_meshopt" in refused(builder.write(tmp_path / "opt.glb"))
    del builder.json["bufferViews"][1]["extensions"]
    assert "buffers[1]: has neither a uri nor" in refused(builder.write(tmp_path / "none.glb"))
