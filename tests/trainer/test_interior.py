"""Distance grids of a scene's object: distances, normals, size in bytes, bodies."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from formats.mesh import build_mesh, write_mesh
from formats.scene import read_scene
from prt_bake.geometry.distances import grid_distances
from prt_bake.network.bssrdf import PRESETS, NeuralBSSRDF
from prt_bake.network.features.inner_bodies import STEPS
from prt_bake.network.features.interior import LEVELS, REACH
from prt_bake.trainer.interior import MOST_BYTES, interior_of
from prt_bake.trainer.training_data import box_of
from tests.shapes import ball
from tests.tracer.scenes import make_scene, moved

GRAPE = Path(__file__).parents[2] / "scenes" / "grape" / "grape.toml"


@pytest.mark.statistics
@pytest.mark.parametrize("scale", [1.0, 1e-3])
def test_levels_are_the_distances_to_a_sphere(tmp_path: Path, scale: float) -> None:
    scene = make_scene(tmp_path, ball(5, scale), sigma_t=2.0)
    interior = interior_of(scene, box_of(scene))
    places = np.stack(np.meshgrid(*map(np.arange, interior.levels.shape[1:]), indexing="ij"), axis=-1)
    at = np.array(interior.corner) + interior.spacing * places
    exact = np.clip((0.5 - np.linalg.norm(at - 0.5, axis=-1)) / (REACH * interior.spacing), -1.0, 1.0)
    middles = scene.mesh.positions[np.asarray(scene.mesh.faces)].mean(axis=1)
    below = 0.5 * (1.0 - np.linalg.norm(middles, axis=1).min() / scale) / (REACH * interior.spacing)
    assert below < 0.02
    np.testing.assert_allclose(interior.levels[0] / LEVELS, exact, atol=0.5 / LEVELS + 1.01 * below)
    assert interior.levels.size <= 1.2 * 96**3


@pytest.mark.usefixtures("coarse_interior")
def test_the_grid_s_normals_of_wide_faces_are_exact(tmp_path: Path) -> None:
    """A box of 12 faces along the axes; rays refract at its walls by these normals."""
    box = trimesh.creation.box((1.0, 0.8, 0.6))
    scene = make_scene(tmp_path, build_mesh(box.vertices, box.faces), eta=1.5, sigma_t=2.0)
    interior = interior_of(scene, box_of(scene))
    network = NeuralBSSRDF(replace(PRESETS["measured"], interfaces=4), *box_of(scene), interior=interior)
    assert network.view is not None
    at = np.random.default_rng(2).uniform(0.1, 0.5, (200, 3))
    for axis, side in enumerate((1.0, 0.8, 0.6)):
        x = at.copy()
        x[:, axis] = side
        normals = network.view._normal(torch.from_numpy(x).float()).numpy()
        np.testing.assert_allclose(normals, np.tile(np.eye(3)[axis], (200, 1)), atol=1e-6)


def test_distances_agree_with_trimesh() -> None:
    """Faces at all angles, wide and narrow, and some without area."""
    rng = np.random.default_rng(6)
    triangles = rng.uniform(0.0, 2.0, (60, 3, 3)) * rng.choice([0.05, 1.0], (60, 1, 1))
    corners = ((0, 0, 1), (0, 1, 1), (0, 1, 0), (2, 2, 2))
    slivers = np.concatenate([triangles[:5, list(chosen)] for chosen in corners])
    shape, corner, spacing, reach = np.array([17, 19, 23]), np.array([-0.1, 0.0, 0.1]), 0.1, 0.35
    found = grid_distances(np.concatenate([slivers, triangles]), shape, corner, spacing, reach)
    places = corner + spacing * np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1).reshape(-1, 3)
    near = [trimesh.triangles.closest_point(np.repeat(one[None], len(places), axis=0), places) for one in triangles]
    exact = np.minimum(np.linalg.norm(np.stack(near) - places, axis=2).min(axis=0), reach)
    np.testing.assert_allclose(found.ravel(), exact, atol=1e-12)


@pytest.mark.statistics
def test_the_interior_does_not_depend_on_unit_and_position(tmp_path: Path) -> None:
    here = make_scene(tmp_path, ball(3), sigma_t=2.0)
    there = make_scene(tmp_path, moved(ball(3), 250.0, 1000.0), sigma_t=2.0)
    ours, theirs = (interior_of(scene, box_of(scene)) for scene in (here, there))
    assert ours.levels.shape == theirs.levels.shape
    assert np.abs(ours.levels.astype(int) - theirs.levels).max() <= 1
    assert theirs.attenuation[0] == pytest.approx(250.0 * ours.attenuation[0])


@pytest.mark.statistics
def test_a_rough_surface_gets_a_coarser_grid_within_the_byte_budget(tmp_path: Path) -> None:
    smooth = ball(6)
    spikes = 1.0 + 0.2 * np.random.default_rng(1).random((len(smooth.positions), 1))
    scene = make_scene(tmp_path, build_mesh(smooth.positions * spikes, smooth.faces), sigma_t=2.0)
    interior = interior_of(scene, box_of(scene))
    assert len(interior.packed()) <= MOST_BYTES
    network = NeuralBSSRDF(PRESETS["measured"], *box_of(scene), interior=interior)
    assert network.view is not None
    assert network.view.interior is interior


@pytest.mark.statistics
def test_parts_inside_are_separate_bodies(tmp_path: Path) -> None:
    """A block in a block in a ball, each after the body that contains it; the inner block is opaque."""
    write_mesh(ball(3), tmp_path / "ball.ply")
    for name, side in (("outer", 1.0), ("inner", 0.5)):
        box = trimesh.creation.box(extents=(side,) * 3)
        write_mesh(build_mesh(np.asarray(box.vertices), np.asarray(box.faces)), tmp_path / f"{name}.ply")
    (tmp_path / "scene.toml").write_text(
        """
[object]
mesh = "ball.ply"
[interface]
eta = 1.5
[medium]
sigma_t = 0
albedo = 1
[[inside]]
name = "inner"
mesh = "inner.ply"
in = "outer"
surface = "diffuse"
reflectance = 0.5
[[inside]]
name = "outer"
mesh = "outer.ply"
[inside.interface]
eta = 1.5
[inside.medium]
sigma_t = 3.0
albedo = 0.8
phase_g = 0.5
"""
    )
    scene = read_scene(tmp_path / "scene.toml")
    interior = interior_of(scene, box_of(scene))
    assert interior.attenuation == pytest.approx((0.0, 2.0 * 3.0 * (1.0 - 0.8 * 0.5), 1e3))
    middle = tuple(n // 2 for n in interior.levels.shape[1:])
    assert (interior.levels[(slice(None), *middle)] == LEVELS).all()
    within = np.clip(interior.levels * (REACH / LEVELS) + 0.5, 0.0, 1.0)  # of a place's cell
    volumes = within.sum(axis=(1, 2, 3)) * (2.0 * interior.spacing) ** 3
    np.testing.assert_allclose(volumes, np.array([4.0 / 3.0 * np.pi, 1.0, 0.125]), rtol=0.03)
    assert len(interior.packed()) <= MOST_BYTES


@pytest.mark.usefixtures("coarse_interior")
def test_meshes_inside_are_those_of_the_parts() -> None:
    """In box sides; a diffuse body has the index of what surrounds it."""
    scene = read_scene(GRAPE)
    interior = interior_of(scene, box_of(scene), with_meshes=True)
    assert [len(body.faces) for body in interior.inner] == [len(part.mesh.faces) for part in scene.parts[1:]]
    assert [body.eta for body in interior.inner] == [1.35, 1.35]
    box = box_of(scene)
    corners = [body.places.min(axis=0) / STEPS for body in interior.inner]
    expected = [((part.mesh.positions - box.corner) / box.side).min(axis=0) for part in scene.parts[1:]]
    np.testing.assert_allclose(np.sort(corners, axis=0), np.sort(expected, axis=0), atol=1e-4)
    assert interior_of(scene, box).inner == ()


@pytest.mark.usefixtures("coarse_interior")
def test_bodies_follow_those_that_contain_them() -> None:
    scene = read_scene(GRAPE.parents[1] / "drink" / "drink.toml")
    inner = interior_of(scene, box_of(scene), with_meshes=True).inner
    assert [(body.parent, body.eta) for body in inner] == [(0, 1.33), (1, 1.31), (1, 1.31)]
