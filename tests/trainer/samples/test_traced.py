"""Queries that are kept to be learned from again: all walks of each, once, in little memory."""

from pathlib import Path

import numpy as np
import pytest
import torch

from prt_bake.mathematics import sh
from prt_bake.mathematics.sphere import uniform
from prt_bake.tracer.prepared import prepare
from prt_bake.trainer.samples.queries import QuerySource
from prt_bake.trainer.samples.repeatable import AlternatingRenderer
from prt_bake.trainer.samples.rows import ExitTracer, StreamSettings, trace_exits
from prt_bake.trainer.samples.traced import Traced, TracedQueries, mean_coefficients
from prt_bake.trainer.training_data import box_of
from tests.tracer.scenes import lumpy, make_scene


def kept(queries: TracedQueries) -> Traced:
    found = queries.joined()
    assert found is not None
    return found


def block(count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    generator = np.random.default_rng(seed)
    return generator.random((count, 6)).astype(np.float32), generator.normal(size=(count, 27))


def test_mean_coefficients_are_the_sums_over_all_walks() -> None:
    directions, throughput = uniform(40, 1).reshape(5, 8, 3), np.random.default_rng(2).random((5, 8, 3))
    basis = sh.evaluate(directions.reshape(-1, 3), 2).reshape(5, 8, 9)
    expected = np.zeros((5, 27))
    for n, p in np.ndindex(5, 8):
        expected[n] += np.outer(basis[n, p], throughput[n, p]).ravel() / 8
    np.testing.assert_allclose(mean_coefficients(directions, throughput), expected, atol=1e-12)


@pytest.mark.parametrize("scale", [1.0, 1e-9, 1e9])
def test_coefficients_keep_three_digits_of_the_largest(scale: float) -> None:
    queries, (views, coefficients) = TracedQueries(), block(50, 1)
    coefficients *= scale
    queries.add(0, views, coefficients)
    found = kept(queries).coefficients(torch.arange(50)).numpy().reshape(50, 27)
    assert (np.abs(found - coefficients) <= 5e-4 * np.abs(coefficients).max(axis=1, keepdims=True)).all()
    np.testing.assert_array_equal(kept(queries).views.numpy(), views)


def test_queries_without_light_are_kept() -> None:
    queries = TracedQueries()
    queries.add(0, block(3, 1)[0], np.zeros((3, 27)))
    assert not kept(queries).coefficients(slice(None)).any()


def test_a_block_that_is_traced_again_counts_once_and_the_oldest_are_forgotten() -> None:
    queries = TracedQueries(capacity=25)
    assert queries.joined() is None
    blocks = [block(10, seed) for seed in range(5)]
    for number in (0, 1, 1, 0, 2, 3, 4):
        queries.add(10 * number, *blocks[number])
    np.testing.assert_array_equal(kept(queries).views.numpy(), np.concatenate([blocks[k][0] for k in (2, 3, 4)])[-25:])


def test_a_state_continues() -> None:
    queries, again = TracedQueries(), TracedQueries()
    again.restore(queries.state())
    assert again.joined() is None
    queries.add(0, *block(10, 1))
    queries.add(10, *block(10, 2))
    again.restore(queries.state())
    again.add(10, *block(10, 2))
    again.add(20, *block(5, 3))
    queries.add(20, *block(5, 3))
    for found, expected in zip(kept(again), kept(queries), strict=True):
        assert torch.equal(found, expected)
    assert len(kept(again).views) == 25


def test_a_renderer_keeps_all_walks_of_each_query_once(tmp_path: Path) -> None:
    """Not only those of the rays that represent them; what crosses unscattered is no part of them."""
    scene = make_scene(tmp_path, lumpy(2), eta=1.3, sigma_t=0.2)
    prepared, stream = prepare(scene), StreamSettings(queries_a_batch=40, exits=16, kept=4, reuse=2)
    renderer = AlternatingRenderer(ExitTracer(prepared, box_of(scene), stream, 3), stream, 1, 3)
    rows = renderer.draw(160).rows
    assert renderer.traced is not None
    source = QuerySource(prepared, 1, 3, stream.face_share, stream.edge_share)
    exits = trace_exits(prepared, source, source.draw(0, 80), 16, 3)
    throughput = np.where(exits.unscattered[..., None], 0.0, exits.throughput)
    found = kept(renderer.traced)
    expected = mean_coefficients(exits.directions, throughput)
    assert exits.unscattered.any()
    np.testing.assert_allclose(found.coefficients(slice(None)).reshape(80, 27), expected, atol=1e-3 * expected.max())
    np.testing.assert_array_equal(np.unique(rows[:, :6], axis=0), np.unique(found.views.numpy(), axis=0))
