"""`--onto`: a user's file keeps what it has, and each vertex gets the numbers of the baked vertex at its place."""

import copy
import io
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import prt_bake as prt
from formats.errors import InputWarning, MeshError, StorageError
from formats.mesh import Mesh, read_mesh
from formats.mesh.gltf.accessors import Accessors
from formats.mesh.gltf.container import open_gltf
from prt_bake.export.engine_form import engine_form
from tests.export.assets import smooth_asset
from tests.formats.mesh.gltf_files import GltfBuilder
from tests.formats.mesh.test_mesh import sphere_mesh

TURN = [0.1, 0.2, 0.3, float(np.sqrt(0.86))]
_IN_MEMORY = io.BytesIO()
Image.new("RGB", (8, 8), (200, 120, 40)).save(_IN_MEMORY, "PNG")
PICTURE = _IN_MEMORY.getvalue()


def textured() -> GltfBuilder:
    """A turned and scaled sphere of two materials whose vertices are split at every face; a picture, an animation."""
    file, ball = GltfBuilder(), sphere_mesh()
    corners = np.random.default_rng(3).permutation(ball.faces).ravel()
    positions, normals = ball.positions[corners], ball.normals[corners]
    bounds = {"min": positions.min(axis=0).tolist(), "max": positions.max(axis=0).tolist()}
    shared = {"POSITION": file.accessor(positions, **bounds), "NORMAL": file.accessor(normals)}
    shared["TEXCOORD_0"] = file.accessor(positions[:, :2])
    half = len(corners) // 6 * 3
    indices = [file.accessor(part, "u2") for part in (np.arange(half), np.arange(half, len(corners)))]
    primitives = [{"attributes": dict(shared), "indices": each, "material": n} for n, each in enumerate(indices)]
    moved = {"translation": [3.0, -1.0, 0.5], "rotation": TURN, "scale": [2.0, 2.0, 2.0], "name": "Ball"}
    mesh = file.mesh(*primitives, name="ball", extras={"artist": "A"})
    file.node(mesh=mesh, extras={"id": 7}, **moved)
    times = file.accessor([0.0, 1.0], min=[0.0], max=[1.0])
    turns = file.accessor([TURN, [0.0, 0.0, 0.0, 1.0]])
    file.json["animations"] = [
        {
            "samplers": [{"input": times, "output": turns}],
            "channels": [{"sampler": 0, "target": {"node": 0, "path": "rotation"}}],
        }
    ]
    file.json["images"] = [{"bufferView": file.view(PICTURE), "mimeType": "image/png"}]
    file.json["textures"] = [{"source": 0}]
    file.json["materials"] = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}, {"name": "plain"}]
    return file


class Exported:
    """A file after the export, and the baked mesh with its engine form."""

    def __init__(self, path: Path, asset: prt.Asset) -> None:
        self.mesh, self.file = asset.mesh, open_gltf(path)
        self.form = engine_form(asset, 1).coefficients
        content = path.read_bytes()
        (length,) = struct.unpack_from("<I", content, 12)
        self.json = json.loads(content[20 : 20 + length])
        self.binary = content[28 + length :]

    def read(self, mesh: int, primitive: int, name: str, shape: str = "VEC3") -> Any:
        accessor = self.json["meshes"][mesh]["primitives"][primitive]["attributes"][name]
        return Accessors(self.file).floats(accessor, shape, name)

    def extras(self, mesh: int = 0) -> Any:
        return self.json["meshes"][mesh]["extras"]["prtbake"]

    def vertices(self, mesh: int, primitive: int, name: str = "TEXCOORD_1") -> Any:
        """The number of the baked vertex of each vertex, from its texel."""
        size = self.extras(mesh)["texels"]
        column, row = np.floor(self.read(mesh, primitive, name, "VEC2") * (size["width"], size["height"])).T
        return (row * size["width"] + column).astype(int)


def export(user: Path, mesh: Mesh | None = None, **options: Any) -> Exported:
    """Export an asset of a mesh, by default that of the file itself, onto a file."""
    asset = smooth_asset(mesh or read_mesh(user))
    path = user.with_name("exported.glb")
    prt.export_gltf(asset, path, degree=1, onto=user, **options)
    return Exported(path, asset)


def test_each_vertex_gets_the_numbers_at_its_place(tmp_path: Path) -> None:
    found = export(textured().write(tmp_path / "user.glb"))
    matrix = np.reshape(found.extras()["local_to_object"], (3, 3))
    assert np.allclose(matrix @ matrix.T, np.eye(3))
    for primitive, seen in ((0, slice(None, 252)), (1, slice(252, None))):
        place = 2 * found.read(0, primitive, "POSITION") @ matrix.T + (3.0, -1.0, 0.5)
        vertices = found.vertices(0, primitive)
        assert np.allclose(found.mesh.positions[vertices], place, atol=1e-6)
        for r, k in ((0, 0), (3, 8)):
            assert np.array_equal(found.read(0, primitive, f"_PRT_{r}_{k}"), found.form[vertices, r, k])
        assert len(np.unique(vertices[seen])) > 40
    assert found.extras()["texel_attribute"] == "TEXCOORD_1"


def test_the_file_keeps_all_it_had(tmp_path: Path) -> None:
    user = textured()
    before = copy.deepcopy(user.json)
    found = export(user.write(tmp_path / "user.glb"))
    assert found.binary[: len(user.data)] == user.data
    after = found.json
    assert after["meshes"][0]["extras"].pop("prtbake")
    for primitive in after["meshes"][0]["primitives"]:
        assert "COLOR_0" not in primitive["attributes"]  # it would change the user's materials
        for name in (*(f"_PRT_{r}_{k}" for r in range(4) for k in range(9)), "TEXCOORD_1"):
            assert primitive["attributes"].pop(name) >= len(before["accessors"])
    for name in ("accessors", "bufferViews"):
        after[name] = after[name][: len(before[name])]
    assert after.pop("buffers")[0]["byteLength"] > len(user.data)
    assert after == before


def test_chunks_of_other_types_are_skipped(tmp_path: Path) -> None:
    user = textured()
    content = bytearray(user.glb())
    (length,) = struct.unpack_from("<I", content, 12)
    content[20 + length : 20 + length] = struct.pack("<II", 8, 0x52485430) + bytes(range(8))
    struct.pack_into("<I", content, 8, len(content))
    path = tmp_path / "user.glb"
    path.write_bytes(content)
    assert export(path).binary[: len(user.data)] == user.data


@pytest.mark.parametrize("number", ["NaN", "-Infinity", "1e999"])
def test_numbers_that_are_not_finite_are_refused_in_one_sentence(number: str, tmp_path: Path) -> None:
    user = textured()
    user.json["nodes"][0]["extras"] = {"weight": 0.1234567}
    path = user.write(tmp_path / "user.glb")
    path.write_bytes(path.read_bytes().replace(b"0.1234567", number.encode().rjust(9)))
    with pytest.raises(MeshError, match=rf"^{path}: JSON: expected finite numbers, found {number}; correct it or "):
        export(path)


def test_sets_and_colours_of_the_user_stay(tmp_path: Path) -> None:
    user, ball = GltfBuilder(), sphere_mesh()
    uv, colours = user.accessor(ball.positions[:, :2]), user.accessor(np.abs(ball.positions))
    first = user.solid(ball.positions, ball.faces, TEXCOORD_0=uv, TEXCOORD_1=uv, COLOR_0=colours)
    user.node(mesh=user.mesh(first, user.solid(ball.positions + np.array([3, 0, 0]), ball.faces, TEXCOORD_0=uv)))
    found = export(user.write(tmp_path / "user.glb"))
    kept, added = (one["attributes"] for one in found.json["meshes"][0]["primitives"])
    assert (kept["TEXCOORD_0"], kept["TEXCOORD_1"], kept["COLOR_0"]) == (uv, uv, colours)
    assert found.extras()["texel_attribute"] == "TEXCOORD_2"
    assert added["TEXCOORD_0"] == uv
    assert "COLOR_0" in added
    assert added["TEXCOORD_1"] == added["TEXCOORD_2"]  # glTF numbers sets without gaps
    for primitive, shift in ((0, 0), (1, 3)):
        vertices = found.vertices(0, primitive, "TEXCOORD_2")
        assert np.allclose(found.mesh.positions[vertices], ball.positions + np.array([shift, 0, 0]))
    assert len(found.json["accessors"]) - len(user.json["accessors"]) == 37 + 38  # no colours for the first primitive


def test_a_mesh_that_several_nodes_show_is_copied(tmp_path: Path) -> None:
    user, ball = GltfBuilder(), sphere_mesh()
    mesh = user.mesh(user.solid(ball.positions, ball.faces), extras={"artist": "A"})
    user.node(mesh=mesh)
    user.node(mesh=mesh, translation=[5.0, 0.0, 0.0], scale=[-1.0, 1.0, 1.0])
    user.node(root=False, mesh=mesh, name="of no scene")
    found = export(user.write(tmp_path / "user.glb"))
    assert [node["mesh"] for node in found.json["nodes"]] == [1, 2, 0]
    assert found.json["meshes"][0] == user.json["meshes"][0]
    for mesh, mirrored in ((1, np.eye(3)), (2, np.diag([-1.0, 1.0, 1.0]))):
        assert np.array_equal(np.reshape(found.extras(mesh)["local_to_object"], (3, 3)), mirrored)
        place = found.read(mesh, 0, "POSITION") @ mirrored + (5 * (mesh - 1), 0, 0)
        assert np.allclose(found.mesh.positions[found.vertices(mesh, 0)], place)
        assert set(found.extras(mesh)["selftest"]["vertex"]) <= set(found.vertices(mesh, 0))
        assert found.json["meshes"][mesh]["extras"]["artist"] == "A"


def test_other_objects_stay_as_they_are(tmp_path: Path) -> None:
    user, ball = GltfBuilder(), sphere_mesh()
    user.node(mesh=user.mesh(user.solid(ball.positions, ball.faces)))
    baked = read_mesh(user.write(tmp_path / "ball.glb"))
    floor = [[-9, -2, -9], [9, -2, -9], [0, -2, 9]]
    user.node(mesh=user.mesh(user.solid(floor, [[0, 1, 2]]), extras="text"), name="Floor")
    with pytest.warns(InputWarning, match=r"1 objects? .* as they are: nodes\[1\] \('Floor'\)"):
        found = export(user.write(tmp_path / "user.glb"), baked)
    assert found.json["meshes"][1] == user.json["meshes"][1]
    assert "_PRT_0_0" in found.json["meshes"][0]["primitives"][0]["attributes"]


def test_sides_of_a_sheet_are_not_exchanged(tmp_path: Path) -> None:
    user, square = GltfBuilder(), np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    positions = np.vstack([square, square + np.array([0, 0, 8e-5])])
    faces = np.array([[0, 2, 1], [0, 3, 2], [4, 5, 6], [4, 6, 7]])
    user.node(mesh=user.mesh(user.solid(positions, faces)))
    baked = read_mesh(user.write(tmp_path / "sheet.glb"))
    other = GltfBuilder()  # of coordinates that were rounded by another program
    other.node(mesh=other.mesh(other.solid(positions.round(4) - np.array([0, 0, 7e-5]), faces)))
    found = export(other.write(tmp_path / "user.glb"), baked)
    assert found.vertices(0, 0).tolist() == list(range(8))


def test_bytes_are_padded(tmp_path: Path) -> None:
    found = export(textured().write(tmp_path / "user.glb"), quantize="int8")
    accessor = found.json["accessors"][found.json["meshes"][0]["primitives"][0]["attributes"]["_PRT_0_0"]]
    assert (accessor["componentType"], accessor["normalized"]) == (5120, True)
    assert found.json["bufferViews"][accessor["bufferView"]]["byteStride"] == 4
    read = found.read(0, 1, "_PRT_0_0") * found.extras()["scales"][0][0]
    assert np.allclose(read, found.form[found.vertices(0, 1), 0, 0], atol=0.004 * np.abs(read).max())


def _moved(user: GltfBuilder) -> None:
    user.json["nodes"][0]["translation"] = [1.1, 0.0, 0.0]


def _dented(user: GltfBuilder) -> None:
    ball = sphere_mesh()
    ball.positions[5:17] *= 0.9
    user.json["meshes"] = [{"primitives": [user.solid(ball.positions, ball.faces)]}]


def _morphed(user: GltfBuilder) -> None:
    count = len(sphere_mesh().positions)
    user.json["meshes"][0]["primitives"][0]["targets"] = [{"POSITION": user.accessor(np.zeros((count, 3)))}]


def _skinned(user: GltfBuilder) -> None:
    primitive, count = user.json["meshes"][0]["primitives"][0], len(sphere_mesh().positions)
    primitive["attributes"]["JOINTS_0"] = user.accessor(np.zeros((count, 4)), "u1")
    primitive["attributes"]["WEIGHTS_0"] = user.accessor(np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)))
    user.json["skins"] = [{"joints": [user.node()]}]
    user.json["nodes"][0]["skin"] = 0


def _instanced(user: GltfBuilder) -> None:
    once = {"TRANSLATION": user.accessor([[0.0, 0.0, 0.0]])}
    user.json["nodes"][0]["extensions"] = {"EXT_mesh_gpu_instancing": {"attributes": once}}


def _compressed_beside(user: GltfBuilder) -> None:
    user.json["meshes"][0]["primitives"][0]["extensions"] = {"KHR_draco_mesh_compression": {}}


def _exported_before(user: GltfBuilder) -> None:
    attributes = user.json["meshes"][0]["primitives"][0]["attributes"]
    attributes["_PRT_0_0"] = attributes["POSITION"]


def _extras_of_text(user: GltfBuilder) -> None:
    user.json["meshes"][0]["extras"] = "made by hand"


def _picture_beside(user: GltfBuilder) -> None:
    user.json["images"] = [{"uri": "wood.png"}]


def _two_buffers(user: GltfBuilder) -> None:
    user.json["buffers"] = [{"byteLength": len(user.data)}, {"byteLength": 1, "uri": "data:;base64,AA=="}]


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (
            _moved,
            r"none of its 86 vertices is on the baked mesh; the smallest distance is 0\.\d+, its largest "
            "object has a diagonal of 3.46, the mesh of 3.46; export onto the file that was baked",
        ),
        (_dented, r"12 of 86 vertices of nodes\[0\] are not on the baked mesh; the largest distance is 0\.1, "),
        (_morphed, r"nodes\[0\]: has morph targets, but the transport is of one rigid object; apply"),
        (_skinned, r"nodes\[0\]: has a skin, "),
        (_instanced, r"nodes\[0\]: has instances, "),
        (
            _compressed_beside,
            r"nodes\[0\]: the geometry is compressed by KHR_draco_mesh_compression; export it without",
        ),
        (_exported_before, r"has the attributes _PRT_… of an earlier export; export onto the file as it was before"),
        (_extras_of_text, r"meshes: expected extras with keys, found 'made by hand'; export it without"),
        (_two_buffers, r"buffers: expected the binary chunk alone, found others; export it as one .glb file"),
        (_picture_beside, r"images\[0\]: is in another file, 'wood.png'; export it as one .glb file"),
    ],
)
def test_what_does_not_fit_is_refused_in_one_sentence(change: Any, says: str, tmp_path: Path) -> None:
    user, ball = GltfBuilder(), sphere_mesh()
    user.node(mesh=user.mesh(user.solid(ball.positions, ball.faces)))
    baked = read_mesh(user.write(tmp_path / "baked.glb"))
    change(user)
    path = user.write(tmp_path / "user.glb")
    with pytest.raises(MeshError, match=rf"^{path}: {says}") as caught:
        export(path, baked)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "exported.glb").exists()


def test_only_binary_gltf_is_taken(tmp_path: Path) -> None:
    user, ball = GltfBuilder(), sphere_mesh()
    user.node(mesh=user.mesh(user.solid(ball.positions, ball.faces)))
    path = user.write(tmp_path / "user.gltf")
    with pytest.raises(MeshError, match=r"user\.gltf: expected a \.glb file to export onto; export the object as"):
        export(path)
    with pytest.raises(MeshError, match=r"user\.glb: expected binary glTF, found glTF as text; export it as \.glb$"):
        export(path.rename(tmp_path / "user.glb"))
    with pytest.raises(StorageError, match=r"missing\.glb: there is no such file"):
        export(tmp_path / "missing.glb", ball)
