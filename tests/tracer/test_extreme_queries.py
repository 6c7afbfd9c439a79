"""Queries at their limits: on edges and vertices, grazing, axis-aligned, two paths, very many queries.

z-tests of false-alarm rate `significance.FALSE_ALARM` each, about 8 of them.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from formats.errors import QueryError
from prt_bake.tracer.estimate import estimate_coefficients, estimate_transport
from tests.mathematics.significance import assert_agree
from tests.tracer.scenes import lumpy, make_scene, queries, slab, sphere, unit_directions
from tests.tracer.soundness import SQRT_4_PI, assert_furnace, assert_sound, white_sky

pytestmark = pytest.mark.statistics

ROUGH: dict[str, Any] = {"eta": 1.3, "roughness": 0.3}
NARROW: dict[str, Any] = {"eta": 1.5, "roughness": 0.01}
INTERFACES: list[dict[str, Any]] = [{}, ROUGH, NARROW]
TOP = np.array([0.07, 0.11, 0.5])


def _grazing(cosine: float) -> np.ndarray:
    return np.array([np.sqrt(1.0 - cosine * cosine), 0.0, cosine])


@pytest.mark.parametrize("interface", [{}, {"eta": 1.4}, {"eta": 0.8}])
@pytest.mark.parametrize("cosine", [1e-3, 1e-6])
def test_grazing_views_conserve_energy(tmp_path: Path, cosine: float, interface: dict[str, Any]) -> None:
    """Inside a face, on an edge and at a vertex of a cube."""
    scene = make_scene(tmp_path, slab(1.0), sigma_t=3.0, albedo=1.0, **interface)
    places = np.array([TOP, [0.1, 0.5, 0.5], [-0.5, -0.5, 0.5]])
    # The view grazes the top face; the other faces at these points are edge-on or face it.
    outgoing = np.array([_grazing(cosine), _grazing(cosine) * [1, 1, 1], _grazing(cosine)])
    assert_furnace(scene, places, outgoing, paths=512, rtol=2e-4)


@pytest.mark.parametrize("interface", INTERFACES)
def test_connections_of_grazing_views_are_sound(tmp_path: Path, interface: dict[str, Any]) -> None:
    scene = make_scene(tmp_path, slab(1.0), **interface)
    outgoing = np.array([_grazing(c) for c in (1e-1, 1e-3, 1e-6, 1e-9)])
    places = np.tile(TOP, (4, 1))
    for incident in (outgoing, -outgoing, outgoing * [1, 1, -1], np.tile([0.0, 0.0, 1.0], (4, 1))):
        assert_sound(estimate_transport(scene, places, outgoing, incident, 256, 1))
    total, error = white_sky(make_white(tmp_path / "white", **interface), places, outgoing, 1024)
    assert (total <= 1.0 + 5.0 * error + 1e-9).all()


def make_white(folder: Path, **interface: Any) -> Any:
    folder.mkdir()
    return make_scene(folder, slab(1.0), sigma_t=3.0, albedo=1.0, **interface)


@pytest.mark.parametrize("interface", INTERFACES)
def test_light_from_exactly_aligned_directions(tmp_path: Path, interface: dict[str, Any]) -> None:
    """Along axes, faces (w·n = 0) and edges, towards and away from the eye."""
    scene = make_scene(tmp_path, slab(1.0), **interface)
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    diagonals = np.array([[1.0, 1.0, 0.0], [0.0, 1.0, 1.0], [1.0, 0.0, -1.0], [1.0, 1.0, 1.0]])
    diagonals /= np.linalg.norm(diagonals, axis=1, keepdims=True)
    outgoing = np.array([[0.0, 0.0, 1.0], [0.6, 0.0, 0.8], [0.0, 0.6, 0.8]])
    incident = np.concatenate(
        [np.tile(np.concatenate([axes, diagonals]), (3, 1, 1)), outgoing[:, None], -outgoing[:, None]], 1
    )
    result = estimate_transport(scene, np.tile(TOP, (3, 1)), outgoing, incident, 2048, 1)
    assert_sound(result)
    # Light from above enters everywhere.
    assert (result.mean[:, 2] > 0.0).all()


def test_light_along_a_face_is_the_limit_of_grazing_light(tmp_path: Path) -> None:
    """Ŝ is continuous there behind an index-matched boundary; exact directions do not slip between faces."""
    scene = make_scene(tmp_path, slab(1.0), sigma_t=2.0, albedo=0.9)
    exact = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    near = exact + np.array([0.0, 0.0, 1e-5])
    near /= np.linalg.norm(near, axis=1, keepdims=True)
    places, outgoing = np.tile(TOP, (3, 1)), np.tile([0.6, 0.0, 0.8], (3, 1))
    one = estimate_transport(scene, places, outgoing, exact, 20_000, 1)
    two = estimate_transport(scene, places, outgoing, near, 20_000, 2)
    assert one.mean.min() > 1e-3
    assert_agree(one.mean, one.standard_error, two.mean, two.standard_error)


@pytest.mark.parametrize("interface", [{}, {"eta": 1.4}])
def test_views_from_edges_and_vertices_of_a_concave_mesh(tmp_path: Path, interface: dict[str, Any]) -> None:
    scene = make_scene(tmp_path, lumpy(2), sigma_t=3.0, albedo=1.0, **interface)
    mesh = scene.mesh
    corners = mesh.positions[mesh.faces[:40]]
    places = np.concatenate([mesh.positions[:40], 0.5 * (corners[:, 0] + corners[:, 1])])
    outgoing = np.concatenate([mesh.normals[:40], np.asarray(mesh.face_normals)[:40]])
    assert_furnace(scene, places, outgoing, paths=128)


def test_view_along_an_edge_is_refused_except_at_its_end(tmp_path: Path) -> None:
    """Along an edge of a cube the view is in the plane of both faces."""
    scene = make_scene(tmp_path, slab(1.0), albedo=1.0)
    edge, along = np.array([[0.1, 0.5, 0.5]]), np.array([[1.0, 0.0, 0.0]])
    with pytest.raises(QueryError, match="1 of 1 queries below the horizon of every face"):
        estimate_transport(scene, edge, along, along, 16)
    # At the end of the edge it is normal to the third face.
    assert_furnace(scene, np.array([[0.5, 0.5, 0.5]]), along, paths=256)


@pytest.mark.parametrize("interface", INTERFACES)
def test_two_paths_of_one_query(tmp_path: Path, interface: dict[str, Any]) -> None:
    scene = make_scene(tmp_path, lumpy(2), **interface)
    positions, outgoing, _ = queries(scene.mesh, 1, 3)
    for result in (
        estimate_transport(scene, positions, outgoing, outgoing, 2, 1),
        estimate_transport(scene, positions, outgoing, unit_directions(3000, 1)[None], 2, 1),
        estimate_coefficients(scene, positions, outgoing, 4, 2, 1),
    ):
        assert_sound(result)
        assert not result.reliable.any()
    with pytest.raises(QueryError, match="at least 2"):
        estimate_transport(scene, positions, outgoing, outgoing, 1)


@pytest.mark.parametrize("interface", [{}, ROUGH])
def test_a_hundred_thousand_queries_of_two_paths(tmp_path: Path, interface: dict[str, Any]) -> None:
    """Together they know the furnace as one query of many paths does, and each has its own numbers."""
    scene = make_scene(tmp_path, sphere(3), sigma_t=3.0, albedo=1.0, **interface)
    normal = np.asarray(scene.mesh.face_normals)[7]
    place = scene.mesh.positions[scene.mesh.faces[7]].mean(axis=0)
    many = [np.tile(row, (100_000, 1)) for row in (place, normal)]
    result = estimate_coefficients(scene, *many, 0, 2, 1)
    assert_sound(result)
    values = SQRT_4_PI * result.mean[:, 0, 1] + result.unscattered
    assert len(np.unique(values.round(12))) > (1 if interface else 0)
    total, error = white_sky(scene, place[None], normal[None], 50_000, 2)
    assert_agree(values.mean(), max(values.std() / np.sqrt(len(values)), 1e-13), total[0, 1], error[0, 1])
    connected = estimate_transport(scene, *many, np.tile(-normal, (100_000, 1)), 2, 1)
    assert_sound(connected)
    alone = estimate_transport(scene, place[None], normal[None], -normal[None], 50_000, 2)
    spread = connected.mean[:, 1].std() / np.sqrt(100_000)
    assert_agree(connected.mean[:, 1].mean(), spread, alone.mean[0, 1], alone.standard_error[0, 1])


@pytest.mark.parametrize("interface", [{}, ROUGH])
def test_thousands_of_directions_share_a_walk(tmp_path: Path, interface: dict[str, Any]) -> None:
    """Their mean is the integral over the sphere."""
    from prt_bake.mathematics.sphere import fibonacci

    scene = make_scene(tmp_path, sphere(3), sigma_t=3.0, albedo=0.9, **interface)
    positions, outgoing, _ = queries(scene.mesh, 2, 3)
    directions = 4096
    lattice = np.broadcast_to(fibonacci(directions), (2, directions, 3))
    runs = [estimate_transport(scene, positions, outgoing, lattice, 150, seed) for seed in range(8)]
    assert_sound(runs[0])
    means = 4.0 * np.pi * np.array([run.mean.mean(axis=1) for run in runs])
    # An error from eight runs is itself known to a quarter.
    error = 1.6 * means.std(axis=0, ddof=1) / np.sqrt(len(runs))
    exits = estimate_coefficients(scene, positions, outgoing, 0, 30_000, 9)
    assert_agree(means.mean(axis=0), error, SQRT_4_PI * exits.mean[:, 0], SQRT_4_PI * exits.standard_error[:, 0])
