"""glTF: damaged files give a mesh or one sentence that names the place."""

import copy
import random
import re
import tracemalloc
import warnings
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from formats.errors import InputWarning, MeshError
from formats.mesh import read_mesh
from formats.mesh.gltf import read_gltf, reader
from tests.formats.mesh.gltf_files import FACES, TETRAHEDRON, GltfBuilder, refused, tetrahedron
from tests.formats.mesh.test_gltf import skinned, textured, triangulated


def instances(**attributes: int) -> dict[str, Any]:
    return {"EXT_mesh_gpu_instancing": {"attributes": attributes}}


# A place in the JSON of `damaged`, the value that is put there, and the sentence. Accessor 0 has the indices, 1 the
# positions, 2 three vectors, 3 one quaternion of zeros.
PRIMITIVE, ATTRIBUTES = "meshes/0/primitives/0", "meshes/0/primitives/0/attributes"
DAMAGED: list[tuple[str, Any, str]] = [
    (f"{ATTRIBUTES}/POSITION", 7, "meshes[0].primitives[0].attributes.POSITION: accessor 7 does not exist"),
    (f"{ATTRIBUTES}/NORMAL", 7, "meshes[0].primitives[0].attributes.NORMAL: accessor 7 does not exist, the file has 4"),
    (f"{ATTRIBUTES}/NORMAL", -1, "attributes.NORMAL: expected 0 or more, found -1"),
    (f"{ATTRIBUTES}/NEW\nLINE", -1, "attributes.NEW\\nLINE: expected 0 or more"),
    (f"{ATTRIBUTES}/NORMAL", 0, "attributes.NORMAL (accessors[0]): expected type VEC3, found 'SCALAR'"),
    (f"{ATTRIBUTES}/NORMAL", 2, "attributes.NORMAL (accessors[2]): expected 4 elements, found 3"),
    (f"{PRIMITIVE}/indices", 7, "meshes[0].primitives[0].indices: accessor 7 does not exist"),
    (f"{PRIMITIVE}/indices", 1, "indices (accessors[1]): expected type SCALAR, found 'VEC3'"),
    (f"{PRIMITIVE}/material", 3, "primitives[0].material: material 3 does not exist, the file has 0"),
    (f"{PRIMITIVE}/mode", 7, "primitives[0].mode: expected 0 to 6, found 7"),
    (f"{PRIMITIVE}/targets", [{}, {}], "has 2 morph targets, but the mesh has 1 weights"),
    ("meshes/0/primitives", 1, "meshes[0].primitives: expected a valid array, found 1"),
    ("nodes/0/mesh", 1, "nodes[0].mesh: mesh 1 does not exist, the file has 1"),
    ("nodes/0/skin", 0, "nodes[0].skin: skin 0 does not exist, the file has 0"),
    ("nodes/0/children", [4], "nodes[0].children: node 4 does not exist, the file has 2"),
    ("nodes/0/children", [0], "nodes: 1 nodes are their own ancestors or descend from such nodes"),
    ("nodes/0/children", [1, 1], "nodes[0].children: node 1 is already a child of node 0"),
    (
        "nodes/0/rotation",
        [1, 1, 1, 1],
        "nodes[0].rotation: expected a unit quaternion x, y, z, w, found one of length 2",
    ),
    ("nodes/0/matrix", [1] * 16, "nodes[0].matrix: expected 0, 0, 0, 1 in the last row of the matrix"),
    ("nodes/0/matrix", np.diag([2, 2, 2, 1]).ravel().tolist(), "nodes[0]: expected a matrix, or a translation"),
    ("nodes/0/matrix", [1] * 9, "nodes[0].matrix: expected 16 numbers, found 9"),
    ("nodes/0/scale", [1e999, 1, 1], "nodes[0].scale[0]: expected a finite number"),
    ("nodes/0/extensions", instances(), "expected TRANSLATION, ROTATION, SCALE, found none of them"),
    ("nodes/0/extensions", instances(SCALE=9), "EXT_mesh_gpu_instancing.attributes.SCALE: accessor 9 does not exist"),
    ("nodes/0/extensions", instances(TRANSLATION=2, ROTATION=3), "(accessors[3]): expected 3 elements, found 1"),
    ("nodes/0/extensions", instances(ROTATION=3), "attributes.ROTATION: instance 0: expected a unit quaternion"),
    ("scenes/0/nodes", [5], "scenes[0].nodes: node 5 does not exist"),
    ("nodes/1/children", [0], "scenes[0].nodes: expected roots, but node 0 is a child of node 1"),
    ("scenes/0/nodes", [0, 0], "scenes[0].nodes: names a node twice"),
    ("scene", 2, "scene: scene 2 does not exist, the file has 1"),
    ("scene", "first", "scene: expected a valid integer"),
    ("accessors/0/bufferView", 9, "indices (accessors[0]): buffer view 9 does not exist"),
    ("accessors/0/componentType", 5122, "primitives[0].indices: accessor 0 does not hold unsigned integers"),
    ("accessors/0/count", 11, "expected three corners for each triangle, found 11 corners in all"),
    ("accessors/1", {"count": 4, "componentType": 5126, "type": "VEC3"}, "POSITION: accessor 1 has no values"),
    ("accessors/1/count", 5, "ends at byte 60 of bufferViews[1]: expected at most its 48 bytes"),
    ("accessors/1/count", 10**15, "ends at byte 12000000000000000 of bufferViews[1]"),
    ("accessors/1/byteOffset", 2**70, "of bufferViews[1]: expected at most its 48 bytes"),
    ("accessors/1/componentType", 5130, "(accessors[1]): componentType: expected one of"),
    ("bufferViews/0/buffer", 1, "bufferViews[0]: buffer 1 does not exist, the file has 1"),
    ("bufferViews/0/byteStride", 4, "bufferViews[0].byteStride: expected none or 2, found 4"),
    ("bufferViews/1/byteStride", 4, "bufferViews[1].byteStride: expected at least 12, found 4"),
    ("bufferViews/1/byteLength", 999, "bufferViews[1]: ends at byte 1023 of buffer 0, which has 124"),
]


@pytest.mark.parametrize(("place", "value", "sentence"), DAMAGED)
def test_damaged_files_are_refused_with_the_place(tmp_path, place, value, sentence):
    damaged = tetrahedron(scale=[1, 1, 2])
    damaged.node(root=False)
    damaged.accessor(np.ones((3, 3)))
    damaged.accessor(np.zeros((1, 4)))
    damaged.json["meshes"][0]["weights"] = [1]
    *path, last = (int(key) if key.isdigit() else key for key in place.split("/"))
    parent: Any = damaged.json
    for key in path:
        parent = parent[key]
    parent[last] = value
    assert sentence in refused(damaged.write(tmp_path / "damaged.glb"))


@pytest.mark.parametrize("index", [4, 65535])
def test_indices_out_of_range_are_refused_in_their_primitive(tmp_path, index):
    builder = GltfBuilder()
    faces = FACES.copy()
    faces[2, 1] = index
    builder.node(mesh=builder.mesh(builder.solid(), builder.solid(faces=faces), builder.solid()))
    sentence = "1 of 12 indices are vertices that do not exist, the first is 4" if index == 4 else "contains 65535"
    assert f"meshes[0].primitives[1].indices: {sentence}" in refused(builder.write(tmp_path / "range.glb"))


@pytest.mark.parametrize(
    ("index", "kind", "sentence"),
    [([1, 1], "u2", "ascending indices below 4"), ([1, 4], "u2", "below 4"), ([0, 1], "f4", "componentType")],
)
def test_sparse_indices_are_checked(tmp_path, index, kind, sentence):
    builder = GltfBuilder()
    some = builder.sparse(4, index, TETRAHEDRON[:2], index_kind=kind)
    builder.node(mesh=builder.mesh({**builder.solid(), "attributes": {"POSITION": some}}))
    assert sentence in refused(builder.write(tmp_path / "sparse.glb"))


@pytest.mark.parametrize(
    ("weight", "joint", "sentence"),
    [
        (0, 0, "4 of 4 vertices have no weight"),
        (-1, 0, "negative weights"),
        (1, 2, "names joint 2, but the skin has 2"),
    ],
)
def test_skins_are_checked(tmp_path, weight, joint, sentence):
    builder = skinned([[[weight, 0, 0, 0]] * 4], [[[joint, 9, 9, 9]] * 4], np.tile(np.eye(4), (2, 1, 1)))
    assert sentence in refused(builder.write(tmp_path / "skin.glb"))
    del builder.json["meshes"][0]["primitives"][0]["attributes"]["WEIGHTS_0"]
    assert "expected JOINTS_0 and WEIGHTS_0" in refused(builder.write(tmp_path / "skin.glb"))
    builder.json["skins"][0]["joints"] *= 2
    assert "expected a matrix for each of 4 joints, found 2" in refused(builder.write(tmp_path / "skin.glb"))
    builder.json["skins"][0]["joints"] = [8]
    assert "skins[0].joints: node 8 does not exist" in refused(builder.write(tmp_path / "skin.glb"))


def test_absurd_counts_allocate_nothing(tmp_path):
    few = GltfBuilder()
    sparse = few.sparse(10**9, [0, 1, 2], TETRAHEDRON[:3])
    few.node(mesh=few.mesh({"attributes": {"POSITION": sparse}}))
    copies = tetrahedron()
    nothing = {"componentType": 5126, "count": 10**8, "type": "VEC3"}
    copies.json["accessors"].append(nothing)
    copies.json["nodes"][0]["extensions"] = {"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": 2}}}
    many = tetrahedron()
    every = {"EXT_mesh_gpu_instancing": {"attributes": {"SCALE": many.accessor(np.ones((2000, 3)))}}}
    primitive = many.json["meshes"][0]["primitives"][0]
    many.json["meshes"][0]["primitives"] = [primitive] * 1000
    many.json["nodes"][0]["extensions"] = every
    for builder, sentence in (
        (few, "more than the file has bytes"),
        (copies, "more than"),
        (many, "with 2000 copies of mesh 0 the scene has 16000000 vertices"),
    ):
        path = builder.write(tmp_path / "absurd.glb")
        tracemalloc.start()
        assert sentence in refused(path)
        assert tracemalloc.get_traced_memory()[1] < 20_000_000
        tracemalloc.stop()


def test_copies_that_are_too_many_are_named_by_their_cause(tmp_path, monkeypatch):
    monkeypatch.setattr(reader, "_MOST_ELEMENTS", 0)
    builder = textured()
    mesh = builder.json["meshes"][0]
    mesh["primitives"] *= 100
    sentence = refused(builder.write(tmp_path / "primitives.glb"))
    assert re.match(
        r"meshes\[0\].primitives\[\d+\]: with primitives that share their accessors the scene has", sentence
    )
    assert "in so small a file; export primitives with indices of their own" in sentence
    mesh["primitives"] = mesh["primitives"][:1]
    for _ in range(99):
        builder.node(mesh=0)
    sentence = refused(builder.write(tmp_path / "nodes.glb"))
    assert "with a copy of mesh 0 the scene has" in sentence


@pytest.mark.parametrize("copies", [1, 3])
@pytest.mark.parametrize("fault", ["NaN", "flat"])
def test_faults_of_the_surface_are_named_by_node_and_primitive(tmp_path, fault, copies):
    builder = GltfBuilder()
    builder.node(mesh=builder.mesh(builder.solid(TETRAHEDRON - 9)))
    positions = np.vstack([TETRAHEDRON, TETRAHEDRON + 5])
    faces = np.vstack([FACES + 4, [[4, 4, 5]]])
    if fault == "NaN":
        positions[6] = np.nan
    first, second = builder.solid(positions), builder.solid(faces=faces)
    second["attributes"] = first["attributes"]
    builder.node(name="Cow", mesh=builder.mesh(first, second))
    if copies > 1:
        attributes = {"TRANSLATION": builder.accessor(np.arange(9).reshape(3, 3) * 9)}
        builder.json["nodes"][1]["extensions"] = {"EXT_mesh_gpu_instancing": {"attributes": attributes}}
    path = builder.write(tmp_path / "fault.glb")
    place = "of nodes[1] ('Cow'), meshes[1].primitives[1]" + (", copy 0" if copies > 1 else "")
    if fault == "flat":
        with pytest.warns(InputWarning, match=re.escape(f"the first is face 4 {place} with corners [4, 4, 5]; they")):
            read_mesh(path)
    else:
        with pytest.raises(MeshError, match=re.escape(f"the first is vertex 6 {place} at [nan, nan, nan]; repair")):
            read_mesh(path)


def test_a_copy_is_named_among_several(tmp_path):
    builder = tetrahedron()
    attributes = {"SCALE": builder.accessor([[1, 1, 1], [2, 2, 2], [0, 0, 0]])}
    builder.json["nodes"][0]["extensions"] = {"EXT_mesh_gpu_instancing": {"attributes": attributes}}
    place = "face 0 of nodes[0], meshes[0].primitives[0], copy 2 with corners [0, 2, 1]"
    with pytest.warns(InputWarning, match=re.escape(f"4 of 12 faces have no area, the first is {place}")):
        read_mesh(builder.write(tmp_path / "copy.glb"))


def _seeds() -> list[GltfBuilder]:
    """Small files that together use every feature."""
    morphed = textured(translation=[1, 2, 3])
    target = {"POSITION": morphed.sparse(86, [3, 4], TETRAHEDRON[:2])}
    morphed.json["meshes"][0]["primitives"][0]["targets"] = [target]
    morphed.json["meshes"][0]["weights"] = [0.5]
    copies = tetrahedron(children=[])
    copies.json["extensionsRequired"] = ["EXT_mesh_gpu_instancing"]
    rotations = copies.accessor([[0, 0, 0, 127]] * 3, "i1", normalized=True)
    attributes = {"TRANSLATION": copies.accessor(TETRAHEDRON[:3]), "ROTATION": rotations}
    copies.json["nodes"][0]["extensions"] = {"EXT_mesh_gpu_instancing": {"attributes": attributes}}
    skin = skinned([[[0.5, 0.5, 0, 0]] * 4], [[[0, 1, 0, 0]] * 4], np.tile(np.eye(4), (2, 1, 1)))
    return [morphed, copies, skin, triangulated(5, [0, 2, 1, 3, 0, 2])]


SEEDS = _seeds()
VALUES = [
    None,
    True,
    -1,
    0,
    1,
    2,
    3,
    5,
    255,
    5121,
    2**31,
    2**63,
    10**30,
    0.5,
    1e308,
    -1e300,
    "",
    "VEC4",
    [],
    {},
    [0],
    {"a": 0},
]


def _places(parent: Any) -> list[tuple[Any, Any]]:
    """Every value inside a JSON object or array, as the object or array that holds it and its key."""
    keys = list(parent) if isinstance(parent, dict) else list(range(len(parent)))
    inner = [place for key in keys if isinstance(parent[key], dict | list) for place in _places(parent[key])]
    return [(parent, key) for key in keys] + inner


def _damage(record: Any, rng: random.Random) -> None:
    """Replace, remove, repeat or shift a random value of a JSON object."""
    parent, key = rng.choice(_places(record))
    value, choice = parent[key], rng.random()
    if choice < 0.1:
        del parent[key]
    elif choice < 0.2 and isinstance(parent, list):
        parent.append(copy.deepcopy(value))
    elif choice < 0.5 and isinstance(value, int | float):
        parent[key] = rng.choice([value + 1, value - 1, 10 * value + 1, -value, value / 2])
    else:
        parent[key] = copy.deepcopy(rng.choice(VALUES))


@settings(max_examples=150, deadline=None, derandomize=True, database=None)
@given(
    seed=st.integers(0, len(SEEDS) - 1),
    random_seed=st.integers(0, 2**32),
    changes=st.integers(1, 3),
    deep=st.booleans(),
)
def test_damage_gives_a_mesh_or_one_sentence(tmp_path_factory, seed, random_seed, changes, deep):
    rng = random.Random(random_seed)
    builder = copy.deepcopy(SEEDS[seed])
    if deep:
        for _ in range(changes):
            _damage(builder.json, rng)
    content = bytearray(builder.glb())
    if not deep:
        for _ in range(changes):
            content[-rng.randrange(1, rng.choice([len(builder.data), len(content)]))] = rng.randrange(256)
        content = content[: rng.choice([len(content), len(content), rng.randrange(len(content))])]
    path = tmp_path_factory.getbasetemp() / "damaged.glb"
    path.write_bytes(content)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InputWarning)
        try:
            soup = read_gltf(path)
        except MeshError:
            refused(path)
        else:
            assert soup.faces.min() >= 0
            assert soup.faces.max() < len(soup.positions)


def test_a_file_that_shows_no_mesh_says_why(tmp_path):
    builder = tetrahedron(name="Cow", extensions={"KHR_node_visibility": {"visible": False}})
    path = tmp_path / "nothing.glb"
    found = "nodes[0] ('Cow'), the only node with a mesh, is hidden by KHR_node_visibility; make the object visible"
    assert refused(builder.write(path)).startswith(found)
    builder.node(root=False, mesh=0)
    builder.json["nodes"][0]["children"] = [1]
    found = "all 2 nodes with meshes, the first is nodes[0] ('Cow'), are hidden by KHR_node_visibility; make the object"
    assert refused(builder.write(path)).startswith(found)
    del builder.json["nodes"][0]["extensions"], builder.json["nodes"][0]["mesh"]
    builder.json["scenes"] = [{"nodes": []}, {"nodes": [0]}]
    found = "the default scene shows no mesh, but nodes[1] in scenes[1] has one; add the object to the default scene"
    assert refused(builder.write(path)).startswith(found)
    builder.json["scenes"] = [{}]
    assert "nodes[1] in no scene has one" in refused(builder.write(path))
    del builder.json["nodes"][1]["mesh"]
    assert refused(builder.write(path)).startswith("no node shows a mesh, though the file has 1; add the object")
    builder.json["meshes"] = []
    assert refused(builder.write(path)).startswith("has no faces; expected triangles in its scene")
