"""Sources of training rows: kinds of rays, renderers beside the learner and in turns with it, shuffled files."""

import dataclasses
import threading
import time

import numpy as np
import pytest

from formats.errors import QueryError
from prt_bake.tracer.prepared import prepare
from prt_bake.trainer.samples.repeatable import AlternatingRenderer, ShuffledRows
from prt_bake.trainer.samples.rows import Batch, Box, StreamSettings, ValueTracer, row_tracer
from prt_bake.trainer.samples.stream import BackgroundRenderer
from prt_bake.trainer.training_data import box_of
from tests.trainer.small_training import STREAM, make_scene


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return make_scene(tmp_path_factory.mktemp("scene"))


@pytest.fixture(scope="module")
def rough_scene(tmp_path_factory):
    return make_scene(tmp_path_factory.mktemp("rough"), eta=1.3, roughness=0.5)


def test_rays_are_exits_unless_values_are_asked_for(scene, rough_scene, tmp_path):
    smooth, values = make_scene(tmp_path, eta=1.4), dataclasses.replace(STREAM, rays="values")
    for some in (scene, rough_scene, smooth):
        assert row_tracer(some, box_of(some), STREAM, 0).exits
    for some in (scene, rough_scene):
        assert not row_tracer(some, box_of(some), values, 0).exits
    with pytest.raises(QueryError, match="is smooth; Ŝ has no values"):
        row_tracer(smooth, box_of(smooth), values, 0)


def value_tracer(scene, stream=STREAM):
    return ValueTracer(prepare(scene), Box(np.zeros(3), 1.0), stream, seed=0)


def test_a_renderer_that_is_ahead_pauses(scene):
    stream = dataclasses.replace(STREAM, queries_a_batch=64, capacity=512)
    renderer = BackgroundRenderer(value_tracer(scene, stream), stream, 1, least=64)
    renderer.start()
    try:
        while renderer.statistics().rows <= 256:
            time.sleep(0.01)
        time.sleep(0.1)
        assert renderer.statistics().rows == 320  # half a buffer ahead, and the batch that exceeded it
        renderer.draw(128)
        while renderer.statistics().rows < 448:
            time.sleep(0.01)
    finally:
        renderer.stop()


def test_a_learner_that_is_ahead_waits_for_new_rows(scene):
    tracer, continued = value_tracer(scene), threading.Event()
    render = tracer.render

    def slow(first, count):
        if first:
            continued.wait()
        return render(first, count)

    tracer.render = slow
    stream = dataclasses.replace(STREAM, queries_a_batch=64, capacity=512)
    renderer = BackgroundRenderer(tracer, stream, 1, least=64, reuse=1.5)
    renderer.start()
    try:
        assert len(renderer.draw(96).rows) == 96
        threading.Timer(0.2, continued.set).start()
        renderer.draw(1)
        assert continued.is_set()
        assert renderer.statistics().rows > 64
    finally:
        continued.set()
        renderer.stop()


def test_a_renderer_that_is_ahead_traces_more_walks_per_query(rough_scene):
    """It traces fewer while the learner waits, within the settings' bounds, and counts the walks that it traced."""
    stream = dataclasses.replace(STREAM, queries_a_batch=64, exits=9, least_exits=3, kept=4, capacity=1024)
    tracer = row_tracer(rough_scene, Box(np.zeros(3), 1.0), stream, 0)
    walks, render = [], tracer.render

    def recorded(first, count):
        walks.append(tracer.walks_per_query)
        return render(first, count)

    tracer.render = recorded
    renderer = BackgroundRenderer(tracer, stream, 1, least=16, reuse=1)
    renderer.start()
    try:
        while renderer.statistics().rows < 576:  # it pauses more than half a buffer ahead
            time.sleep(0.01)
        assert walks == [3, 3, 3, 4, 5, 6, 7, 8, 9]
        for _ in range(2000):
            if walks.count(3) >= 20:  # it is ahead again whenever no rows are drawn
                break
            renderer.draw(64)
        assert walks.count(3) >= 20
    finally:
        renderer.stop()
    assert renderer.statistics().walks == 64 * sum(walks)


def test_a_buffer_smaller_than_a_batch_does_not_block(scene):
    stream = dataclasses.replace(STREAM, queries_a_batch=8, capacity=16, reuse=1)
    renderer = BackgroundRenderer(value_tracer(scene, stream), stream, 1, 16, reuse=1)
    renderer.start()
    drawing = threading.Thread(target=lambda: [renderer.draw(200) for _ in range(3)])
    drawing.start()
    drawing.join(20.0)
    blocked = drawing.is_alive()
    renderer.stop()
    assert not blocked
    assert renderer.statistics().rows >= 400


def test_errors_of_the_renderer_reach_the_learner(scene):
    tracer = value_tracer(scene)

    def broken(first, count):
        raise MemoryError("out of memory")

    tracer.render = broken
    renderer = BackgroundRenderer(tracer, STREAM, threads=1, least=10)
    with pytest.raises(MemoryError, match="out of memory"):
        renderer.start()
    with pytest.raises(MemoryError, match="out of memory"):
        renderer.draw(1)
    renderer.stop()


def numbered_block(block):
    numbers = np.arange(10) + 10 * block
    return Batch(np.repeat(numbers[:, None], 12, axis=1).astype(np.float32), numbers)


def test_blocks_are_repeated_for_the_given_passes_and_reshuffled():
    rows = ShuffledRows(numbered_block, rows=10, passes=3, seed=1)
    drawn = np.concatenate([rows.draw(7).numbers for _ in range(10)])[:60].reshape(6, 10)
    np.testing.assert_array_equal(np.sort(drawn, axis=1), np.repeat([np.arange(10), np.arange(10, 20)], 3, axis=0))
    assert len({tuple(order % 10) for order in drawn}) == 6
    endless = ShuffledRows(numbered_block, rows=10, passes=None, seed=1)
    assert endless.draw(95).numbers.max() == 9


def test_blocks_continue_from_any_row():
    complete = ShuffledRows(numbered_block, rows=10, passes=2, seed=1).draw(50)
    rest = ShuffledRows(numbered_block, rows=10, passes=2, seed=1, drawn=33).draw(17)
    np.testing.assert_array_equal(complete.numbers[33:], rest.numbers)
    np.testing.assert_array_equal(complete.rows[33:], rest.rows)


def test_a_block_that_is_rendered_again_counts_once(scene):
    settings = StreamSettings(queries_a_batch=8, directions=2, walks=3)
    tracer = value_tracer(scene, settings)
    source = AlternatingRenderer(tracer, settings, threads=1, seed=0)
    source.draw(20)
    assert source.statistics()[:2] == (72, 24)
    resumed = AlternatingRenderer(tracer, settings, threads=1, seed=0, state=source.state())
    resumed.draw(4)
    assert resumed.statistics()[:2] == (72, 24)
