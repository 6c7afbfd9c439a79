"""Overlapping, crossing and wrongly nested shells are found; cavities and touching or separate solids are sound."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from formats.errors import InputWarning, MeshError
from formats.mesh import Mesh, build_mesh, read_mesh
from prt_bake.geometry.shells import ambiguity, crossings, refuse_ambiguous, shells
from prt_bake.shipped.demonstration import SHIPPED
from prt_bake.tracer.estimate import estimate_coefficients
from tests.tracer.scenes import make_scene


def ball(x: float = 0.0, radius: float = 1.0, inwards: bool = False) -> trimesh.Trimesh:
    made = trimesh.creation.icosphere(subdivisions=2, radius=radius).apply_translation([x, 0.1 * x, 0.03 * x])
    if inwards:
        made.invert()
    return made


def box(x: float = 0.0, y: float = 0.0) -> trimesh.Trimesh:
    return trimesh.creation.box().apply_translation([x, y, 0.0])


def united(*solids: trimesh.Trimesh) -> Mesh:
    every = trimesh.util.concatenate(solids)
    return build_mesh(every.vertices, every.faces)


def tube_through_itself() -> Mesh:
    """A torus whose ring is a figure of eight: it crosses itself once."""
    turn = np.linspace(0.0, 2.0 * np.pi, 60, endpoint=False)
    centres = np.stack([np.sin(turn), np.sin(2.0 * turn), 0.0 * turn], axis=1)
    along = np.stack([np.cos(turn), 2.0 * np.cos(2.0 * turn), 0.0 * turn], axis=1)
    across = np.cross(along, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    around = np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)
    ring = np.cos(around)[:, None, None] * across + np.sin(around)[:, None, None] * np.array([0.0, 0.0, 1.0])
    positions = (centres + 0.15 * ring).transpose(1, 0, 2).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(60), np.arange(12), indexing="ij")
    corner = [(i + a) % 60 * 12 + (j + b) % 12 for a, b in ((0, 0), (1, 0), (1, 1), (0, 1))]
    faces = np.concatenate(
        [np.stack([corner[k] for k in order], -1).reshape(-1, 3) for order in ((0, 1, 2), (0, 2, 3))]
    )
    made = trimesh.Trimesh(positions, faces, process=False)
    return build_mesh(positions, faces if made.volume > 0 else faces[:, ::-1])


def coarse_copy_inside() -> Mesh:
    """A ball and a coarser one of every fourth of its vertices, as levels of detail are: they touch at these."""
    fine, coarse = ball(), trimesh.creation.icosphere(subdivisions=1)
    nearest = np.linalg.norm(fine.vertices - coarse.vertices[:, None], axis=2).argmin(axis=1)
    return build_mesh(fine.vertices, np.concatenate([fine.faces, nearest[coarse.faces]]))


AMBIGUOUS = {
    "overlapping": (united(ball(), ball(1.0)), "some of its 2 shells overlap: [0-9]+ edges pass through faces"),
    "mirrored": (united(box(-0.25), box(0.25)), "some of its 2 shells overlap"),
    "nested": (united(ball(), ball(radius=0.5)), "one of its 2 shells, at .* is in another and not wound as a cavity"),
    "touching at vertices": (
        coarse_copy_inside(),
        "one of its 2 shells, at .* is in another and not wound as a cavity",
    ),
    "self-crossing": (tube_through_itself(), "its surface crosses itself"),
    "one of three": (united(ball(5.0), ball(), ball(1.0)), "some of its 3 shells overlap"),
}
SOUND = {
    "one": united(ball()),
    "apart": united(ball(), ball(3.0)),
    "cavity": united(ball(), ball(radius=0.5, inwards=True)),
    "solid in a cavity": united(ball(radius=2.0), ball(radius=1.0, inwards=True), ball(radius=0.5)),
    "touching along an edge": united(box(), box(1.0, 1.0)),
}


@pytest.mark.parametrize("name", AMBIGUOUS)
@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e4])
def test_an_ambiguous_inside_is_refused(name: str, scale: float) -> None:
    mesh, expected = AMBIGUOUS[name]
    moved = build_mesh(scale * np.add(mesh.positions, [3.0, 0.0, -7.0]), mesh.faces)
    with pytest.raises(MeshError, match=rf"^file: {expected}.*; unite its shells"):
        refuse_ambiguous(moved, "file")


def test_a_shell_that_is_wound_inside_out_is_named() -> None:
    with pytest.raises(MeshError, match=r"one of its 2 shells, at .* is wound inside out and is no cavity of another"):
        refuse_ambiguous(united(ball(), ball(3.0, radius=0.5, inwards=True)), "file")


@pytest.mark.parametrize("name", SOUND)
def test_sound_shells_pass(name: str) -> None:
    assert ambiguity(SOUND[name]) == ("", False)


def test_spot_is_one_shell_without_crossings() -> None:
    spot = read_mesh(SHIPPED / "spot.obj")
    assert len(crossings(spot)[0]) == 0
    assert shells(spot).max() == 0


def test_crossing_edges_are_those_of_every_pair_tested() -> None:
    """A second method: every edge against every face, by barycentric coordinates in the plane."""
    mesh = united(ball(), ball(1.0))
    edges = np.unique(np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    start, along = mesh.positions[edges[:, 0]], mesh.positions[edges[:, 1]] - mesh.positions[edges[:, 0]]
    expected = set()
    for number, face in enumerate(mesh.faces):
        normal = mesh.face_normals[number]
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (mesh.positions[face[0]] - start) @ normal / (along @ normal)
        points = start + np.where(np.isfinite(t), t, 9.0)[:, None] * along
        triangles = np.broadcast_to(mesh.positions[face], (len(points), 3, 3))
        shares = trimesh.triangles.points_to_barycentric(triangles, points)
        hit = (t > 0.0) & (t < 1.0) & (shares > 0.0).all(axis=1)
        hit &= ~np.isin(edges, face).any(axis=1)
        expected |= {(*edge, number) for edge in edges[hit].tolist()}
    found_edges, found_faces = crossings(mesh)
    assert {(*edge, face) for edge, face in zip(found_edges.tolist(), found_faces.tolist(), strict=True)} == expected


def test_folds_narrower_than_a_face_are_warned_about() -> None:
    """A dent that pokes through the other side by one vertex."""
    made = ball()
    positions = np.array(made.vertices)
    top, bottom = positions[:, 2].argmax(), positions[:, 2].argmin()
    positions[top] = positions[bottom] * 1.001
    with pytest.warns(InputWarning, match=r"^file: its surface crosses itself: .*; light may be wrong there"):
        refuse_ambiguous(build_mesh(positions, made.faces), "file")


def test_the_path_tracer_refuses_overlapping_shells(tmp_path: Path) -> None:
    scene = make_scene(tmp_path, AMBIGUOUS["overlapping"][0])
    with pytest.raises(MeshError, match=r"object\.ply: some of its 2 shells overlap"):
        estimate_coefficients(scene, scene.mesh.positions[:1], scene.mesh.normals[:1], paths=2)
