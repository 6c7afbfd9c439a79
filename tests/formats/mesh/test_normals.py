"""Vertex normals that contradict the faces are reversed or replaced with a warning; meshes in memory are refused."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from bakers.transport import refuse_foreign
from formats.errors import InputWarning, MeshError
from formats.mesh import Mesh, build_mesh, flipped, read_mesh, signed_volume, write_mesh

Array = np.ndarray
Change = Callable[[Array], Array]


def ball() -> Mesh:
    made = trimesh.creation.icosphere(subdivisions=3)
    return build_mesh(made.vertices * [1.0, 0.7, 1.3], made.faces)


def tilted(n: Array) -> Array:
    """By 75 degrees: no normal points away from its faces."""
    across = np.cross(n, [0.3, 0.5, 0.8])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    return np.asarray(np.cos(np.radians(75.0)) * n + np.sin(np.radians(75.0)) * across)


def first(count: int, value: float) -> Change:
    """Multiply the first normals."""
    return lambda n: np.where(np.arange(len(n))[:, None] < count, value, 1.0) * n


FILES: dict[str, tuple[Change, str]] = {
    "inward": (lambda n: -n, "the vertex normals point inwards; they were reversed"),
    "dummy": (
        lambda n: np.broadcast_to([0.0, 0.0, 1.0], n.shape),
        "[0-9]+ of 642 vertex normals are missing or point away .* are used",
    ),
    "tilted": (tilted, "0 of 642 vertex normals are missing .* median angle being 75 degrees; normals computed"),
    "zero": (lambda n: 0.0 * n, "642 of 642 vertex normals are missing .* are used"),
    "not finite at one": (first(1, np.nan), "1 of 642 vertex normals are missing .*; there, normals computed"),
    "zero at one": (first(1, 0.0), "1 of 642 vertex normals are missing .*; there, normals computed"),
    "inward at a few": (
        first(5, -1.0),
        "5 of 642 vertex normals are missing or point away .*; there, normals computed",
    ),
}


@pytest.mark.parametrize("suffix", [".obj", ".ply"])
@pytest.mark.parametrize("kind", FILES)
def test_normals_that_contradict_the_faces_are_replaced(tmp_path: Path, kind: str, suffix: str) -> None:
    change, warning = FILES[kind]
    mesh, path = ball(), tmp_path / f"ball{suffix}"
    write_mesh(replace(mesh, normals=change(mesh.normals)), path)
    with pytest.warns(InputWarning, match=f"ball{suffix}: {warning}"):
        found = read_mesh(path)
    np.testing.assert_allclose(found.normals, mesh.normals, atol=1e-12)


def test_reversed_normals_are_those_of_the_file(tmp_path: Path) -> None:
    """Smoothed over more than the faces around them, they are not recomputed."""
    mesh = ball()
    smooth = mesh.positions / np.linalg.norm(mesh.positions, axis=1, keepdims=True)
    write_mesh(replace(mesh, normals=-smooth), tmp_path / "ball.ply")
    with pytest.warns(InputWarning, match="they were reversed"):
        found = read_mesh(tmp_path / "ball.ply")
    np.testing.assert_allclose(found.normals, smooth, atol=1e-12)


@pytest.mark.parametrize("change", [lambda n: 3.0 * n, lambda n: n + 0.3 * np.roll(n, 1, axis=1)])
def test_normals_of_another_length_or_slightly_off_are_kept(tmp_path: Path, change: Change) -> None:
    mesh = ball()
    given = change(mesh.normals)
    write_mesh(replace(mesh, normals=given), tmp_path / "ball.ply")
    expected = given / np.linalg.norm(given, axis=1, keepdims=True)
    np.testing.assert_allclose(read_mesh(tmp_path / "ball.ply").normals, expected, atol=1e-12)


REFUSED: dict[str, tuple[Callable[[Mesh], Mesh], str]] = {
    "inside out": (flipped, "the faces are wound inside out"),
    "inward normals": (lambda mesh: replace(mesh, normals=-mesh.normals), "642 of 642 vertex normals point away"),
    "not unit": (lambda mesh: replace(mesh, normals=0.5 * mesh.normals), "642 of 642 normals are not unit vectors"),
    "not finite": (
        lambda mesh: replace(mesh, normals=np.nan * mesh.normals),
        "642 of 642 normals are not unit vectors",
    ),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_bakes_refuse_meshes_in_memory_that_face_the_wrong_side(kind: str) -> None:
    change, message = REFUSED[kind]
    with pytest.raises(MeshError, match=f"^mesh: .*{message}"):
        refuse_foreign(object(), change(ball()))


def test_an_open_mesh_may_face_either_side() -> None:
    mesh = ball()
    refuse_foreign(object(), flipped(build_mesh(mesh.positions, mesh.faces[:600])))


def test_sheets_with_two_sides_are_neither_way_round() -> None:
    """Their volume is 0, and its rounding has either sign."""
    one_side = ball()
    both = np.concatenate([one_side.faces, one_side.faces[:, ::-1] + len(one_side.positions)])
    volumes = []
    for turn in Rotation.random(10, np.random.default_rng(3)):
        positions = turn.apply(one_side.positions)
        sheet = build_mesh(np.concatenate([positions, positions]), both)
        refuse_foreign(object(), sheet)
        volumes.append(signed_volume(sheet))
    assert min(volumes) < 0.0


def test_vertices_of_no_face_may_face_anywhere() -> None:
    mesh = ball()
    positions, normals = (np.concatenate([rows, [[9.0, 0.0, 0.0]] * 99]) for rows in (mesh.positions, -mesh.normals))
    normals[: len(mesh.normals)] *= -1.0
    normals[len(mesh.normals) :] /= 9.0
    refuse_foreign(object(), Mesh(positions, mesh.faces, normals))
    refuse_foreign(object(), Mesh(positions[:1], np.zeros((0, 3), np.int32), normals[:1]))


@pytest.mark.parametrize("faces", [512, 300])
def test_faces_of_opposite_winding_are_a_warning(faces: int) -> None:
    """Normals computed from such faces agree with them, and point inwards."""
    mixed = ball().faces[:faces].copy()
    mixed[:100] = mixed[:100, ::-1]
    with pytest.warns(InputWarning, match="edges lie between faces of opposite winding"):
        refuse_foreign(object(), build_mesh(ball().positions, mixed))


def two_sided(kind: str) -> tuple[Array, Array, Array]:
    """Positions, faces and corner normals of a ball each of whose faces is doubled with the opposite winding."""
    mesh = ball()
    order = (
        np.random.default_rng(1).random(len(mesh.faces)) < {"front first": 0.0, "back first": 1.0, "mixed": 0.4}[kind]
    )
    front = np.where(order[:, None], mesh.faces[:, ::-1], mesh.faces)
    sides = np.where(order[:, None, None], -1.0, 1.0) * mesh.normals[front]
    faces = np.stack([front, front[:, ::-1]], axis=1).reshape(-1, 3)
    return mesh.positions, faces, np.stack([sides, -sides[:, ::-1]], axis=1).reshape(-1, 3, 3)


def written(path: Path, positions: Array, faces: Array, corner_normals: Array | None = None) -> Path:
    rows = ["v {:.17g} {:.17g} {:.17g}".format(*row) for row in positions]
    if corner_normals is not None:
        rows += ["vn {:.6f} {:.6f} {:.6f}".format(*row) for row in corner_normals.reshape(-1, 3)]
    corner = (lambda v, n: f"{v}") if corner_normals is None else (lambda v, n: f"{v}//{n}")
    for face, row in enumerate(np.asarray(faces) + 1):
        rows.append("f " + " ".join(corner(v, len(row) * face + k + 1) for k, v in enumerate(row)))
    path.write_text("\n".join([*rows, ""]))
    return path


@pytest.mark.parametrize("with_normals", [False, True])
@pytest.mark.parametrize("kind", ["front first", "back first", "mixed"])
def test_bakes_refuse_two_sides_whose_normals_cancel(tmp_path: Path, kind: str, with_normals: bool) -> None:
    positions, faces, normals = two_sided(kind)
    mesh = read_mesh(written(tmp_path / "ball.obj", positions, faces, normals if with_normals else None))
    assert mesh.cancelled_normals == 642
    with pytest.raises(MeshError, match=r"^mesh: 2560 of 2560 faces lie on another .*: the mesh has two sides; export"):
        refuse_foreign(object(), mesh)
    with pytest.raises(MeshError, match="the mesh has two sides"):
        refuse_foreign(object(), build_mesh(positions, faces))


def test_bakes_refuse_two_sides_that_are_divided_along_other_diagonals(tmp_path: Path) -> None:
    box = np.array([[x, y, z] for z in (0.0, 1.0) for y in (0.0, 2.0) for x in (0.0, 3.0)])
    quads = np.array([[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]])
    mesh = read_mesh(written(tmp_path / "box.obj", box, np.concatenate([quads, quads[:, ::-1]])))
    with pytest.raises(MeshError, match="normals of 8 of 8 vertices cancel out: the mesh has two sides; export"):
        refuse_foreign(object(), mesh)


@pytest.mark.parametrize("kind", ["front first", "back first", "mixed"])
def test_two_sides_are_baked_with_normals_of_the_file(tmp_path: Path, kind: str) -> None:
    """One normal per vertex, for both sides."""
    positions, faces, _ = two_sided(kind)
    write_mesh(replace(build_mesh(positions, faces), normals=ball().normals), tmp_path / "ball.ply")
    mesh = read_mesh(tmp_path / "ball.ply")
    np.testing.assert_allclose(mesh.normals, ball().normals, atol=1e-12)
    refuse_foreign(object(), mesh)


def test_a_flap_is_a_warning() -> None:
    mesh = ball()
    tip = mesh.positions[mesh.faces[0, 0]] * 1.1
    a, b = mesh.faces[0, :2]
    positions, flap = np.concatenate([mesh.positions, [tip]]), [[a, b, 642], [b, a, 642]]
    with pytest.warns(
        InputWarning, match=r"^mesh: 2 of 1282 faces lie on another .* 1 of 643 vertices cancel out; the"
    ):
        refuse_foreign(object(), build_mesh(positions, np.concatenate([mesh.faces, flap])))


def test_solids_that_touch_at_a_vertex_have_one_side() -> None:
    """There the normals of their faces cancel out."""
    tip = trimesh.creation.box((1.0, 1.0, 1.0))
    positions = np.concatenate([tip.vertices + 0.5, tip.vertices - 0.5])
    first, number = np.unique(positions, axis=0, return_inverse=True)
    mesh = build_mesh(first, number.ravel()[np.concatenate([tip.faces, tip.faces + 8])])
    assert mesh.cancelled_normals == 1
    refuse_foreign(object(), mesh)


def test_outward_normals_of_faces_inside_out_are_no_fault(tmp_path: Path) -> None:
    """A mirrored mesh: bakes refuse its faces, scenes reverse both."""
    mesh = ball()
    write_mesh(replace(mesh, faces=mesh.faces[:, ::-1]), tmp_path / "ball.ply")
    found = read_mesh(tmp_path / "ball.ply")
    np.testing.assert_allclose(flipped(found).normals, mesh.normals, atol=1e-12)
    with pytest.raises(MeshError, match="the faces are wound inside out"):
        refuse_foreign(object(), found)
