"""Training: its queries, its ring buffer, and that a network learns."""

import dataclasses

import numpy as np
import pytest

from formats.errors import QueryError
from formats.mesh import build_mesh
from prt_bake.network.bssrdf import load_model
from prt_bake.tracer.prepared import prepare
from prt_bake.trainer.samples.queries import EDGE_SHARE, QuerySource
from prt_bake.trainer.samples.rows import Batch, StreamSettings
from prt_bake.trainer.samples.stream import RingBuffer
from prt_bake.trainer.train import train
from prt_bake.trainer.validation import hold_out, noise_free_ratio
from tests.mathematics.sampling import SphereCells, assert_counts_follow
from tests.tracer import scenes
from tests.tracer.scenes import lumpy
from tests.trainer.small_training import LEARNING, SMALL, STREAM, make_scene, train_small


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return make_scene(tmp_path_factory.mktemp("scene"))


@pytest.fixture(scope="module")
def queries(scene):
    return QuerySource(prepare(scene), 6, seed=3).draw(0, 20_000)


def test_queries_cover_the_surface_by_area(scene, queries):
    interior = queries.location.barycentric
    inside = (interior.min(axis=1) > 2e-4) & (interior.sum(axis=1) < 1 - 2e-4)
    expected = scene.mesh.face_areas / scene.mesh.face_areas.sum()
    counts = np.bincount(queries.location.faces[inside], minlength=len(expected))
    expected = expected * inside.sum()
    chi_square = np.sum((counts - expected) ** 2 / expected)
    freedom = len(expected) - 1
    assert abs(chi_square - freedom) < 4.5 * np.sqrt(2 * freedom)  # false alarm 1e-5


def test_queries_are_uniform_in_their_triangles(queries):
    """With b₀ the first barycentric coordinate, (1 − b₀)² and b₂ / (1 − b₀) are uniform and independent."""
    u, v = queries.location.barycentric.T
    inside = (u > 2e-4) & (v > 2e-4) & (u + v < 1 - 2e-4)
    u, v = u[inside], v[inside]
    counts = np.histogram2d((u + v) ** 2, v / (u + v), bins=16, range=[[0, 1], [0, 1]])[0]
    assert_counts_follow(counts.ravel(), np.full(256, 1 / 256))


def test_a_tenth_of_the_queries_are_on_vertices_and_edges(queries):
    full = np.concatenate(
        [1 - queries.location.barycentric.sum(axis=1, keepdims=True), queries.location.barycentric], axis=1
    )
    on_edge = (full < 1.5e-4).any(axis=1)
    on_vertex = (full < 1.5e-4).sum(axis=1) == 2
    spread = np.sqrt(EDGE_SHARE / len(full))
    assert abs(on_edge.mean() - EDGE_SHARE) < 4.5 * spread
    assert abs(on_vertex.mean() - EDGE_SHARE / 2) < 4.5 * spread


def test_the_share_of_queries_on_vertices_and_edges_is_a_setting(scene):
    for share in (0.0, 0.4, 1.0):
        u, v = QuerySource(prepare(scene), 1, 4, edge_share=share).draw(0, 5_000).location.barycentric.T
        on_edge = np.minimum(np.minimum(u, v), 1 - u - v) < 1.5e-4
        assert abs(on_edge.mean() - share) < 4.5 * np.sqrt((share * (1 - share) + 1e-3) / len(u))
    with pytest.raises(QueryError, match="edge_share must be 0 to 1, found 2"):
        StreamSettings(edge_share=2)


def test_views_fill_the_hemisphere_and_stay_above_the_horizon(scene, queries):
    cosine = np.sum(scene.mesh.face_normals[queries.location.faces] * queries.outgoing, axis=1)
    assert cosine.min() > 0
    assert abs(cosine.mean() - 0.5) < 0.02
    u, v = queries.location.barycentric.T
    inside = (u > 2e-4) & (v > 2e-4) & (u + v < 1 - 2e-4)
    axis = scene.mesh.face_normals[queries.location.faces[inside]]
    across = np.cross(axis, [0.3, 0.5, 0.8])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    views = queries.outgoing[inside]
    turn = np.arctan2(np.sum(views * np.cross(axis, across), axis=1), np.sum(views * across, axis=1))
    counts = np.histogram2d(cosine[inside], turn / (2 * np.pi) % 1.0, bins=16, range=[[0, 1], [0, 1]])[0]
    assert_counts_follow(counts.ravel(), np.full(256, 1 / 256))
    assert np.allclose(np.linalg.norm(queries.outgoing, axis=1), 1)


def test_each_direction_of_incidence_is_uniform(queries):
    d = queries.incident
    assert np.allclose(np.linalg.norm(d, axis=-1), 1)
    cells = SphereCells(16, 16)
    for k in range(d.shape[1]):
        assert_counts_follow(cells.count(d[:, k]), np.full(256, 1 / 256))
    assert np.abs(d.mean(axis=0)).max() < 4.5 / np.sqrt(3 * len(d))
    second = np.einsum("ndi,ndj->dij", d, d) / len(d)
    assert np.abs(second - np.eye(3) / 3).max() < 4.5 * 0.3 / np.sqrt(len(d))


def test_a_query_depends_on_seed_and_number_alone(scene):
    source = QuerySource(prepare(scene), 3, seed=5)
    hundred, part = source.draw(0, 100), source.draw(40, 20)
    np.testing.assert_array_equal(hundred.outgoing[40:60], part.outgoing)
    np.testing.assert_array_equal(hundred.incident[40:60], part.incident)
    assert not np.array_equal(part.outgoing, QuerySource(prepare(scene), 3, seed=6).draw(40, 20).outgoing)


def test_the_ring_keeps_the_newest_rows():
    ring = RingBuffer(10)
    for first in (0, 6, 12):
        numbers = np.arange(first, first + 6)
        ring.put(Batch(np.repeat(numbers[:, None], 12, axis=1).astype(np.float32), numbers))
    assert ring.filled == 10
    assert sorted(ring.rows[:, 0]) == list(range(8, 18))
    drawn = ring.draw(1000)
    assert set(drawn.rows[:, 0]) == set(range(8, 18))
    np.testing.assert_array_equal(drawn.rows[:, 0], drawn.numbers)


def test_rows_of_the_ring_are_drawn_equally_often():
    """A reader 2.5 times as fast as the writer reads every row two or three times."""
    ring, drawn = RingBuffer(40), np.zeros(0, int)
    for first in range(0, 4000, 8):
        numbers = np.arange(first, first + 8)
        ring.put(Batch(np.repeat(numbers[:, None], 12, axis=1).astype(np.float32), numbers))
        drawn = np.concatenate([drawn, ring.draw(13).numbers, ring.draw(7).numbers])
    times = np.bincount(drawn, minlength=4000)[100:-100]
    assert (np.min(times), np.max(times)) == (2, 3)
    assert np.mean(times) == pytest.approx(2.5, abs=0.02)


def test_the_reference_s_noise_is_subtracted():
    generator = np.random.default_rng(4)
    truth = generator.uniform(1, 2, (2000, 8, 3))
    answer = truth * 1.05
    error = np.full_like(truth, 0.5)
    ratio = noise_free_ratio(answer, truth + generator.normal(0, error), error)
    assert abs(ratio - 0.05) < 0.01
    assert noise_free_ratio(truth, truth + generator.normal(0, error), error) < 0.02


def test_a_network_learns_a_scene(scene, tmp_path):
    network = train_small(scene, 600, output=tmp_path / "m.pt")
    errors = network.metadata["training"]["relative_rmse"]
    held_out = hold_out(prepare(scene), 256, 4, 64, seed=99)
    error = held_out.relative_rmse(network)
    constant = noise_free_ratio(held_out.mean.mean(axis=(0, 1)), held_out.mean, held_out.standard_error)
    assert error < 0.7 * constant
    assert abs(errors["transport"] - error) < 0.25 * error
    assert errors["coefficients"] < error
    read = load_model(tmp_path / "m.pt")
    q = held_out.queries
    np.testing.assert_array_equal(
        read.evaluate(q.incident, q.positions, q.outgoing), network.evaluate(q.incident, q.positions, q.outgoing)
    )


def test_ctrl_c_keeps_what_was_learnt(scene, tmp_path):
    reports = []

    def interrupt(report):
        reports.append(report)
        raise KeyboardInterrupt

    network = train(
        scene,
        minutes=1,
        settings=SMALL,
        stream=STREAM,
        learning=dataclasses.replace(LEARNING, report_every=0.05),
        output=tmp_path / "m.pt",
        progress=interrupt,
    )
    assert network.metadata["training"]["steps"] > 0
    assert load_model(tmp_path / "m.pt").metadata["training"]["steps"] == network.metadata["training"]["steps"]
    assert len(reports) == 1


def test_a_loss_that_is_not_finite_stops_the_run(scene):
    divergent = dataclasses.replace(LEARNING, rate=1e20, warm_up=1e-9)
    with pytest.raises(QueryError, match="the loss of step"):
        train(scene, steps=50, settings=SMALL, stream=STREAM, learning=divergent)


def test_a_share_of_the_queries_is_uniform_over_the_faces(tmp_path):
    """Faces of very different area have the counts that their area and the share predict (chi-square)."""
    mesh = lumpy(1)
    scene = scenes.make_scene(tmp_path, build_mesh(mesh.positions * [1.0, 0.1, 2.0], mesh.faces))
    location = QuerySource(prepare(scene), 1, 5, face_share=0.3).draw(0, 40_000).location
    full = np.concatenate([1.0 - location.barycentric.sum(axis=1, keepdims=True), location.barycentric], axis=1)
    # Queries on edges are assigned to the face that faces the view most.
    faces = location.faces[full.min(axis=1) > 2e-4]
    counts = np.bincount(faces, minlength=len(scene.mesh.faces))
    area = scene.mesh.face_areas / scene.mesh.face_areas.sum()
    assert_counts_follow(counts, 0.3 / len(area) + 0.7 * area)
    with pytest.raises(AssertionError):
        assert_counts_follow(counts, area)
