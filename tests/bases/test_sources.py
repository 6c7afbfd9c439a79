"""Ŝ over the cells is that of the network or of the scene, and points are drawn without bias."""

from pathlib import Path

import numpy as np
import pytest

from formats.errors import QueryError
from formats.mesh import Mesh, build_mesh
from prt_bake.baking.path_traced import PathTraced
from prt_bake.bases.cells import cell_directions
from prt_bake.bases.points import Points, drawn_points
from prt_bake.bases.report import training_values
from prt_bake.bases.sources import OfModel, OfScene
from prt_bake.mathematics import sh
from prt_bake.tracer.estimate import estimate_coefficients
from tests.network.test_lobes import lobed
from tests.shapes import ball
from tests.tracer.scenes import make_scene

Array = np.ndarray


def sphere() -> Mesh:
    """The surface of the glass ball in `tests.network.test_lobes`."""
    unit = ball(4, 0.45)
    return build_mesh(unit.positions + 0.5, unit.faces)


def at_the_top(points: Points) -> Array:
    return np.asarray(np.maximum(points.positions[:, 1] - 0.7, 0.0) ** 2)


def test_points_are_on_their_faces_and_seen_from_outside() -> None:
    mesh = sphere()
    points, weights = drawn_points(mesh, 500, 1, lambda candidates: np.zeros(len(candidates.faces)))
    np.testing.assert_array_equal(weights, 1.0)
    normals = mesh.face_normals[points.faces]
    heights = ((points.positions - mesh.positions[mesh.faces[points.faces, 0]]) * normals).sum(axis=1)
    np.testing.assert_allclose(heights, 0.0, atol=1e-12)
    cosines = (points.outgoing * normals).sum(axis=1)
    assert cosines.min() > 0.0
    assert abs(cosines.mean() - 0.5) < 0.06
    assert np.abs(points.positions.mean(axis=0) - 0.5).max() < 0.06


def test_weighted_means_over_points_are_those_of_the_surface() -> None:
    """Most points are where the estimate is large; means stay those of the whole surface."""
    mesh = sphere()
    points, weights = drawn_points(mesh, 2000, 2, at_the_top)
    assert (points.positions[:, 1] > 0.7).mean() > 0.75
    even, _ = drawn_points(mesh, 20000, 3, lambda candidates: np.ones(len(candidates.faces)))
    assert weights.mean() == pytest.approx(1.0, abs=0.1)
    assert (weights * at_the_top(points)).mean() == pytest.approx(at_the_top(even).mean(), rel=0.05)
    assert weights.max() <= 5.0 + 1e-12


def test_training_values_count_as_those_of_the_whole_surface() -> None:
    class AtTheTop:
        cells, lobes = 1, 0

        def squares(self, points: Points) -> Array:
            return at_the_top(points)

        def values(self, points: Points, repeated: int) -> list[Array]:
            return [0.1 + np.sqrt(at_the_top(points))[:, None, None] * np.ones(3)] * repeated

        def own_lobes(self, values: Array, points: Points) -> None:
            return None

    source, mesh = AtTheTop(), sphere()
    even, _ = drawn_points(mesh, 20000, 3, lambda candidates: np.ones(len(candidates.faces)))
    found = (training_values(source, mesh, 2000, 2) ** 2).sum() / 2000
    assert found == pytest.approx((source.values(even, 1)[0] ** 2).sum() / 20000, rel=0.05)


@pytest.mark.parametrize("low_width", [0, 12])
def test_the_own_lobes_of_a_network_are_its_detail_beyond_degree_2(low_width: int) -> None:
    network, mesh = lobed(low_width), sphere()
    source = OfModel(network, mesh, "y")
    points, _ = drawn_points(mesh, 12, 4, source.squares)
    values, same = source.values(points, 2)
    assert values is same
    lobes = source.own_lobes(values, points)
    assert lobes is not None
    directions = cell_directions(source.cells, "y")
    np.testing.assert_allclose(
        values[:, ::97],
        network.on(mesh).evaluate(directions[::97], points.positions, points.outgoing),
        rtol=2e-4,
        atol=1e-5,
    )
    harmonics = sh.evaluate(directions, 2) * (4.0 * np.pi / len(directions))
    if low_width:
        np.testing.assert_allclose(lobes, OfModel(lobed(), mesh, "y").own_lobes(values, points), atol=1e-5)
    low = np.einsum("mk,nmc->nkc", harmonics, lobes)
    assert np.abs(low).max() < 0.01 * np.abs(np.einsum("mk,nmc->nkc", harmonics, values)).max()
    assert np.linalg.norm(lobes) > 0.1 * np.linalg.norm(values)


def test_cells_of_a_scene_hold_its_coefficients(tmp_path: Path) -> None:
    scene = make_scene(tmp_path, ball(2))
    source = OfScene(scene)
    points, _ = drawn_points(scene.mesh, 6, 5, source.squares)
    first, second = source.values(points, 2)
    assert not np.array_equal(first, second)
    assert source.own_lobes(first, points) is None
    harmonics = sh.evaluate(cell_directions(source.cells, scene.up), 1) * (4.0 * np.pi / source.cells**2)
    one, other = (np.einsum("mk,nmc->nkc", harmonics, part) for part in (first, second))
    traced = estimate_coefficients(scene, points.positions, points.outgoing, 1, 20000, 1)
    deviation = float(np.linalg.norm(one - other)) / 2.0
    # 24 values, equal in the three channels; a ratio of 2 of two such norms has a chance below 10⁻³.
    assert np.linalg.norm(0.5 * (one + other) - traced.mean) < 2.0 * deviation < 0.1 * np.linalg.norm(traced.mean)


def test_a_transport_without_values_is_refused(tmp_path: Path) -> None:
    scene = make_scene(tmp_path, ball(2))
    with pytest.raises(QueryError, match="expected a transport that evaluates Ŝ"):
        OfModel(PathTraced(scene), scene.mesh, "y")
