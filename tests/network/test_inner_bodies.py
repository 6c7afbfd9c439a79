"""Tests of the meshes inside an object, as they are stored with a network."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from numpy.typing import NDArray

from formats.errors import ModelError
from prt_bake.baking.job.identity import identity_of
from prt_bake.network.bssrdf import NeuralBSSRDF, load_model, save_model
from prt_bake.network.features.inner_bodies import (
    MOST_BYTES,
    STEPS,
    InnerBody,
    Shape,
    fitting_bodies,
    packed_bodies,
    unpacked_bodies,
)
from prt_bake.network.features.interior import Interior
from prt_bake.network.features.view_path import path_through
from tests.network.test_view_path import REFLECTING, UNIT, cube, downwards, mesh_of

RNG = np.random.default_rng(9)


def sphere(subdivisions: int, eta: float = 1.2, smooth: bool = False) -> Shape:
    mesh = trimesh.creation.icosphere(subdivisions, 0.25)
    return Shape(np.asarray(mesh.vertices) + 0.5, np.asarray(mesh.faces, np.int64), 0, eta, smooth)


def with_a_sphere(eta: float = 1.2) -> Interior:
    return replace(cube(0.2, inner=True), inner=fitting_bodies([sphere(2, eta)]))


def edges_of(faces: NDArray[np.uint32]) -> NDArray[np.int64]:
    """How often each edge is used, less how often in the other direction."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    forward = np.where(edges[:, 0] < edges[:, 1], 1, -1)
    _edges, index = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True)
    return np.bincount(index.reshape(-1), forward).astype(np.int64)


def test_a_small_body_is_kept_to_a_step() -> None:
    positions, faces = sphere(2)[:2]
    (body,) = fitting_bodies([sphere(2)])
    assert (len(body.places), len(body.faces), body.eta) == (len(positions), len(faces), 1.2)
    corners = body.positions[body.faces]
    assert np.abs(np.sort(corners.reshape(-1, 9), axis=0) - np.sort(positions[faces].reshape(-1, 9), axis=0)).max() < (
        1.0 / STEPS
    )


def test_a_ray_that_is_guided_by_a_wall_stays_on_its_path() -> None:
    """Between a cube of glass and a ball in it, after a dozen reflections, as between the exact meshes."""
    ball = sphere(3, eta=1.0)
    inner = replace(cube(0.2, eta=1.5, inner=True), attenuation=(0.2, 0.1), inner=fitting_bodies([ball]))
    (body,) = inner.inner
    exact = InnerBody(ball.positions * STEPS, ball.faces.astype(np.uint32), 0, 1.0, False)
    x, towards = downwards(400)
    found, true, coarse = (
        path_through(UNIT, replace(inner, inner=(each,)), REFLECTING)(torch.from_numpy(x), torch.from_numpy(-towards))
        for each in (body, exact, replace_places(exact, 65535))
    )
    off, off_coarse = (
        float(((some.points - true.points).norm(dim=-1).amax(dim=1) > 1e-3).float().mean()) for some in (found, coarse)
    )
    assert off <= 0.005
    assert off_coarse > 2.0 * off


def replace_places(body: InnerBody, steps: int) -> InnerBody:
    """The body in coarser steps."""
    return body._replace(places=np.rint(body.positions * steps).astype(np.uint16), steps=steps)


def test_bodies_of_earlier_models_have_coarser_steps() -> None:
    (body,) = fitting_bodies([sphere(1)])
    earlier = replace_places(body, 65535)
    described = earlier.as_json()
    del described["steps"]
    (again,) = unpacked_bodies([described], packed_bodies((earlier,)), 1)
    np.testing.assert_array_equal(again.places, earlier.places)
    np.testing.assert_allclose(again.positions, body.positions, atol=1e-5)


def test_a_large_body_is_coarser_closed_and_of_the_same_volume() -> None:
    positions, faces = sphere(5)[:2]
    positions = positions + 0.01 * RNG.normal(size=positions.shape)
    bodies = fitting_bodies([sphere(5)._replace(positions=positions)])
    assert MOST_BYTES / 8 < len(packed_bodies(bodies)) <= MOST_BYTES
    body = bodies[0]
    assert 500 < len(body.faces) < len(faces)
    assert not edges_of(body.faces).any()
    volumes = [
        trimesh.Trimesh(p, f, process=False).volume for p, f in ((positions, faces), (body.positions, body.faces))
    ]
    assert volumes[1] == pytest.approx(volumes[0], rel=0.02)


def test_bodies_are_packed_without_loss() -> None:
    bodies = fitting_bodies([sphere(1), sphere(0, 1.7, smooth=True)])
    again = unpacked_bodies(json.loads(json.dumps([body.as_json() for body in bodies])), packed_bodies(bodies), 2)
    for body, other in zip(bodies, again, strict=True):
        np.testing.assert_array_equal(body.places, other.places)
        np.testing.assert_array_equal(body.faces, other.faces)
        assert body[2:] == other[2:]
    assert fitting_bodies([]) == ()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"vertices": 41}, "meshes hold"),
        ({"faces": -1}, "faces of mesh 1 inside: expected 0 to 262144, found -1"),
        ({"vertices": 1 << 40}, "vertices of mesh 1 inside"),
        ({"eta": float("nan")}, "eta of mesh 1 inside: expected above 0, at most 5, found nan"),
        ({"parent": 1}, "parent of mesh 1 inside: expected 0 to 0, found 1"),
        ({"smooth": 1}, "smooth of mesh 1 inside: expected true or false"),
        ({"steps": 3}, "steps of mesh 1 inside: expected 65535 or 16777216, found 3"),
    ],
)
def test_inconsistent_bodies_are_refused(change: dict[str, float], message: str) -> None:
    bodies = fitting_bodies([sphere(1)])
    with pytest.raises(ModelError, match=message):
        unpacked_bodies([bodies[0].as_json() | change], packed_bodies(bodies), 1)
    with pytest.raises(ModelError, match="expected 2 meshes inside, found 1"):
        unpacked_bodies([bodies[0].as_json()], packed_bodies(bodies), 2)


def test_faces_beyond_the_vertices_are_refused() -> None:
    body = InnerBody(np.zeros((3, 3), np.uint32), np.array([[0, 1, 3]], np.uint32), 0, 1.0, False)
    with pytest.raises(ModelError, match="vertex 3, expected below 3"):
        unpacked_bodies([body.as_json()], packed_bodies((body,)), 1)


def test_smooth_bodies_bend_rays_as_smooth_surfaces() -> None:
    """A ball of glass in a medium of index 1: coarse facets bend a ray elsewhere."""
    x, towards = np.array([[0.4, 0.45, 1.0]]), np.array([[0.0, 0.0, -1.0]])
    ways = []
    for subdivisions, smooth in ((5, False), (2, True), (2, False)):
        inner = fitting_bodies([sphere(subdivisions, 1.5, smooth)])
        interior = replace(cube(0.2, eta=1.0, inner=True), attenuation=(0.2, 0.1), inner=inner)
        path = path_through(UNIT, interior, REFLECTING)
        ways.append(path(torch.from_numpy(x), torch.from_numpy(-towards)).leaving.numpy())
    assert np.linalg.norm(ways[1] - ways[0]) < 0.3 * np.linalg.norm(ways[2] - ways[0])


def test_each_body_needs_its_mesh() -> None:
    with pytest.raises(ModelError, match="2 bodies need 1 meshes inside, found 2"):
        replace(cube(inner=True), inner=fitting_bodies([sphere(1), sphere(0)]))


def test_a_model_keeps_what_is_seen_in_the_object(tmp_path: Path) -> None:
    network = NeuralBSSRDF(REFLECTING, interior=with_a_sphere())
    save_model(network.rounded(), tmp_path / "model.pt")
    again = load_model(tmp_path / "model.pt").on(mesh_of(UNIT))
    x, towards = downwards(50)
    at = torch.from_numpy(x), torch.from_numpy(-towards)
    encodings = [net.encode_views(*at) for net in (network.on(mesh_of(UNIT)), again)]
    empty = NeuralBSSRDF(REFLECTING, interior=cube(0.2)).on(mesh_of(UNIT)).encode_views(*at)
    assert encodings[0] is not None
    assert encodings[1] is not None
    assert empty is not None
    assert torch.equal(encodings[0].points, encodings[1].points)
    assert float((encodings[0].points - empty.points).abs().max()) > 0.1


def test_hashes_depend_on_what_is_inside() -> None:
    """Also that by which a resumed bake recognises its network."""
    moved = with_a_sphere()
    places = moved.inner[0].places.copy()
    places[3] += 1
    interiors = [with_a_sphere(), with_a_sphere(1.3), replace(moved, inner=(moved.inner[0]._replace(places=places),))]
    assert len({interior.content_hash for interior in interiors}) == 3
    mesh = mesh_of(UNIT)
    assert len({identity_of(NeuralBSSRDF(REFLECTING, interior=each), mesh, {}) for each in interiors}) == 3


def test_bodies_without_their_meshes_are_refused() -> None:
    """Rays that do not see the bodies would give another object in silence."""
    with pytest.raises(ModelError, match=r"followed through 2 bodies .* needs the meshes of those inside; found 0"):
        NeuralBSSRDF(REFLECTING, interior=cube(0.2, inner=True))
    NeuralBSSRDF(replace(REFLECTING, interfaces=0), interior=cube(0.2, inner=True))
