"""Runs that stop and go on, that can be repeated to the last bit, and what they say of themselves."""

import dataclasses
import threading
import time

import numpy as np
import pytest
import torch

from formats.errors import ModelError, QueryError
from prt_bake.network.bssrdf import load_model
from prt_bake.tracer.prepared import prepare
from prt_bake.trainer import cores
from prt_bake.trainer.history import every_tenth
from prt_bake.trainer.resume import state_path
from prt_bake.trainer.samples.repeatable import AlternatingRenderer, ShuffledRows
from prt_bake.trainer.samples.rows import Batch, Box, SourceStatistics, StreamSettings, ValueTracer, row_tracer
from prt_bake.trainer.samples.stream import BackgroundRenderer
from prt_bake.trainer.training_data import PathTracedData, box_of
from tests.trainer.small_training import LEARNING, SMALL, STREAM, learnt, make_scene

EAGER = dataclasses.replace(LEARNING, report_every=0.0, checkpoint_every=0.0, held_out_queries=16, held_out_walks=16)


class Killed(Exception):
    """What a killed run never sees."""


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return make_scene(tmp_path_factory.mktemp("scene"))


@pytest.fixture(scope="module")
def rough_scene(tmp_path_factory):
    return make_scene(tmp_path_factory.mktemp("rough"), eta=1.3, roughness=0.5)


def weights(network):
    return {name: tensor.numpy().tobytes() for name, tensor in network.state_dict().items()}


def before_rounding(output):
    """The weights and their average, every bit of them, as the state beside a model has them."""
    learner = torch.load(state_path(output), weights_only=True)["learner"]
    return {
        (part, name): learner[part][name].numpy().tobytes() for part in ("network", "average") for name in learner[part]
    }


def killed_after(scene, step, output, **more):
    """A run whose process ends after `step`, a checkpoint after each step before it."""

    def die(row):
        if row.step >= step:
            raise Killed

    with pytest.raises(Killed):
        learnt(scene, 24, output=output, progress=die, **more)


def test_turns_repeat_to_the_last_bit(scene):
    settings = {"synchronous": True, "learning": EAGER}
    first, second = learnt(scene, 24, **settings), learnt(scene, 24, **settings)
    assert weights(first) == weights(second)
    assert weights(first) != weights(learnt(scene, 24, seed=2, **settings))


@pytest.mark.parametrize(("step", "name"), [(7, "scene"), (23, "scene"), (7, "rough_scene")])
def test_a_killed_run_in_turns_ends_with_the_same_bits(request, tmp_path, step, name):
    """From values, and behind a rough interface from exits, where the learner draws directions of its own."""
    scene = request.getfixturevalue(name)
    # 128 rows a step, 500 a block, passed over twice: the kills lie in the first block and across one.
    settings = {
        "synchronous": True,
        "learning": EAGER,
        "stream": dataclasses.replace(STREAM, queries_a_batch=500, reuse=2),
    }
    killed_after(scene, step, tmp_path / "m.pt", **settings)
    assert torch.load(state_path(tmp_path / "m.pt"), weights_only=True)["learner"]["step"] == step - 1
    resumed = learnt(scene, 24, output=tmp_path / "m.pt", resume=True, **settings)
    whole = learnt(scene, 24, output=tmp_path / "whole.pt", **settings)
    assert weights(resumed) == weights(whole)
    assert before_rounding(tmp_path / "m.pt") == before_rounding(tmp_path / "whole.pt")
    for figure in ("steps", "walks"):
        assert resumed.metadata["training"][figure] == whole.metadata["training"][figure]


def test_a_run_killed_before_its_first_checkpoint_leaves_nothing(scene, tmp_path):
    killed_after(scene, 1, tmp_path / "m.pt", learning=EAGER)
    with pytest.raises(ModelError, match="nothing to resume"):
        learnt(scene, 24, output=tmp_path / "m.pt", resume=True)


def test_turns_are_resumed_with_the_settings_that_they_began_with(scene, tmp_path):
    learnt(scene, 2, output=tmp_path / "m.pt", synchronous=True, learning=EAGER)
    with pytest.raises(ModelError, match="begun with stream reuse 1, asked for is 2"):
        learnt(
            scene,
            4,
            output=tmp_path / "m.pt",
            synchronous=True,
            resume=True,
            learning=EAGER,
            stream=dataclasses.replace(STREAM, reuse=2),
        )


def test_turns_do_not_depend_on_the_number_of_cores(rough_scene, monkeypatch):
    found = []
    learning = dataclasses.replace(EAGER, core_share=0.5)
    for count in (1, 4):
        monkeypatch.setattr(cores, "available", lambda count=count: count)
        found.append(weights(learnt(rough_scene, 12, synchronous=True, learning=learning)))
    assert found[0] == found[1]


def test_turns_need_steps(scene):
    with pytest.raises(QueryError, match="synchronous needs steps"):
        learnt(scene, None, synchronous=True)


@pytest.mark.parametrize(("share", "learn"), [(0.25, (1, 1, 2, 4)), (0.5, (1, 2, 4, 8)), (0.0, (1, 1, 1, 1))])
def test_cores_are_divided_and_share_one(monkeypatch, share, learn):
    monkeypatch.setattr(cores, "_allowed", lambda threads: threads)
    for count, learners in zip((2, 4, 8, 16), learn, strict=True):
        monkeypatch.setattr(cores, "available", lambda count=count: count)
        assert cores.divided(share, "cpu") == (count - learners + 1, learners)
        assert cores.divided(share, "cuda") == (count, 1)
    monkeypatch.setattr(cores, "available", lambda: 1)
    assert cores.divided(share, "cpu") == (1, 1)


def test_rays_are_values_where_light_leaves_unbent_and_exits_elsewhere(scene, rough_scene, tmp_path):
    smooth = make_scene(tmp_path, eta=1.4)
    for some, exits in ((scene, False), (rough_scene, True), (smooth, True)):
        assert row_tracer(some, prepare(some), box_of(some), STREAM, 0).exits is exits
    asked = dataclasses.replace(STREAM, rays="values")
    assert not row_tracer(rough_scene, prepare(rough_scene), box_of(rough_scene), asked, 0).exits
    with pytest.raises(QueryError, match="is smooth, and behind it Ŝ has no values"):
        row_tracer(smooth, prepare(smooth), box_of(smooth), asked, 0)


def test_a_renderer_that_is_ahead_rests(scene):
    stream = dataclasses.replace(STREAM, queries_a_batch=64, capacity=512)
    renderer = BackgroundRenderer(ValueTracer(prepare(scene), Box(np.zeros(3), 1.0), stream, seed=0), stream, 1, least=64)
    renderer.start()
    try:
        while renderer.done().rows <= 256:
            time.sleep(0.01)
        time.sleep(0.1)
        assert renderer.done().rows == 320  # half a buffer ahead, and the batch that went past it
        renderer.draw(128, np.random.default_rng(0))
        while renderer.done().rows < 448:
            time.sleep(0.01)
    finally:
        renderer.stop()


def test_a_learner_that_is_ahead_waits_for_new_rows(scene):
    walks, begun = ValueTracer(prepare(scene), Box(np.zeros(3), 1.0), STREAM, seed=0), threading.Event()
    render = walks.render

    def slow(first, count):
        if first:
            begun.wait()
        return render(first, count)

    walks.render = slow
    stream = dataclasses.replace(STREAM, queries_a_batch=64, capacity=512)
    renderer = BackgroundRenderer(walks, stream, 1, least=64, reuse=1.5)
    renderer.start()
    try:
        generator = np.random.default_rng(0)
        assert len(renderer.draw(96, generator).rows) == 96
        later = threading.Timer(0.2, begun.set)
        later.start()
        asked = time.perf_counter()
        renderer.draw(1, generator)
        assert time.perf_counter() - asked > 0.15
        assert renderer.done().rows > 64
    finally:
        begun.set()
        renderer.stop()


def test_a_renderer_that_is_ahead_walks_more_often_from_each_query(rough_scene):
    """And less often while the learner waits, within the settings' bounds; the walks are counted as they were."""
    stream = dataclasses.replace(STREAM, queries_a_batch=64, exits=9, least_exits=3, kept=4, capacity=1024)
    walks = row_tracer(rough_scene, prepare(rough_scene), Box(np.zeros(3), 1.0), stream, 0)
    asked, render = [], walks.render

    def noted(first, count):
        asked.append(walks.walks_per_query)
        return render(first, count)

    walks.render = noted
    renderer = BackgroundRenderer(walks, stream, 1, least=16, reuse=1)
    renderer.start()
    try:
        while renderer.done().rows < 576:  # it rests more than half a buffer ahead
            time.sleep(0.01)
        assert asked == [3, 3, 3, 4, 5, 6, 7, 8, 9]
        for _ in range(80):
            renderer.draw(64, np.random.default_rng(0))
        assert asked.count(3) > 20  # of 80 batches; it is ahead again as soon as nobody draws
    finally:
        renderer.stop()
    assert renderer.done().walks == 64 * sum(asked)


def test_a_buffer_smaller_than_a_batch_stops_nobody(scene):
    stream = dataclasses.replace(STREAM, queries_a_batch=8, capacity=16, reuse=1)
    renderer = BackgroundRenderer(ValueTracer(prepare(scene), Box(np.zeros(3), 1.0), stream, seed=0), stream, 1, 16, reuse=1)
    renderer.start()
    drawing = threading.Thread(target=lambda: [renderer.draw(200, np.random.default_rng(0)) for _ in range(3)])
    drawing.start()
    drawing.join(20.0)
    waits = drawing.is_alive()
    renderer.stop()
    assert not waits
    assert renderer.done().rows >= 400


def test_only_a_learner_on_the_walkers_cores_waits_for_them(scene):
    material = PathTracedData(scene, dataclasses.replace(STREAM, reuse=2), 0, False)
    assert material.source(LEARNING, "cpu", None).reuse == 2
    assert material.source(LEARNING, "cuda", None).reuse == np.inf


def test_an_unknown_device_is_refused(scene):
    assert cores.select_device("cpu") == "cpu"
    assert cores.select_device("auto") == ("cuda" if torch.cuda.is_available() else "cpu")
    with pytest.raises(QueryError, match="'tpu' is not there"):
        learnt(scene, 1, device="tpu")


def test_a_run_beside_its_renderer_goes_on_where_it_stopped(scene, tmp_path):
    output = tmp_path / "m.pt"
    learnt(scene, 60, output=output)
    state = torch.load(state_path(output), weights_only=True)
    longer = learnt(scene, 100, output=output, resume=True)
    training = longer.metadata["training"]
    assert state["learner"]["step"] == 60
    assert training["steps"] == 100
    assert training["walks"] > state["source"]["walks"]
    assert training["seconds"] > state["seconds"]
    after = torch.load(state_path(output), weights_only=True)
    assert after["source"]["next_query"] > state["source"]["next_query"]
    moments = [state["learner"]["optimizer"]["state"][0]["step"], after["learner"]["optimizer"]["state"][0]["step"]]
    assert moments == [60, 100]
    assert len(after["history"]) > len(state["history"])


def test_a_trained_model_is_written_as_it_was_measured_and_goes_on_from_what_was_learnt(scene, tmp_path):
    """Rounded to what float16 holds; the state beside it has the weights themselves."""
    network = learnt(scene, 24, output=tmp_path / "m.pt", synchronous=True)
    assert weights(load_model(tmp_path / "m.pt")) == weights(network)
    assert all(torch.equal(weight.half().float(), weight) for weight in network.parameters())
    kept = torch.load(state_path(tmp_path / "m.pt"), weights_only=True)["learner"]["average"]
    assert not torch.equal(kept["output.weight"].half().float(), kept["output.weight"])


def test_a_killed_run_beside_its_renderer_loses_a_checkpoint_at_most(scene, tmp_path):
    output = tmp_path / "m.pt"
    killed_after(scene, 9, output, learning=EAGER)
    assert torch.load(state_path(output), weights_only=True)["learner"]["step"] == 8
    assert learnt(scene, 24, output=output, resume=True).metadata["training"]["steps"] == 24


def test_what_was_learnt_is_kept_before_it_is_measured(scene, tmp_path, monkeypatch):
    output = tmp_path / "m.pt"

    def killed(*_):
        raise Killed

    monkeypatch.setattr(PathTracedData, "figures", killed)
    with pytest.raises(Killed):
        learnt(scene, 9, output=output)
    assert torch.load(state_path(output), weights_only=True)["learner"]["step"] == 9
    load_model(output)


def test_where_nothing_is_left_to_learn_that_is_said(scene, tmp_path):
    output, said = tmp_path / "m.pt", []
    learnt(scene, 9, output=output, say=said.append)
    assert not any("nothing is left" in sentence for sentence in said)
    assert any("the validation error is that of the transport function" in sentence for sentence in said)
    learnt(scene, 9, output=output, resume=True, say=said.append)
    assert any("nothing is left to learn: it had 9 steps" in sentence for sentence in said)


def test_a_model_keeps_every_tenth_line_the_first_and_the_last(rough_scene):
    rows = list(range(1, 24))
    assert every_tenth(rows) == [1, 11, 21, 23]
    assert every_tenth(rows[:21]) == [1, 11, 21]
    assert every_tenth(rows[:1]) == [1]
    assert every_tenth([]) == []
    training = learnt(rough_scene, 13, learning=EAGER).metadata["training"]
    assert len(training["validation_vs_time"]) == 3
    assert training["validation_vs_time"][-1][0] == training["seconds"]
    assert training["validation_of"] == "coefficients"


def test_resuming_needs_a_sound_state_of_the_same_run(scene, tmp_path):
    output = tmp_path / "m.pt"
    with pytest.raises(ModelError, match=r"m\.train\.pt: not found"):
        learnt(scene, 10, output=output, resume=True)
    state_path(output).write_bytes(b"not a state")
    with pytest.raises(ModelError, match="not a readable training state"):
        learnt(scene, 10, output=output, resume=True)
    torch.save({"scene": "another"}, state_path(output))
    with pytest.raises(ModelError, match="belongs to another scene"):
        learnt(scene, 10, output=output, resume=True)
    torch.save({"scene": scene.content_hash}, state_path(output))
    with pytest.raises(ModelError, match="is of version None"):
        learnt(scene, 10, output=output, resume=True)
    with pytest.raises(QueryError, match="resume needs the output"):
        learnt(scene, 10, resume=True)
    learnt(scene, 2, output=output, learning=EAGER)
    state = torch.load(state_path(output), weights_only=True)
    torch.save({**state, "begun": {**state["begun"], "interior": "another grid"}}, state_path(output))
    with pytest.raises(ModelError, match="begun with interior 'another grid'"):
        learnt(scene, 10, output=output, resume=True)
    torch.save(state, state_path(output))
    with pytest.raises(ModelError, match="begun with seed 1, asked for is 2"):
        learnt(scene, 10, output=output, resume=True, seed=2)
    with pytest.raises(ModelError, match="begun with network width 32, asked for is 16"):
        learnt(scene, 10, output=output, resume=True, settings=dataclasses.replace(SMALL, width=16))
    with pytest.raises(ModelError, match="begun with synchronous False"):
        learnt(scene, 10, output=output, resume=True, synchronous=True)


def test_lines_of_progress_say_who_waited_and_who_walked(scene):
    beside, in_turn = [], []
    lively = dataclasses.replace(EAGER, report_every=0.02)
    learnt(scene, 40, progress=beside.append, learning=lively)
    learnt(scene, 40, progress=in_turn.append, learning=lively, synchronous=True)
    for rows in (beside, in_turn):
        assert rows[-1].step == 40
        assert rows[-1].share == 1.0
        assert all(0.0 <= row.waited <= 1.0 and 0.0 <= row.walking <= 1.0 for row in rows)
        assert [row.walks for row in rows] == sorted(row.walks for row in rows)
        assert rows[-1].walks > 0
    assert beside[0].waited > 0.0  # the first fill
    # In turns each row is learnt from once: 40 steps of 128 rows, 512 a block.
    assert in_turn[-1].walks == 40 * 128


def test_what_breaks_the_renderer_reaches_the_learner(scene):
    walks = ValueTracer(prepare(scene), Box(np.zeros(3), 1.0), STREAM, seed=0)

    def broken(first, count):
        raise MemoryError("no room to walk")

    walks.render = broken
    renderer = BackgroundRenderer(walks, STREAM, threads=1, least=10)
    with pytest.raises(MemoryError, match="no room to walk"):
        renderer.start()
    with pytest.raises(MemoryError, match="no room to walk"):
        renderer.draw(1, np.random.default_rng(0))
    renderer.stop()


def numbered(block):
    numbers = np.arange(10) + 10 * block
    return Batch(np.repeat(numbers[:, None], 12, axis=1).astype(np.float32), numbers)


def test_blocks_are_passed_over_as_often_as_asked_and_shuffled_anew():
    rows = ShuffledRows(numbered, rows=10, passes=3, seed=1)
    drawn = np.concatenate([rows.draw(7).numbers for _ in range(10)])[:60].reshape(6, 10)
    np.testing.assert_array_equal(np.sort(drawn, axis=1), np.repeat([np.arange(10), np.arange(10, 20)], 3, axis=0))
    assert len({tuple(turn % 10) for turn in drawn}) == 6
    forever = ShuffledRows(numbered, rows=10, passes=None, seed=1)
    assert forever.draw(95).numbers.max() == 9


def test_blocks_go_on_from_any_row():
    whole = ShuffledRows(numbered, rows=10, passes=2, seed=1).draw(50)
    rest = ShuffledRows(numbered, rows=10, passes=2, seed=1, drawn=33).draw(17)
    np.testing.assert_array_equal(whole.numbers[33:], rest.numbers)
    np.testing.assert_array_equal(whole.rows[33:], rest.rows)


def test_a_block_made_again_is_not_walked_twice(scene):
    settings = StreamSettings(queries_a_batch=8, directions=2, walks=3)
    walks = ValueTracer(prepare(scene), Box(np.zeros(3), 1.0), settings, seed=0)
    source = AlternatingRenderer(walks, settings, threads=1, seed=0)
    source.draw(20, np.random.default_rng(0))
    assert source.done()[:2] == SourceStatistics(72, 24, 0.0)[:2]
    again = AlternatingRenderer(walks, settings, threads=1, seed=0, state=source.state())
    again.draw(4, np.random.default_rng(0))
    assert again.done()[:2] == (72, 24)
