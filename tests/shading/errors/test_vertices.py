"""The error by the interpolation between vertices, compared with the interpolation of known radiance."""

from collections.abc import Callable

import numpy as np
import pytest
import trimesh

from formats.asset import Asset
from formats.mesh import Mesh
from prt_bake.shading.errors.vertices import vertex_error
from tests.shading.test_picture import make_asset
from tests.shapes import ball

Field = Callable[[np.ndarray], np.ndarray]


def wave(frequency: float) -> Field:
    """A smooth radiance in space [n,3]."""
    phases = np.array([[0.9, 0.3, 0.2], [0.1, 0.8, 0.5], [0.4, 0.2, 0.9]])
    return lambda x: 1.5 + np.sin(frequency * x @ phases)


def interpolation_error(mesh: Mesh, field: Field) -> float:
    """Relative RMSE of the linear interpolation at random points of the faces of a ball, for radiance on the ball."""
    weights = np.random.default_rng(2).dirichlet(np.ones(3), (len(mesh.faces), 20))
    at_corners = field(mesh.positions)[mesh.faces]
    shown = np.einsum("fsk,fkc->fsc", weights, at_corners)
    points = np.einsum("fsk,fkc->fsc", weights, mesh.positions[mesh.faces]).reshape(-1, 3)
    true = field(points / np.linalg.norm(points, axis=1, keepdims=True)).reshape(shown.shape)
    return float(np.sqrt(((shown - true) ** 2).sum() / (true**2).sum()))


def estimate(mesh: Mesh, radiance: np.ndarray, sigma: float = 0.0, visible: np.ndarray | None = None) -> float | None:
    shares = np.ones(len(radiance)) if visible is None else 1.0 * visible
    return vertex_error(flat(mesh), shares, radiance * (shares > 0.0)[:, None], np.full_like(radiance, sigma))


def flat(mesh: Mesh) -> Asset:
    return make_asset(mesh, rings=1, sectors=1)


@pytest.mark.parametrize(("subdivisions", "frequency"), [(2, 2.0), (3, 2.0), (3, 5.0), (4, 2.0), (4, 5.0), (4, 10.0)])
def test_the_error_of_smooth_radiance_is_that_of_the_interpolation(subdivisions: int, frequency: float) -> None:
    mesh, field = ball(subdivisions), wave(frequency)
    true = interpolation_error(mesh, field)
    assert estimate(mesh, field(mesh.positions)) == pytest.approx(true, rel=0.3)


def test_it_falls_by_four_as_the_edges_halve() -> None:
    coarse, fine = (estimate(ball(level), wave(3.0)(ball(level).positions)) for level in (3, 4))
    assert coarse / fine == pytest.approx(4.0, rel=0.1)


def test_an_edge_is_coarse_at_every_distance() -> None:
    """The error at a step of the radiance falls as the root of the edges' length."""
    steps = [lambda x: 1.0 + 1.0 * (x[:, :1] + 0.3 * x[:, 1:2] > 0.123) * np.ones(3)] * 3
    for level, step in zip((2, 3, 4), steps, strict=True):
        assert estimate(ball(level), step(ball(level).positions)) == pytest.approx(
            interpolation_error(ball(level), step), rel=0.4
        )


def test_detail_finer_than_the_vertices_is_found_whole() -> None:
    mesh = ball(4)
    spread = 0.2
    radiance = 1.0 + spread * np.random.default_rng(0).normal(size=(len(mesh.positions), 3))
    assert estimate(mesh, radiance) == pytest.approx(spread, rel=0.15)


def test_the_bake_error_of_vertices_is_not_counted_twice() -> None:
    mesh, noise = ball(4), 0.05
    radiance = 1.0 + noise * np.random.default_rng(0).normal(size=(len(mesh.positions), 3))
    assert estimate(mesh, radiance, sigma=noise) < 0.25 * noise
    detailed = radiance - 1.0 + wave(9.0)(mesh.positions)
    assert estimate(mesh, detailed, sigma=noise) == pytest.approx(interpolation_error(mesh, wave(9.0)), rel=0.4)


def test_linear_radiance_on_a_plane_has_none() -> None:
    """On a triangulation of any shape, and at its border."""
    x, y = np.meshgrid(np.arange(12.0), np.arange(12.0))
    inner = (x > 0) & (x < 11) & (y > 0) & (y < 11)
    jitter = np.random.default_rng(4).uniform(-0.3, 0.3, (2, 12, 12)) * inner
    corner = (np.arange(11)[:, None] * 12 + np.arange(11)).ravel()
    faces = np.concatenate(
        [np.stack([corner, corner + 1, corner + 13], 1), np.stack([corner, corner + 13, corner + 12], 1)]
    )
    positions = np.stack([(x + jitter[0]).ravel(), (y + jitter[1]).ravel(), np.zeros(144)], 1)
    mesh = Mesh.from_trimesh(trimesh.Trimesh(positions, faces, process=False))
    radiance = 1.0 + mesh.positions @ np.array([[0.1, 0.2, 0.0], [0.0, 0.1, 0.3], [0.0, 0.0, 0.0]])
    assert estimate(mesh, radiance) < 1e-9


def test_hidden_vertices_do_not_count() -> None:
    """They have no radiance, which would look like an edge."""
    mesh, field = ball(4), wave(3.0)
    visible = mesh.normals[:, 2] > 0.0
    whole, half = (estimate(mesh, field(mesh.positions), visible=some) for some in (None, visible))
    assert half == pytest.approx(whole, rel=0.5)


def test_vertices_count_by_their_share_of_the_picture() -> None:
    mesh = ball(4)
    radiance = np.ones((len(mesh.positions), 3))
    rough = mesh.normals[:, 2] > 0.5
    radiance[rough] += 0.2 * np.random.default_rng(0).normal(size=(int(rough.sum()), 3))
    small = vertex_error(flat(mesh), np.where(rough, 0.01, 1.0), radiance, 0.0 * radiance)
    assert small < 0.3 * estimate(mesh, radiance)


def test_few_vertices_tell_nothing() -> None:
    box = Mesh.from_trimesh(trimesh.creation.box())
    assert estimate(box, np.ones((8, 3)), visible=box.positions[:, 2] > 0.0) is None
    mesh = ball(3)
    assert estimate(mesh, np.ones((len(mesh.positions), 3)), visible=np.arange(len(mesh.positions)) == 7) is None
    assert estimate(mesh, np.zeros((len(mesh.positions), 3))) is None
