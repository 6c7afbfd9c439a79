"""Protruding parts: winding numbers and distances of shapes for which both are known."""

import numpy as np
import pytest
import trimesh

from formats.errors import SceneError
from formats.mesh import build_mesh, flipped, write_mesh
from formats.scene import read_scene
from prt_bake.geometry.nesting import distances, reaches_surface, refuse_outside, winding_numbers
from prt_bake.inspection.files import describe, find_faults, find_remarks
from prt_bake.tracer.prepared import prepare
from tests.tracer.scenes import moved, sphere, unit_directions


@pytest.fixture(scope="module")
def box():
    solid = trimesh.creation.box(extents=(2, 2, 2))
    return build_mesh(np.asarray(solid.vertices), np.asarray(solid.faces))


def test_winding_number_is_one_inside_and_zero_outside(box):
    points = np.random.default_rng(1).uniform(-2, 2, (2000, 3))
    inside = np.abs(points).max(axis=1) < 1
    np.testing.assert_allclose(winding_numbers(box, points), inside, atol=1e-9)


def test_distances_to_a_box_follow_its_formula(box):
    points = np.random.default_rng(2).uniform(-3, 3, (2000, 3))
    outwards = np.abs(points) - 1
    outside = np.linalg.norm(np.maximum(outwards, 0), axis=1)
    expected = np.where(outside > 0, outside, -outwards.max(axis=1))
    np.testing.assert_allclose(distances(box, points), expected, atol=1e-12)


@pytest.mark.parametrize(("depth", "reaches"), [(0.0, False), (0.4, False), (0.6, True)])
def test_a_dent_reaches_a_box_between_its_vertices_and_centroids(depth: float, reaches: bool) -> None:
    """It is narrow, and off the points of the inner box's upper face, which is 0.5 below that of the outer box."""
    solid = trimesh.creation.box(extents=(2, 2, 2)).subdivide().subdivide().subdivide()
    positions = np.array(solid.vertices)
    positions[np.argmin(np.linalg.norm(positions - [0.25, 0.25, 1.0], axis=1)), 2] -= depth
    outer = build_mesh(positions, np.asarray(solid.faces))
    inner = trimesh.creation.box(extents=(1, 1, 1))
    assert reaches_surface(build_mesh(np.asarray(inner.vertices), np.asarray(inner.faces)), outer) == reaches


def write_pair(folder, radius, offset):
    write_mesh(sphere(2), folder / "outer.ply")
    write_mesh(moved(sphere(2), radius, [offset, 0, 0]), folder / "inner.ply")
    (folder / "scene.toml").write_text(
        '[object]\nmesh = "outer.ply"\n[medium]\nsigma_t = 1\nalbedo = 1\n'
        '[[inside]]\nname = "seed"\nmesh = "inner.ply"\nsurface = "diffuse"\nreflectance = [0.1, 0.2, 0.3]\n'
    )
    return folder / "scene.toml"


@pytest.mark.parametrize(("offset", "sticks_out"), [(0, False), (0.45, False), (0.6, True)])
def test_protruding_part_gives_a_remark(tmp_path, offset, sticks_out):
    path = write_pair(tmp_path, 0.5, offset)
    assert find_faults(path) == []
    remarks = find_remarks(path)
    assert len(remarks) == sticks_out
    if sticks_out:
        # The farthest vertex, at 1.1, is 0.1 outside a ball whose bounding box has the diagonal 2√3.
        assert (
            f"'seed' sticks out of 'object' by {0.1 / read_scene(path).mesh.diagonal:.2g} of its diagonal" in remarks[0]
        )


def test_dent_filled_by_a_part_is_found_by_the_parent_s_vertices(tmp_path):
    path = write_pair(tmp_path, 0.5, 0.0)
    dented = sphere(3).positions.copy()
    dented[np.argmax(dented[:, 0])] *= 0.2
    write_mesh(build_mesh(dented, sphere(3).faces), tmp_path / "outer.ply")
    small = trimesh.creation.box(extents=(1.0, 0.8, 0.8))
    write_mesh(build_mesh(np.asarray(small.vertices), np.asarray(small.faces)), tmp_path / "inner.ply")
    assert "0 of 8 vertices" in find_remarks(path)[0]


def test_winding_numbers_and_distances_far_from_a_ball():
    ball, points = sphere(3), unit_directions(200, 3) * np.linspace(1.5, 4, 200)[:, None]
    np.testing.assert_allclose(distances(ball, points), np.linalg.norm(points, axis=1) - 1, atol=0.02)
    np.testing.assert_allclose(winding_numbers(ball, points), 0, atol=1e-9)


def test_every_part_is_described(tmp_path):
    described = describe(write_pair(tmp_path, 0.5, 0.0))
    assert (described["parts"], described["seed: in"], described["seed: reflectance"]) == (2, "object", [0.1, 0.2, 0.3])
    assert (described["eta"], described["sigma_t"]) == (1.0, 1.0)


@pytest.mark.parametrize(("radius", "offset", "outside"), [(0.5, 0.4, False), (0.2, 0.78, True), (0.8, 0.0, True)])
def test_a_part_without_volume_in_its_parent_is_refused(tmp_path, radius, offset, outside):
    """The parent has a cavity of radius 0.8: a part in it, or beside the parent, would be cut off as a whole."""
    write_pair(tmp_path, radius, 0.0)
    hollow = [sphere(2), flipped(moved(sphere(2), 0.8))] if radius == 0.8 else [sphere(2)]
    counts = np.cumsum([0, *(len(mesh.positions) for mesh in hollow)])
    faces = np.concatenate([mesh.faces + start for mesh, start in zip(hollow, counts, strict=False)])
    write_mesh(build_mesh(np.concatenate([mesh.positions for mesh in hollow]), faces), tmp_path / "outer.ply")
    write_mesh(moved(sphere(2), radius, [offset, offset, offset]), tmp_path / "inner.ply")
    parts = read_scene(tmp_path / "scene.toml").parts
    if not outside:
        refuse_outside(parts)
        return
    with pytest.raises(SceneError, match=r"inner\.ply: 'seed' has no volume inside 'object'.* or in a cavity"):
        refuse_outside(parts)
    with pytest.raises(SceneError, match="has no volume inside"):
        prepare(read_scene(tmp_path / "scene.toml"))
    assert "has no volume inside" in find_faults(tmp_path / "scene.toml")[0]


def test_a_part_around_its_parent_fills_it(tmp_path):
    write_pair(tmp_path, 3.0, 0.0)
    refuse_outside(read_scene(tmp_path / "scene.toml").parts)
