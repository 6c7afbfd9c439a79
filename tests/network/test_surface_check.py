"""A network is only evaluated on the surface that it was trained on; other meshes are refused, with their cause."""

import copy
import dataclasses

import numpy as np
import pytest
import trimesh

from formats.errors import InputWarning, QueryError
from formats.mesh import Mesh, build_mesh, flipped, read_mesh
from prt_bake.network.bssrdf import NeuralBSSRDF, load_model
from prt_bake.shipped.demonstration import SHIPPED


@pytest.fixture(scope="module")
def network() -> NeuralBSSRDF:
    return load_model(SHIPPED / "spot.pt")


@pytest.fixture(scope="module")
def spot() -> Mesh:
    return read_mesh(SHIPPED / "spot.obj")


def piece(mesh: Mesh) -> Mesh:
    chosen = mesh.faces[(mesh.positions[mesh.faces][..., 2] < -0.3).all(axis=1)]
    used, faces = np.unique(chosen, return_inverse=True)
    return build_mesh(mesh.positions[used], faces.reshape(-1, 3))


def subdivided(mesh: Mesh) -> Mesh:
    return build_mesh(*trimesh.remesh.subdivide(mesh.positions, mesh.faces))


def simplified(mesh: Mesh) -> Mesh:
    """Every second vertex, collapsed to the next kept one: coarser, with all vertices and normals on the surface."""
    kept = np.arange(len(mesh.positions)) // 2 * 2
    faces = kept[mesh.faces]
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    used, renumbered = np.unique(faces, return_inverse=True)
    return Mesh(mesh.positions[used], renumbered.reshape(-1, 3), mesh.normals[used])


@pytest.mark.parametrize("variant", [lambda mesh: mesh, subdivided, simplified, piece])
def test_meshes_of_the_same_surface_pass(network, spot, variant):
    network.refuse_foreign(variant(spot))


def test_a_sheet_between_the_nodes_of_the_grid_has_bounds(network: NeuralBSSRDF) -> None:
    """Of an object so thin that no node lies inside, other meshes are refused in words."""
    interior = network.view.interior
    levels = np.minimum(interior.levels, 0)
    sheet = copy.copy(network.view)
    sheet.interior = dataclasses.replace(interior, levels=levels)
    thin = copy.copy(network)
    thin._modules = {**network._modules, "view": sheet}
    with pytest.raises(QueryError, match="vertices are not on the surface"):
        thin.refuse_foreign(build_mesh(np.eye(3) * 40.0, np.array([[0, 1, 2]])))


MIDDLE = np.array([0.0, 0.12, 0.19])
WRONG = {
    "0.5 times as large": lambda x: MIDDLE + 0.5 * (x - MIDDLE),
    r"0.01 times as large \(metres in place of centimetres\)": lambda x: 0.01 * x,
    r"0.0254 times as large \(metres in place of inches\)": lambda x: 0.0254 * x,
    r"1000 times as large \(millimetres in place of metres\)": lambda x: 1000.0 * x,
    "1.7[0-9]* times as large": lambda x: 1.71 * x,
    r"axes are swapped \(the object's x, y, z are its x, z, -y\)": lambda x: x[:, [0, 2, 1]] * [1.0, -1.0, 1.0],
    "it is moved": lambda x: np.add(x, [0.0, 0.9, 0.0]),
    "bake the mesh of the model's own scene": lambda x: (
        x @ trimesh.transformations.rotation_matrix(0.3, [1, 2, 3])[:3, :3]
    ),
}


@pytest.mark.parametrize("cause", WRONG)
def test_the_cause_is_named(network, spot, cause):
    foreign = build_mesh(WRONG[cause](spot.positions), spot.faces)
    with pytest.raises(QueryError, match=f"of 2930 vertices are not on the surface .* scene units away; .*{cause}"):
        network.refuse_foreign(foreign)


ROUGH = {
    "a little smaller": lambda spot: MIDDLE + 0.975 * (spot.positions - MIDDLE),  # the size alone fits, to 2 %
    "every fifth vertex inset": lambda spot: (
        spot.positions - 0.025 * spot.normals * (np.arange(2930) % 5 == 0)[:, None]
    ),
}


@pytest.mark.parametrize("kind", ROUGH)
def test_a_mesh_that_follows_the_surface_too_roughly_hears_so(network, spot, kind):
    with pytest.warns(InputWarning, match=r"scene units away; it follows that surface, but too roughly, .*: bake the"):
        network.refuse_foreign(build_mesh(ROUGH[kind](spot), spot.faces))


def test_a_mesh_that_is_off_the_surface_everywhere_is_refused(network, spot):
    with pytest.raises(QueryError, match=r"scene units away; it follows that surface, but too roughly, .*: bake the"):
        network.refuse_foreign(build_mesh(spot.positions + 0.03 * spot.normals, spot.faces))


def test_another_object_inside_is_refused(network):
    box = trimesh.creation.box((0.2, 0.2, 0.2))
    with pytest.raises(QueryError, match="8 of 8 vertices are not on the surface"):
        network.refuse_foreign(build_mesh(box.vertices, box.faces))


def test_an_open_piece_that_is_wound_inside_out_is_refused(network, spot):
    """Its normals agree with its faces, so only the model knows that they point inwards."""
    with pytest.raises(QueryError, match=r"vertex normals point into the object .* wound inside out; flip"):
        network.refuse_foreign(flipped(piece(spot)))


def test_a_patch_that_is_wound_inside_out_is_warned_about(network, spot):
    part = piece(spot)
    used, faces = np.unique(spot.faces[(spot.positions[spot.faces][..., 2] > 0.9).all(axis=1)], return_inverse=True)
    faces = len(part.positions) + faces.reshape(-1, 3)[:, ::-1]
    both = build_mesh(np.concatenate([part.positions, spot.positions[used]]), np.concatenate([part.faces, faces]))
    expected = f"the normals of {len(used)} of {len(both.positions)} vertices point into .* the first at .*; make"
    with pytest.warns(InputWarning, match=expected):
        network.refuse_foreign(both)


def test_a_single_part_elsewhere_is_warned_about(network, spot):
    """Its 8 vertices are less than a hundredth of all."""
    box = trimesh.creation.box((0.2, 0.2, 0.2))
    faces = np.concatenate([spot.faces, box.faces + len(spot.positions)])
    with pytest.warns(InputWarning, match="8 of 2938 vertices are not on the surface"):
        network.refuse_foreign(build_mesh(np.concatenate([spot.positions, box.vertices]), faces))


def test_a_few_vertices_off_the_surface_are_warned_about(network, spot):
    positions = spot.positions.copy()
    positions[:100] *= 0.9
    with pytest.warns(InputWarning, match="of 2930 vertices are not on the surface .* the result is wrong there"):
        network.refuse_foreign(build_mesh(positions, spot.faces))


def test_an_object_that_shrinks_to_a_point_of_the_surface_has_no_known_cause(network, spot):
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.3)
    foreign = build_mesh(ball.vertices + 1000.0 * spot.positions[7], ball.faces)
    with pytest.raises(QueryError, match=r"162 of 162 vertices .*; bake the mesh of the model's own scene"):
        network.refuse_foreign(foreign)
