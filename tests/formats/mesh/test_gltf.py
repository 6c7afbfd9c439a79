"""glTF: the same triangles by different features of the format, and by trimesh where it reads them."""

from pathlib import Path

import numpy as np
import pytest

from formats.errors import InputWarning
from formats.mesh import open_edges, read_mesh, signed_volume
from formats.mesh.gltf import read_gltf
from tests.formats.mesh.gltf_files import FACES, TETRAHEDRON, GltfBuilder, corners, tetrahedron
from tests.formats.mesh.test_mesh import sphere_mesh

TURN = [0.1, 0.2, 0.3, float(np.sqrt(0.86))]


def turn(quaternion) -> np.ndarray:
    """The rotation matrix of a unit quaternion x, y, z, w, by Rodrigues' formula."""
    axis, angle = np.array(quaternion[:3]), 2 * np.arccos(quaternion[3])
    x, y, z = axis / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def textured(**node) -> GltfBuilder:
    """A sphere with normals, texture coordinates and a material."""
    builder, ball = GltfBuilder(), sphere_mesh()
    uv = np.random.default_rng(1).uniform(size=(len(ball.positions), 2))
    attributes = {"NORMAL": builder.accessor(ball.positions), "TEXCOORD_0": builder.accessor(uv)}
    builder.json["materials"] = [{}]
    builder.node(mesh=builder.mesh({**builder.solid(ball.positions, ball.faces, **attributes), "material": 0}), **node)
    return builder


def interleaved() -> GltfBuilder:
    builder = tetrahedron()
    rows = np.hstack([np.full((4, 2), 9), TETRAHEDRON, np.full((4, 1), 7)]).astype("<f4")
    builder.json["accessors"][1] |= {"bufferView": builder.view(rows.tobytes(), byteStride=24), "byteOffset": 8}
    return builder


def unindexed() -> GltfBuilder:
    builder = GltfBuilder()
    positions = builder.accessor(TETRAHEDRON[FACES].reshape(-1, 3))
    builder.node(mesh=builder.mesh({"attributes": {"POSITION": positions}}))
    return builder


def tree() -> GltfBuilder:
    """Two meshes, one of two primitives, used by nodes that are nested, turned, mirrored and scaled."""
    builder = GltfBuilder()
    pair = builder.mesh(builder.solid(), builder.solid(TETRAHEDRON + 5, kind="u1"))
    one = builder.mesh(builder.solid(TETRAHEDRON - 7, kind="u4"))
    matrix = [0, 2, 0, 0, -2, 0, 0, 0, 0, 0, 2, 0, 1, 2, 3, 1]
    child = builder.node(root=False, mesh=one, matrix=matrix)
    other = builder.node(root=False, mesh=pair, scale=[1, -2, 1])
    builder.node(mesh=pair, children=[child, other], translation=[0, 1, 0], rotation=TURN)
    builder.node(mesh=one)
    return builder


PLAIN = {
    "one": tetrahedron,
    "textured": textured,
    "turned": lambda: textured(translation=[1, 2, 3], rotation=TURN, scale=[1, 2, 3]),
    "mirrored": lambda: textured(scale=[-1, 2, 3]),
    "interleaved": interleaved,
    "not indexed": unindexed,
    "tree": tree,
    "strip": lambda: triangulated(5, [0, 2, 1, 3, 0, 2]),
}


@pytest.mark.parametrize("suffix", [".glb", ".gltf"])
@pytest.mark.parametrize("case", PLAIN)
def test_plain_files_are_read_as_by_trimesh(tmp_path, case, suffix):
    import trimesh

    path = PLAIN[case]().write(tmp_path / f"plain{suffix}")
    soup = read_gltf(path)
    parts = trimesh.load_scene(str(path), process=False).dump()
    positions = np.vstack([part.vertices for part in parts])
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    np.testing.assert_allclose(soup.positions, positions, rtol=0, atol=1e-14)
    np.testing.assert_array_equal(soup.faces, np.vstack([p.faces + s for p, s in zip(parts, starts, strict=False)]))
    if case in ("textured", "turned", "mirrored"):
        assert soup.corner_uv is not None
        np.testing.assert_allclose(soup.corner_uv, parts[0].visual.uv[parts[0].faces], rtol=0, atol=1e-7)


@pytest.mark.parametrize("index_kind", ["u1", "u2", "u4"])
def test_sparse_values_replace_those_of_the_buffer_or_zeros(tmp_path, index_kind):
    moved = TETRAHEDRON * [[1], [2], [1], [3]]
    over = GltfBuilder()
    base = over.view(TETRAHEDRON.astype("<f4").tobytes())
    some = over.sparse(4, [1, 3], moved[[1, 3]], index_kind=index_kind, bufferView=base)
    over.node(mesh=over.mesh({**over.solid(), "attributes": {"POSITION": some}}))
    alone = GltfBuilder()
    every = alone.sparse(4, [1, 2, 3], moved[1:], index_kind=index_kind)
    alone.node(mesh=alone.mesh({**alone.solid(), "attributes": {"POSITION": every}}))
    for builder in (over, alone):
        soup = read_gltf(builder.write(tmp_path / "sparse.glb"))
        np.testing.assert_array_equal(soup.positions, moved)
        np.testing.assert_array_equal(soup.faces, FACES)


def test_indices_may_be_sparse(tmp_path):
    builder = tetrahedron()
    wrong = builder.view(np.zeros(12, "<u2").tobytes())
    index = builder.sparse(12, np.arange(12), FACES.ravel(), kind="u2", bufferView=wrong)
    builder.json["meshes"][0]["primitives"][0]["indices"] = index
    np.testing.assert_array_equal(read_gltf(builder.write(tmp_path / "sparse.glb")).faces, FACES)


@pytest.mark.parametrize(("kind", "largest"), [("i1", 127), ("u1", 255), ("i2", 32767), ("u2", 65535)])
def test_integers_are_scaled_only_if_they_are_normalised(tmp_path, kind, largest):
    least = -largest - 1 if kind[0] == "i" else 0
    stored = np.array([[least, 0, 1], [largest, 3, 2], [5, largest, 7], [11, 12, largest]])
    for normalised in (False, True):
        builder = GltfBuilder()
        keys = {"normalized": normalised}
        primitive = builder.solid(TEXCOORD_0=builder.accessor(stored[:, :2], kind, **keys))
        primitive["attributes"]["POSITION"] = builder.accessor(stored, kind, **keys)
        builder.json["extensionsRequired"] = ["KHR_mesh_quantization"]
        builder.node(mesh=builder.mesh(primitive))
        soup = read_gltf(builder.write(tmp_path / "quantised.glb"))
        expected = np.maximum(stored / largest, -1) if normalised else stored
        np.testing.assert_array_equal(soup.positions, expected)
        assert soup.corner_uv is not None
        np.testing.assert_array_equal(soup.corner_uv, (expected[:, :2] * [1, -1] + [0, 1])[FACES])


def triangulated(mode, order, positions=TETRAHEDRON, indexed=True) -> GltfBuilder:
    builder = GltfBuilder()
    primitive = {"attributes": {"POSITION": builder.accessor(positions if indexed else positions[order])}, "mode": mode}
    if indexed:
        primitive["indices"] = builder.accessor(order, "u2")
    builder.node(mesh=builder.mesh(primitive))
    return builder


@pytest.mark.parametrize("indexed", [True, False])
@pytest.mark.parametrize(
    ("mode", "order"),
    [
        (5, [0, 2, 1, 3, 0, 2]),
        (5, [0, 2, 1, 3, 3, 0, 0, 1, 3, 3, 3, 0, 0, 3, 2]),  # three strips, linked by triangles without area
        (6, [0, 2, 1, 3, 2]),
    ],
)
def test_strips_and_fans_are_triangles(tmp_path, mode, order, indexed):
    mesh = read_mesh(triangulated(mode, order, indexed=indexed).write(tmp_path / "strip.glb"))
    if mode == 5:
        np.testing.assert_array_equal(corners(mesh), corners(read_mesh(tetrahedron().write(tmp_path / "list.glb"))))
    else:
        outwards = mesh.face_normals @ [1, 1, 1]
        assert sorted(np.round(outwards, 12)) == [-1, -1, -1]
        assert len(mesh.faces) == 3


def test_points_and_lines_are_left_out_with_one_warning(tmp_path):
    builder = tetrahedron()
    for mode in range(4):
        builder.json["meshes"][0]["primitives"].append({**builder.solid(), "mode": mode})
    with pytest.warns(InputWarning, match=r"meshes\[0\].primitives\[1\] and 3 more: points and lines") as caught:
        soup = read_gltf(builder.write(tmp_path / "lines.glb"))
    assert len(caught) == 1
    np.testing.assert_array_equal(soup.faces, FACES)


def test_empty_primitives_are_skipped(tmp_path):
    builder = tetrahedron()
    builder.json["meshes"][0]["primitives"].append(builder.solid(np.zeros((0, 3)), np.zeros(0)))
    builder.json["meshes"][0]["primitives"].append({**builder.solid(faces=[0, 1]), "mode": 5})
    np.testing.assert_array_equal(read_gltf(builder.write(tmp_path / "empty.glb")).faces, FACES)


@pytest.mark.parametrize(
    ("mesh_weights", "node_weights", "applied"),
    [(None, None, (0, 0)), ([1, 0.5], None, (1, 0.5)), ([1, 0.5], [0, -2], (0, -2)), (None, [3, 0], (3, 0))],
)
def test_morph_targets_are_added_by_their_weights(tmp_path, mesh_weights, node_weights, applied):
    builder = GltfBuilder()
    rng = np.random.default_rng(2)
    normals, uv, first, second = (rng.integers(-9, 9, (4, k)) / 8 for k in (3, 2, 3, 3))
    primitive = builder.solid(NORMAL=builder.accessor(normals), TEXCOORD_0=builder.accessor(uv))
    primitive["targets"] = [
        {"POSITION": builder.accessor(first), "NORMAL": builder.accessor(second)},
        {"POSITION": builder.sparse(4, [2], second[2:3]), "TEXCOORD_0": builder.accessor(first[:, :2])},
    ]
    mesh = builder.mesh(primitive, **({} if mesh_weights is None else {"weights": mesh_weights}))
    builder.node(mesh=mesh, **({} if node_weights is None else {"weights": node_weights}))
    soup = read_gltf(builder.write(tmp_path / "morph.glb"))
    only_third = second * [[0], [0], [1], [0]]
    np.testing.assert_allclose(soup.positions, TETRAHEDRON + applied[0] * first + applied[1] * only_third, atol=1e-15)
    np.testing.assert_allclose(soup.corner_normals, (normals + applied[0] * second)[FACES], atol=1e-15)
    moved = uv + applied[1] * first[:, :2]
    np.testing.assert_allclose(soup.corner_uv, (moved * [1, -1] + [0, 1])[FACES], atol=1e-15)


def skinned(weights, joints, inverse, **mesh_node) -> GltfBuilder:
    """A tetrahedron with two joints: the first at the origin, the second a turned and scaled child of it."""
    builder = GltfBuilder()
    primitive = builder.solid(NORMAL=builder.accessor(TETRAHEDRON - 0.25))
    for number in range(len(weights)):
        primitive["attributes"][f"JOINTS_{number}"] = builder.accessor(joints[number], "u1")
        primitive["attributes"][f"WEIGHTS_{number}"] = builder.accessor(weights[number])
    child = builder.node(root=False, translation=[0, 1, 0], rotation=TURN, scale=[2, 2, 3])
    root = builder.node(translation=[1, 0, 0], children=[child])
    matrices = builder.accessor(np.swapaxes(inverse, 1, 2).reshape(-1, 16))
    builder.json["skins"] = [{"joints": [root, child], "inverseBindMatrices": matrices}]
    builder.node(mesh=builder.mesh(primitive), skin=0, **mesh_node)
    return builder


def test_joints_move_the_vertices_of_a_skin_and_its_node_does_not(tmp_path):
    rng = np.random.default_rng(3)
    weights = rng.uniform(size=(2, 4, 4)) * (rng.uniform(size=(2, 4, 4)) > 0.3)
    joints = rng.integers(0, 2, (2, 4, 4))
    inverse = np.tile(np.eye(4), (2, 1, 1))
    inverse[:, :3] = rng.integers(-9, 9, (2, 3, 4)) / 8
    first, second = np.eye(4), np.eye(4)
    first[:3, 3] = [1, 0, 0]
    second[:3, :3] = turn(TURN) @ np.diag([2, 2, 3])
    second[:3, 3] = [1, 1, 0]
    expected, normals = np.zeros((4, 3)), np.zeros((4, 3))
    for vertex in range(4):
        blend = np.zeros((4, 4))
        for weight, joint in zip(weights[:, vertex].ravel(), joints[:, vertex].ravel(), strict=True):
            blend += np.float32(weight) * [first @ inverse[0], second @ inverse[1]][joint]
        blend /= weights[:, vertex].astype(np.float32).astype(np.float64).sum()
        expected[vertex] = blend[:3, :3] @ TETRAHEDRON[vertex] + blend[:3, 3]
        normals[vertex] = np.linalg.inv(blend[:3, :3]).T @ (TETRAHEDRON[vertex] - 0.25)
    builder = skinned(weights, joints, inverse, translation=[99, 0, 0], scale=[5, 5, 5])
    soup = read_gltf(builder.write(tmp_path / "skin.glb"))
    np.testing.assert_allclose(soup.positions, expected, atol=1e-13)
    found = np.zeros((4, 3))
    assert soup.corner_normals is not None
    found[soup.faces.ravel()] = soup.corner_normals.reshape(-1, 3)
    cosines = (found * normals).sum(axis=1) / np.linalg.norm(found, axis=1) / np.linalg.norm(normals, axis=1)
    np.testing.assert_allclose(cosines, 1, atol=1e-12)


def test_a_skin_in_its_bind_pose_leaves_the_mesh_as_it_is(tmp_path):
    pose = np.tile(np.eye(4), (2, 1, 1))
    pose[0, :3, 3] = [1, 0, 0]
    pose[1, :3, :3] = turn(TURN) @ np.diag([2, 2, 3])
    pose[1, :3, 3] = [1, 1, 0]
    weights, joints = [[[0.5, 0.25, 0, 0]] * 4], [[[0, 1, 0, 0]] * 4]
    soup = read_gltf(skinned(weights, joints, np.linalg.inv(pose)).write(tmp_path / "skin.glb"))
    np.testing.assert_allclose(soup.positions, TETRAHEDRON, atol=1e-6)
    mirror = np.diag([-1, 1, 1, 1])
    path = skinned(weights, joints, np.linalg.inv(pose) @ mirror, scale=[-1, 1, 1]).write(tmp_path / "mirrored.glb")
    np.testing.assert_allclose(read_gltf(path).positions, TETRAHEDRON * [-1, 1, 1], atol=1e-6)
    assert signed_volume(read_mesh(path)) == pytest.approx(1 / 6, abs=1e-6)


@pytest.mark.parametrize("bytes_of_rotations", [False, True])
def test_instances_are_copies(tmp_path, bytes_of_rotations):
    rotations = np.array([[0, 0, 0, 1], [0, 1, 0, 0], [0, 0, 1, 0]])
    translations, scales = np.array([[5, 0, 0], [0, 5, 0], [0, 0, 5]]), np.array([[1, 1, 1], [2, 1, 3], [-1, 1, 1]])
    one, many = tetrahedron(translation=[1, 2, 3], scale=[1, 1, 2]), GltfBuilder()
    mesh = many.mesh(many.solid())
    children = [
        many.node(root=False, mesh=mesh, translation=t.tolist(), rotation=r.tolist(), scale=s.tolist())
        for t, r, s in zip(translations, rotations, scales, strict=True)
    ]
    many.node(translation=[1, 2, 3], scale=[1, 1, 2], children=children[::-1])
    turned = one.accessor(rotations * 127, "i1", normalized=True) if bytes_of_rotations else one.accessor(rotations)
    attributes = {"TRANSLATION": one.accessor(translations), "ROTATION": turned, "SCALE": one.accessor(scales)}
    one.json["nodes"][0]["extensions"] = {"EXT_mesh_gpu_instancing": {"attributes": attributes}}
    one.json["extensionsRequired"] = ["EXT_mesh_gpu_instancing"]
    copies, nodes = read_gltf(one.write(tmp_path / "one.glb")), read_gltf(many.write(tmp_path / "many.glb"))
    np.testing.assert_allclose(copies.positions, nodes.positions, atol=1e-15)
    np.testing.assert_array_equal(copies.faces, nodes.faces)
    volume = signed_volume(read_mesh(tmp_path / "one.glb"))
    assert volume == pytest.approx(2 * (1 + 6 + 1) / 6, rel=1e-12)


def groups(shared: bool, skin: bool) -> GltfBuilder:
    """Two spheres, the second of them morphed, as primitives that share their vertices or have each its own."""
    builder, ball = GltfBuilder(), sphere_mesh(8, 12)
    count = len(ball.positions)
    rng = np.random.default_rng(4)
    positions = np.vstack([ball.positions, 3 + ball.positions]).astype("<f4")
    values = {
        "POSITION": (positions, "f4"),
        "NORMAL": (np.vstack([ball.positions] * 2), "f4"),
        "TEXCOORD_0": (rng.uniform(size=(2 * count, 2)), "f4"),
    }
    if skin:
        values |= {"JOINTS_0": (rng.integers(0, 2, (2 * count, 4)), "u1")}
        values |= {"WEIGHTS_0": (rng.uniform(size=(2 * count, 4)) + 0.1, "f4")}
    moved = rng.normal(size=(count, 3)) / 64
    whole = builder.view(positions.tobytes())
    every = {name: builder.accessor(rows, kind) for name, (rows, kind) in values.items()}
    every["POSITION"] = builder.sparse(2 * count, [5], positions[5:6], bufferView=whole)
    target = builder.sparse(2 * count, np.arange(count, 2 * count), moved)
    primitives = []
    for part in range(2):
        attributes, targets, faces = every, [{"POSITION": target}], ball.faces + part * count
        if not shared:
            own = slice(part * count, (part + 1) * count)
            attributes = {name: builder.accessor(rows[own], kind) for name, (rows, kind) in values.items()}
            targets, faces = [{"POSITION": builder.accessor(part * moved)}], ball.faces
        indices = builder.accessor(faces.ravel(), "u2")
        primitives.append({"attributes": attributes, "targets": targets, "indices": indices})
    builder.node(mesh=builder.mesh(*primitives, weights=[0.5]), **({"skin": 0} if skin else {}))
    joints = [builder.node(translation=[1, 0, 0]), builder.node(rotation=TURN, scale=[2, 2, 3])]
    builder.json["skins"] = [{"joints": joints}]
    return builder


@pytest.mark.parametrize("skin", [False, True])
def test_primitives_that_share_vertices_read_those_that_they_use(tmp_path, skin):
    shared = read_gltf(groups(True, skin).write(tmp_path / "shared.glb"))
    apart = read_gltf(groups(False, skin).write(tmp_path / "apart.glb"))
    for name in ("positions", "faces", "corner_normals", "corner_uv"):
        np.testing.assert_array_equal(getattr(shared, name), getattr(apart, name))


def test_hidden_nodes_hide_their_children(tmp_path):
    builder = tetrahedron()
    child = builder.node(root=False, mesh=0, extensions={"KHR_node_visibility": {"visible": True}})
    middle = builder.node(root=False, mesh=0, children=[child])
    builder.node(mesh=0, children=[middle], extensions={"KHR_node_visibility": {"visible": False}})
    assert len(read_gltf(builder.write(tmp_path / "hidden.glb")).faces) == 4


@pytest.mark.parametrize("scale", [(1, 2, 3), (-1, 2, 3), (-1, -2, -3)])
def test_normals_are_perpendicular_to_the_scaled_surface(tmp_path, scale):
    soup = read_gltf(textured(rotation=TURN, scale=scale, translation=[1, 2, 3]).write(tmp_path / "ball.glb"))
    assert soup.corner_normals is not None
    local = (soup.positions - [1, 2, 3]) @ turn(TURN) / scale
    expected = (local / scale) @ turn(TURN).T  # the gradient of the ellipsoid
    expected = (expected / np.linalg.norm(expected, axis=1, keepdims=True))[soup.faces]
    found = soup.corner_normals / np.linalg.norm(soup.corner_normals, axis=2, keepdims=True)
    np.testing.assert_allclose(found, expected, atol=1e-6)
    assert signed_volume(read_mesh(tmp_path / "ball.glb")) > 0


def test_normals_mean_the_same_as_in_obj(tmp_path):
    normals = np.array([[-1, -2, -3], [3, -1, -1], [-1, 4, -1], [-1, -1, 5]]) / 8
    builder = GltfBuilder()
    builder.node(mesh=builder.mesh(builder.solid(NORMAL=builder.accessor(normals))))
    rows = [f"v {x} {y} {z}" for x, y, z in TETRAHEDRON] + [f"vn {x} {y} {z}" for x, y, z in normals]
    rows += ["f " + " ".join(f"{i + 1}//{i + 1}" for i in face) for face in FACES]
    (tmp_path / "t.obj").write_text("\n".join(rows))
    mesh, other = read_mesh(builder.write(tmp_path / "t.glb")), read_mesh(tmp_path / "t.obj")
    np.testing.assert_array_equal(mesh.normals, other.normals)
    assert mesh.content_hash == other.content_hash


@pytest.mark.parametrize("attribute", ["NORMAL", "TEXCOORD_0"])
def test_attributes_that_some_parts_lack_are_left_out_with_a_warning(tmp_path, attribute):
    builder = tetrahedron()
    rows = builder.accessor(np.ones((4, 3 if attribute == "NORMAL" else 2)))
    builder.json["meshes"][0]["primitives"].append(builder.solid(TETRAHEDRON + 5, **{attribute: rows}))
    with pytest.warns(InputWarning, match="1 of 2 parts have no (normals|texture coordinates)"):
        soup = read_gltf(builder.write(tmp_path / "some.glb"))
    assert soup.corner_normals is None
    assert soup.corner_uv is None


def test_split_vertices_stay_at_one_place_when_they_are_turned(tmp_path):
    builder, ball = GltfBuilder(), sphere_mesh(12, 16)
    every = builder.accessor(ball.positions[ball.faces].reshape(-1, 3))
    builder.node(mesh=builder.mesh({"attributes": {"POSITION": every}}), rotation=TURN, scale=[1.1, 1.3, 0.7])
    mesh = read_mesh(builder.write(tmp_path / "split.glb"))
    assert (len(mesh.positions), open_edges(mesh)) == (len(ball.positions), 0)


def test_the_default_scene_is_read(tmp_path):
    builder = tetrahedron()
    builder.node(root=False, mesh=builder.mesh(builder.solid(TETRAHEDRON + 5)))
    builder.json["scenes"].append({"nodes": [1]})
    builder.json["scene"] = 1
    assert read_gltf(builder.write(tmp_path / "second.glb")).positions.min() == 5
    del builder.json["scene"]
    with pytest.warns(InputWarning, match="none of its 2 scenes as the default; the first is read"):
        assert read_gltf(builder.write(tmp_path / "first.glb")).positions.max() == 1
    del builder.json["scenes"]
    with pytest.warns(InputWarning, match="has no scene; all nodes are read"):
        assert len(read_gltf(builder.write(tmp_path / "all.glb")).faces) == 8


def test_a_long_chain_of_nodes_is_followed(tmp_path: Path):
    builder = GltfBuilder()
    mesh = builder.mesh(builder.solid())
    chain = [builder.node(root=False, children=[index + 1], translation=[1, 0, 0]) for index in range(1500)]
    builder.node(root=False, mesh=mesh)
    builder.json["scenes"][0]["nodes"] = chain[:1]
    assert read_gltf(builder.write(tmp_path / "chain.glb")).positions[:, 0].tolist() == [1500, 1501, 1500, 1500]
