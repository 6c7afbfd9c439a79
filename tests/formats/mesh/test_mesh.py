"""Meshes: round trips, merged vertices, exact numbers, and damaged files."""

import re
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from formats.errors import MeshError, StorageError
from formats.mesh import (
    Mesh,
    build_mesh,
    check_mesh,
    flipped,
    inconsistent_edges,
    open_edges,
    read_mesh,
    signed_volume,
    write_mesh,
)

TETRAHEDRON = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float64)
TETRAHEDRON_FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
CUBE_QUADS = [(1, 4, 3, 2), (5, 6, 7, 8), (1, 2, 6, 5), (2, 3, 7, 6), (3, 4, 8, 7), (4, 1, 5, 8)]
CUBE_CORNERS = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)]


def tetrahedron() -> Mesh:
    return build_mesh(TETRAHEDRON, TETRAHEDRON_FACES)


def sphere_mesh(rows: int = 8, columns: int = 12) -> Mesh:
    """A closed sphere of latitude rows with a vertex at each pole."""
    theta = np.repeat(np.arange(1, rows) * np.pi / rows, columns)
    phi = np.tile(np.arange(columns) * 2 * np.pi / columns, rows - 1)
    ring = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=1)
    positions = np.vstack([[0, 0, 1], ring, [0, 0, -1]])
    here, ahead = np.arange(columns), (np.arange(columns) + 1) % columns
    last = len(positions) - 1
    faces = [np.stack([np.zeros(columns, int), 1 + here, 1 + ahead], axis=1)]
    for row in range(rows - 2):
        a, b = 1 + row * columns, 1 + (row + 1) * columns
        faces += [np.stack([a + here, b + here, b + ahead], 1), np.stack([a + here, b + ahead, a + ahead], 1)]
    base = 1 + (rows - 2) * columns
    faces.append(np.stack([base + here, np.full(columns, last), base + ahead], axis=1))
    return build_mesh(positions, np.vstack(faces))


def ascii_ply(vertices: str, faces: str, kind: str = "float") -> str:
    count, face_count = len(vertices.splitlines()), len(faces.splitlines())
    return (
        f"ply\nformat ascii 1.0\ncomment made by hand\nelement vertex {count}\nproperty {kind} x\nproperty {kind} y\n"
        f"property {kind} z\nelement face {face_count}\nproperty list uchar int vertex_indices\nend_header\n"
        f"{vertices}\n{faces}\n"
    )


TETRAHEDRON_VERTICES = "0 0 0\n1 0 0\n0 1 0\n0 0 1"
TETRAHEDRON_ROWS = "3 0 2 1\n3 0 1 3\n3 0 3 2\n3 1 2 3"


@pytest.mark.parametrize("suffix", [".ply", ".obj"])
@settings(max_examples=25, deadline=None, derandomize=True, database=None)
@given(
    jitter=npst.arrays(np.float64, (86, 3), elements=st.floats(-0.04, 0.04)),
    scale=st.floats(1e-6, 1e6),
    shift=st.floats(-1e3, 1e3),
)
def test_every_mesh_survives_write_and_read(tmp_path_factory, suffix, jitter, scale, shift):
    ball = sphere_mesh()
    mesh = build_mesh((ball.positions + jitter) * scale + shift, ball.faces)
    before = mesh.positions.copy()
    path = tmp_path_factory.mktemp("mesh") / f"ball{suffix}"
    write_mesh(mesh, path)
    again = read_mesh(path)
    np.testing.assert_array_equal(mesh.positions, before)
    np.testing.assert_array_equal(again.positions, before)
    np.testing.assert_array_equal(again.faces, mesh.faces)
    np.testing.assert_allclose(again.normals, mesh.normals, rtol=0, atol=1e-15)
    assert again.content_hash == mesh.content_hash
    assert again.source_vertex is None


@pytest.mark.parametrize("suffix", [".ply", ".obj"])
def test_texture_coordinates_survive(tmp_path, suffix):
    mesh = Mesh(TETRAHEDRON, TETRAHEDRON_FACES, tetrahedron().normals, uv=np.arange(8).reshape(4, 2) / 7)
    write_mesh(mesh, tmp_path / f"t{suffix}")
    np.testing.assert_array_equal(read_mesh(tmp_path / f"t{suffix}").uv, mesh.uv)


def seamed_cube(folder) -> Mesh:
    """A cube with a texture atlas: every face has its own square, so each vertex has three pairs."""
    rows = [f"v {x} {y} {z}" for x, y, z in CUBE_CORNERS]
    rows += [f"vt {(i % 3 + u) / 3} {(i // 3 + v) / 2}" for i in range(6) for u, v in ((0, 0), (1, 0), (1, 1), (0, 1))]
    rows += ["f " + " ".join(f"{v}/{4 * i + c + 1}" for c, v in enumerate(quad)) for i, quad in enumerate(CUBE_QUADS)]
    (folder / "cube.obj").write_text("\n".join(rows))
    return read_mesh(folder / "cube.obj")


@pytest.mark.parametrize("suffix", [".ply", ".obj"])
def test_seams_survive_merging_and_writing(tmp_path, suffix):
    mesh = seamed_cube(tmp_path)
    assert (len(mesh.positions), mesh.corner_uv.shape, mesh.seamless) == (8, (12, 3, 2), False)
    np.testing.assert_allclose(mesh.corner_uv[2], [[1 / 3, 0], [2 / 3, 0], [2 / 3, 0.5]], atol=1e-15)
    write_mesh(mesh, tmp_path / f"again{suffix}")
    again = read_mesh(tmp_path / f"again{suffix}")
    np.testing.assert_array_equal(again.corner_uv, mesh.corner_uv)
    np.testing.assert_array_equal(again.uv, mesh.uv)


@pytest.mark.parametrize("suffix", [".ply", ".obj"])
def test_texture_coordinates_of_corners_survive_without_those_of_vertices(tmp_path, suffix):
    corner_uv = np.arange(24.0).reshape(4, 3, 2) / 7
    mesh = Mesh(TETRAHEDRON, TETRAHEDRON_FACES, tetrahedron().normals, corner_uv=corner_uv)
    assert mesh.uv is None
    assert not mesh.seamless
    write_mesh(mesh, tmp_path / f"corners{suffix}")
    again = read_mesh(tmp_path / f"corners{suffix}")
    np.testing.assert_array_equal(again.faces, mesh.faces)
    np.testing.assert_array_equal(again.corner_uv, corner_uv)


def test_triangulated_polygons_of_a_ply_keep_their_texture_coordinates(tmp_path):
    corners = "\n".join(f"{x} {y} {z}" for x, y, z in CUBE_CORNERS)
    pairs = [(0, 0), (1, 0), (1, 0.5), (0, 0.5)]
    rows = "\n".join(
        f"4 {' '.join(str(i - 1) for i in quad)} 8 {' '.join(f'{u + k} {v}' for u, v in pairs)}"
        for k, quad in enumerate(CUBE_QUADS)
    )
    (tmp_path / "cube.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 8\nproperty float x\nproperty float y\nproperty float z\n"
        "element face 6\nproperty list uchar int vertex_indices\nproperty list uchar float texcoord\nend_header\n"
        f"{corners}\n{rows}\n"
    )
    mesh = read_mesh(tmp_path / "cube.ply")
    expected = [[(u + k, v) for u, v in (pairs[i] for i in fan)] for k in range(6) for fan in ((0, 1, 2), (0, 2, 3))]
    np.testing.assert_array_equal(mesh.corner_uv, expected)


def test_flipped_faces_keep_the_texture_coordinates_of_each_corner(tmp_path):
    mesh = seamed_cube(tmp_path)
    reversed_mesh = flipped(mesh)
    for face in range(12):
        before = {int(v): tuple(uv) for v, uv in zip(mesh.faces[face], mesh.corner_uv[face], strict=True)}
        after = {
            int(v): tuple(uv) for v, uv in zip(reversed_mesh.faces[face], reversed_mesh.corner_uv[face], strict=True)
        }
        assert before == after
    np.testing.assert_array_equal(flipped(reversed_mesh).corner_uv, mesh.corner_uv)


def test_texture_coordinates_of_dropped_faces_are_dropped(tmp_path):
    text = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nvt 0 0\nvt 1 0\nvt 0 1\nvt 0.5 0.5\n"
    (tmp_path / "t.obj").write_text(
        text + "f 1/1 2/2 2/2\nf 1/1 3/3 2/2\nf 1/4 2/4 4/4\nf 1/1 4/2 3/3\nf 2/1 3/2 4/3\n"
    )
    mesh = read_mesh(tmp_path / "t.obj", drop_flat_faces=True)
    assert mesh.dropped_faces == 1
    np.testing.assert_array_equal(mesh.corner_uv[0], [[0, 0], [0, 1], [1, 0]])
    np.testing.assert_array_equal(mesh.corner_uv[1], np.full((3, 2), 0.5))


def test_texture_coordinates_of_vertices_are_copied_to_corners():
    mesh = Mesh(TETRAHEDRON, TETRAHEDRON_FACES, tetrahedron().normals, uv=np.arange(8).reshape(4, 2) / 7)
    np.testing.assert_array_equal(mesh.corner_uv, mesh.uv[TETRAHEDRON_FACES])
    assert mesh.seamless
    assert tetrahedron().corner_uv is None
    with pytest.raises(MeshError, match="corner_uv: expected shape"):
        Mesh(TETRAHEDRON, TETRAHEDRON_FACES, tetrahedron().normals, corner_uv=np.zeros((4, 2)))


def test_gltf_texture_coordinates_point_upwards(tmp_path):
    import trimesh

    solid = trimesh.Trimesh(TETRAHEDRON, TETRAHEDRON_FACES, process=False)
    solid.visual = trimesh.visual.TextureVisuals(uv=[[0, 0], [1, 0], [0, 0.75], [0.25, 1]])
    (tmp_path / "one.glb").write_bytes(trimesh.exchange.gltf.export_glb(trimesh.Scene(solid)))
    mesh = read_mesh(tmp_path / "one.glb")
    expected = {(0, 0, 0): (0, 0), (1, 0, 0): (1, 0), (0, 1, 0): (0, 0.75), (0, 0, 1): (0.25, 1)}
    for position, uv in zip(mesh.positions[mesh.faces].reshape(-1, 3), mesh.corner_uv.reshape(-1, 2), strict=True):
        assert tuple(uv) == expected[tuple(position)]


def test_float64_is_exact_in_ascii_and_both_byte_orders(tmp_path):
    third = 1 / 3
    for order, word in (("<", "binary_little_endian"), (">", "binary_big_endian")):
        header = ascii_ply(TETRAHEDRON_VERTICES, TETRAHEDRON_ROWS, "double").split("end_header\n")[0]
        body = struct.pack(f"{order}12d", 0, 0, third, 1, 0, 0, 0, 1, 0, 0, 0, 1e9 + third)
        body += b"".join(struct.pack(f"{order}B3i", 3, *face) for face in TETRAHEDRON_FACES)
        path = tmp_path / "t.ply"
        path.write_bytes(header.replace("ascii", word).encode() + b"end_header\n" + body)
        assert read_mesh(path).positions[[0, 3], 2].tolist() == [third, 1e9 + third]
    text = ascii_ply(TETRAHEDRON_VERTICES.replace("1 0 0", f"{third!r} 0 0"), TETRAHEDRON_ROWS, "double")
    (tmp_path / "t.ply").write_text(text)
    assert read_mesh(tmp_path / "t.ply").positions[1, 0] == third


def test_ply_ignores_unknown_properties_and_triangulates_polygons(tmp_path):
    corners = "\n".join(f"{x} {y} {z} 255" for x, y, z in CUBE_CORNERS)
    quads = "\n".join(f"4 {' '.join(str(i - 1) for i in quad)} 7" for quad in CUBE_QUADS[1:])
    triangles = "3 0 3 2 7\n3 0 2 1 7"
    (tmp_path / "cube.ply").write_text(
        "ply\nformat ascii 1.0\nelement material 1\nproperty list uchar float colour\n"
        "element vertex 8\nproperty float x\nproperty float y\nproperty float z\nproperty uchar red\n"
        "element face 7\nproperty list uchar int vertex_index\nproperty uchar flags\nend_header\n"
        f"2 0.5 0.5\n{corners}\n{triangles}\n{quads}\n"
    )
    mesh = read_mesh(tmp_path / "cube.ply")
    assert (len(mesh.positions), len(mesh.faces), open_edges(mesh), inconsistent_edges(mesh)) == (8, 12, 0, 0)
    assert signed_volume(mesh) == pytest.approx(1, abs=1e-15)
    assert mesh.face_areas.sum() == pytest.approx(6, abs=1e-15)


def test_vertices_split_by_normals_are_merged(tmp_path):
    rows = [f"v {x} {y} {z}" for quad in CUBE_QUADS for x, y, z in (CUBE_CORNERS[i - 1] for i in quad)]
    rows += ["vn 0 0 -1", "vn 0 0 1", "vn 0 -1 0", "vn 1 0 0", "vn 0 1 0", "vn -1 0 0"]
    rows += ["f " + " ".join(f"{4 * i + c + 1}//{i + 1}" for c in range(4)) for i in range(6)]
    (tmp_path / "cube.obj").write_text("\n".join(rows))
    mesh = read_mesh(tmp_path / "cube.obj")
    assert (len(mesh.positions), len(mesh.faces), open_edges(mesh)) == (8, 12, 0)
    assert mesh.source_vertex is not None
    assert mesh.source_vertex.shape == (24,)
    sources = np.array([CUBE_CORNERS[i - 1] for quad in CUBE_QUADS for i in quad], np.float64)
    np.testing.assert_array_equal(mesh.positions[mesh.source_vertex], sources)
    # Angle weights make the corner normals diagonal for every triangulation of the quads.
    np.testing.assert_allclose(mesh.normals, (2 * mesh.positions - 1) / np.sqrt(3), atol=1e-15)


def test_unused_vertices_are_removed(tmp_path):
    vertices = "9 9 9\n" + TETRAHEDRON_VERTICES + "\n-0.0 0 0"
    rows = "3 1 3 2\n3 5 2 4\n3 1 4 3\n3 2 3 4"
    (tmp_path / "t.ply").write_text(ascii_ply(vertices, rows))
    mesh = read_mesh(tmp_path / "t.ply")
    assert mesh.source_vertex is not None
    assert mesh.source_vertex.tolist() == [-1, 0, 1, 2, 3, 0]
    np.testing.assert_array_equal(mesh.positions, TETRAHEDRON)
    assert open_edges(mesh) == 0


def test_obj_accepts_negative_indices_and_continued_lines(tmp_path):
    text = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf -4 -2 -3\nf 1 2 4 # base\nf 1 4 \\\n3\nusemtl wax\nf 2/ 3/ 4/\n"
    (tmp_path / "t.obj").write_text(text)
    mesh = read_mesh(tmp_path / "t.obj")
    np.testing.assert_array_equal(mesh.faces, TETRAHEDRON_FACES)
    np.testing.assert_array_equal(mesh.positions, TETRAHEDRON)


def test_gltf_parts_are_transformed_by_their_nodes(tmp_path):
    import trimesh

    solid = trimesh.Trimesh(TETRAHEDRON, TETRAHEDRON_FACES, process=False)
    scene = trimesh.Scene()
    scene.add_geometry(solid, transform=np.diag([1.0, 1, 1, 1]))
    scene.add_geometry(solid, transform=trimesh.transformations.translation_matrix([5.0, 0, 0]))
    (tmp_path / "two.glb").write_bytes(trimesh.exchange.gltf.export_glb(scene))
    mesh = read_mesh(tmp_path / "two.glb")
    assert (len(mesh.positions), len(mesh.faces), open_edges(mesh)) == (8, 8, 0)
    assert mesh.bounds.tolist() == [[0, 0, 0], [6, 1, 1]]
    assert signed_volume(mesh) == pytest.approx(1 / 3)


def test_volume_and_normals_of_a_sphere():
    ball = sphere_mesh(40, 80)
    assert open_edges(ball) == 0
    assert signed_volume(ball) == pytest.approx(4 / 3 * np.pi, rel=5e-3)
    assert signed_volume(flipped(ball)) == pytest.approx(-signed_volume(ball), rel=1e-13)
    np.testing.assert_allclose(ball.normals, ball.positions, atol=2e-3)
    np.testing.assert_array_equal(flipped(ball).normals, -ball.normals)
    moved = build_mesh(ball.positions + 1e6, ball.faces)
    assert signed_volume(moved) == pytest.approx(signed_volume(ball), rel=1e-9)
    np.testing.assert_allclose(moved.normals, ball.normals, atol=1e-8)


def test_open_and_inconsistent_edges_are_counted():
    assert open_edges(build_mesh(TETRAHEDRON, TETRAHEDRON_FACES[1:])) == 3
    one_flipped = TETRAHEDRON_FACES.copy()
    one_flipped[0] = one_flipped[0][::-1]
    mesh = build_mesh(TETRAHEDRON, one_flipped)
    assert (open_edges(mesh), inconsistent_edges(mesh)) == (0, 3)


DAMAGED = {
    "NaN": (ascii_ply(TETRAHEDRON_VERTICES.replace("0 1 0", "0 nan 0"), TETRAHEDRON_ROWS), "1 of 4 vertices.*vertex 2"),
    "infinite": (ascii_ply(TETRAHEDRON_VERTICES.replace("0 0 1", "0 0 inf"), TETRAHEDRON_ROWS), "vertex 3"),
    "index": (ascii_ply(TETRAHEDRON_VERTICES, TETRAHEDRON_ROWS.replace("1 2 3", "1 2 4")), "face 3.*from 0 to 3"),
    "negative": (ascii_ply(TETRAHEDRON_VERTICES, TETRAHEDRON_ROWS.replace("1 2 3", "1 2 -1")), "face 3"),
    "flat": (ascii_ply(TETRAHEDRON_VERTICES, "3 0 1 1"), "1 of 1 faces have no area.*face 0"),
    "collinear": (
        ascii_ply(TETRAHEDRON_VERTICES + "\n0.5 0 0", "3 0 2 1\n3 0 4 3\n3 4 1 3\n3 0 3 2\n3 1 2 3\n3 0 1 4"),
        "1 of 6 faces have no area.*face 5",
    ),
    "cloud": (ascii_ply(TETRAHEDRON_VERTICES, ""), "no faces"),
    "cut in a row": (ascii_ply(TETRAHEDRON_VERTICES, TETRAHEDRON_ROWS)[:-4], "truncated.*row 3 of element face"),
    "cut in the header": ("ply\nformat ascii 1.0\nelement vertex 4\n", "end_header"),
    "words": (ascii_ply(TETRAHEDRON_VERTICES.replace("1 0 0", "1 x 0"), TETRAHEDRON_ROWS), "damaged"),
    "header": (ascii_ply("0 0 0", "").replace("float y", "quad y"), "line 6"),
    "a list of lists": (ascii_ply("0 0 0", "-1"), "list of length -1"),
    "not PLY": ("solid stl\n", "not a PLY"),
    "empty": ("", "not a PLY"),
}


@pytest.mark.parametrize("case", DAMAGED)
def test_damaged_ply_is_refused_in_one_sentence(tmp_path, case):
    text, sentence = DAMAGED[case]
    (tmp_path / "bad.ply").write_text(text)
    with pytest.raises(MeshError, match=sentence) as caught:
        read_mesh(tmp_path / "bad.ply")
    assert str(caught.value).startswith(str(tmp_path / "bad.ply"))
    assert "\n" not in str(caught.value)
    assert check_mesh(tmp_path / "bad.ply")[0] == str(caught.value)


def test_a_truncated_binary_ply_is_refused(tmp_path):
    write_mesh(sphere_mesh(), tmp_path / "ball.ply")
    content = (tmp_path / "ball.ply").read_bytes()
    for tenth in range(10):
        (tmp_path / "cut.ply").write_bytes(content[: len(content) * tenth // 10])
        with pytest.raises(MeshError, match=re.escape(str(tmp_path / "cut.ply"))):
            read_mesh(tmp_path / "cut.ply")


def test_errors_in_obj_name_the_line(tmp_path):
    for text, sentence in (
        ("v 0 0 0\nv 1 0\n", "line 2"),
        ("v 0 0 0\nf 1 0 1\n", "line 2"),
        ("v 0 0 0\n", "no faces"),
        (
            "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\n",
            r"1 of 1 faces .* do not exist, the first is line 4 with corners \[1, 2, 4\]; expected numbers from 1 to 3",
        ),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 -4\n", "line 4: a face uses vertex -4, but only 3 vertices come before"),
        ("v 0,5 0 0\n", "line 1: .* 'v 0,5 0 0'; its numbers have commas; export it again with decimal points"),
        ("\0\1", "not an OBJ"),
    ):
        (tmp_path / "bad.obj").write_text(text)
        with pytest.raises(MeshError, match=sentence):
            read_mesh(tmp_path / "bad.obj")


def test_other_formats_are_refused(tmp_path):
    (tmp_path / "bad.glb").write_bytes(b"\x89HDF\r\n\x1a\nnothing")
    with pytest.raises(MeshError, match="glTF"):
        read_mesh(tmp_path / "bad.glb")
    with pytest.raises(MeshError, match=r"expected \.ply"):
        read_mesh(tmp_path / "mesh.fbx")
    with pytest.raises(MeshError, match=r"expected \.ply or \.obj"):
        write_mesh(tetrahedron(), tmp_path / "mesh.stl")
    with pytest.raises(StorageError, match="no such file"):
        read_mesh(tmp_path / "missing.ply")


def test_flat_faces_can_be_dropped_and_are_counted(tmp_path):
    (tmp_path / "t.ply").write_text(ascii_ply(TETRAHEDRON_VERTICES, TETRAHEDRON_ROWS + "\n3 0 1 1"))
    mesh = read_mesh(tmp_path / "t.ply", drop_flat_faces=True)
    assert (mesh.dropped_faces, len(mesh.faces), open_edges(mesh)) == (1, 4, 0)


def test_check_mesh_reports_holes_winding_and_lost_precision(tmp_path):
    ball = sphere_mesh()
    write_mesh(ball, tmp_path / "good.ply")
    assert check_mesh(tmp_path / "good.ply") == []
    write_mesh(build_mesh(ball.positions, ball.faces[1:]), tmp_path / "open.ply")
    assert "3 edges" in check_mesh(tmp_path / "open.ply")[0]
    write_mesh(flipped(ball), tmp_path / "inside_out.ply")
    assert "inside out" in check_mesh(tmp_path / "inside_out.ply")[0]
    far = (ball.positions + 1e4).astype(np.float32).astype(np.float64)
    write_mesh(build_mesh(far, ball.faces), tmp_path / "far.ply")
    assert "rounded to float32" in check_mesh(tmp_path / "far.ply")[0]


def test_wrong_shapes_are_refused():
    with pytest.raises(MeshError, match=r"normals: expected shape \[4, 3\], found \[3, 3\]"):
        Mesh(TETRAHEDRON, TETRAHEDRON_FACES, np.zeros((3, 3)))


@pytest.mark.parametrize("value", ["nan", "inf", "1e300"])
def test_unused_vertices_may_be_anywhere(tmp_path, value):
    """Scanners mark missing points by NaN."""
    rows = "3 1 3 2\n3 1 2 4\n3 1 4 3\n3 2 3 4"
    (tmp_path / "t.ply").write_text(ascii_ply(f"{value} 0 {value}\n{TETRAHEDRON_VERTICES}", rows))
    mesh = read_mesh(tmp_path / "t.ply")
    np.testing.assert_array_equal(mesh.positions, TETRAHEDRON)
    assert mesh.source_vertex is not None
    assert mesh.source_vertex.tolist() == [-1, 0, 1, 2, 3]
    (tmp_path / "t.ply").write_text(ascii_ply(f"{value} 0 {value}\n{TETRAHEDRON_VERTICES}", "3 0 3 2\n" + rows[8:]))
    with pytest.raises(MeshError, match=r"1 of 5 vertices are NaN, infinite or beyond .* the first is vertex 0"):
        read_mesh(tmp_path / "t.ply")
