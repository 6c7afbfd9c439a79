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
