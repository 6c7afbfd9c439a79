"""Training runs: resuming, synchronous runs that repeat to the last bit, renderers and progress reports."""

import dataclasses
import math
import threading
import time

import numpy as np
import pytest
import torch

from formats.errors import ModelError, QueryError, StorageError
from prt_bake.network.bssrdf import load_model
from prt_bake.network.file_names import state_path
from prt_bake.tracer.prepared import prepare
from prt_bake.trainer import cores, run
from prt_bake.trainer.budget import Budget
from prt_bake.trainer.history import every_tenth
from prt_bake.trainer.resume import write_state
from prt_bake.trainer.run import Run
from prt_bake.trainer.samples.repeatable import AlternatingRenderer, ShuffledRows
from prt_bake.trainer.samples.rows import Batch, Box, StreamSettings, ValueTracer, row_tracer
from prt_bake.trainer.samples.stream import BackgroundRenderer
from prt_bake.trainer.training_data import PathTracedData, box_of
from tests.trainer.small_training import LEARNING, SMALL, STREAM, make_scene, train_small

EAGER = dataclasses.replace(LEARNING, report_every=0.0, checkpoint_every=0.0, held_out_queries=16, held_out_walks=16)


class Killed(Exception):
    """Ends a run like a killed process."""


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return make_scene(tmp_path_factory.mktemp("scene"))


@pytest.fixture(scope="module")
def rough_scene(tmp_path_factory):
    return make_scene(tmp_path_factory.mktemp("rough"), eta=1.3, roughness=0.5)


def weights(network):
    return {name: tensor.numpy().tobytes() for name, tensor in network.state_dict().items()}


def checkpoint_weights(output):
    """The bytes of the weights and of their average in the checkpoint beside a model, before rounding."""
    learner = torch.load(state_path(output), weights_only=True)["learner"]
    return {
        (part, name): learner[part][name].numpy().tobytes() for part in ("network", "average") for name in learner[part]
    }


def train_until_killed(scene, step, output, **arguments):
    """Train until `step` and end as if killed, with a checkpoint after each earlier step."""

    def die(report):
        if report.step >= step:
            raise Killed

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run, "_SHARE_OF_SAVES", math.inf)
        with pytest.raises(Killed):
            train_small(scene, 24, output=output, progress=die, **arguments)


def test_synchronous_runs_repeat_to_the_last_bit(scene):
    settings = {"synchronous": True, "learning": EAGER}
    first, second = train_small(scene, 24, **settings), train_small(scene, 24, **settings)
    assert weights(first) == weights(second)
    assert weights(first) != weights(train_small(scene, 24, seed=2, **settings))


@pytest.mark.parametrize(("step", "name"), [(7, "scene"), (23, "scene"), (7, "rough_scene")])
def test_a_killed_synchronous_run_resumes_to_the_same_bits(request, tmp_path, step, name):
    """From values, and behind a rough interface from exits, where the learner also draws random directions."""
    scene = request.getfixturevalue(name)
    # 128 rows per step, 500 per block, two passes: the runs are killed in the first block and in a later one.
    settings = {
        "synchronous": True,
        "learning": EAGER,
        "stream": dataclasses.replace(STREAM, queries_a_batch=500, reuse=2),
    }
    train_until_killed(scene, step, tmp_path / "m.pt", **settings)
    assert torch.load(state_path(tmp_path / "m.pt"), weights_only=True)["learner"]["step"] == step - 1
    resumed = train_small(scene, 24, output=tmp_path / "m.pt", resume=True, **settings)
    undisturbed = train_small(scene, 24, output=tmp_path / "undisturbed.pt", **settings)
    assert weights(resumed) == weights(undisturbed)
    assert checkpoint_weights(tmp_path / "m.pt") == checkpoint_weights(tmp_path / "undisturbed.pt")
    for name in ("steps", "walks"):
        assert resumed.metadata["training"][name] == undisturbed.metadata["training"][name]


def test_a_run_killed_before_its_first_checkpoint_leaves_nothing(scene, tmp_path):
    train_until_killed(scene, 1, tmp_path / "m.pt", learning=EAGER)
    with pytest.raises(ModelError, match="nothing to resume"):
        train_small(scene, 24, output=tmp_path / "m.pt", resume=True)


def test_synchronous_runs_refuse_to_resume_with_other_settings(scene, tmp_path):
    train_small(scene, 2, output=tmp_path / "m.pt", synchronous=True, learning=EAGER)
    with pytest.raises(ModelError, match="began with stream reuse 1, requested is 2"):
        train_small(
            scene,
            4,
            output=tmp_path / "m.pt",
            synchronous=True,
            resume=True,
            learning=EAGER,
            stream=dataclasses.replace(STREAM, reuse=2),
        )


def test_synchronous_runs_do_not_depend_on_the_number_of_cores(rough_scene, monkeypatch):
    results = []
    for count in (1, 4):
        monkeypatch.setattr(cores, "available_cores", lambda count=count: count)
        results.append(weights(train_small(rough_scene, 12, synchronous=True, learning=EAGER)))
    assert results[0] == results[1]


def test_synchronous_runs_need_steps(scene):
    with pytest.raises(QueryError, match="synchronous needs steps"):
        train_small(scene, None, synchronous=True)


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


def test_an_unknown_device_is_refused(scene):
    assert cores.select_device("cpu") == "cpu"
    assert cores.select_device("auto") == ("cuda" if torch.cuda.is_available() else "cpu")
    with pytest.raises(QueryError, match="'tpu' is not available"):
        train_small(scene, 1, device="tpu")


def test_a_concurrent_run_resumes_where_it_stopped(scene, tmp_path):
    output = tmp_path / "m.pt"
    train_small(scene, 60, output=output)
    state = torch.load(state_path(output), weights_only=True)
    longer = train_small(scene, 100, output=output, resume=True)
    training = longer.metadata["training"]
    assert state["learner"]["step"] == 60
    assert training["steps"] == 100
    assert training["walks"] > state["source"]["walks"]
    assert training["seconds"] > state["seconds"]
    after = torch.load(state_path(output), weights_only=True)
    assert after["source"]["next_query"] > state["source"]["next_query"]
    moments = [each["learner"]["optimizers"][0]["state"][0]["step"] for each in (state, after)]
    assert moments == [60, 100]
    assert len(after["history"]) > len(state["history"])


def test_the_model_is_rounded_and_the_checkpoint_is_not(scene, tmp_path):
    """The model has weights in float16, as it was measured; the checkpoint has them in full precision."""
    network = train_small(scene, 24, output=tmp_path / "m.pt", synchronous=True)
    assert weights(load_model(tmp_path / "m.pt")) == weights(network)
    assert all(torch.equal(weight.half().float(), weight) for weight in network.parameters())
    average = torch.load(state_path(tmp_path / "m.pt"), weights_only=True)["learner"]["average"]
    assert not torch.equal(average["output.weight"].half().float(), average["output.weight"])


def test_a_killed_concurrent_run_resumes_from_its_last_checkpoint(scene, tmp_path):
    output = tmp_path / "m.pt"
    train_until_killed(scene, 9, output, learning=EAGER)
    assert torch.load(state_path(output), weights_only=True)["learner"]["step"] == 8
    assert train_small(scene, 24, output=output, resume=True).metadata["training"]["steps"] == 24


def test_the_model_is_saved_before_it_is_measured(scene, tmp_path, monkeypatch):
    output = tmp_path / "m.pt"

    def killed(*_):
        raise Killed

    monkeypatch.setattr(PathTracedData, "errors", killed)
    with pytest.raises(Killed):
        train_small(scene, 9, output=output)
    assert torch.load(state_path(output), weights_only=True)["learner"]["step"] == 9
    assert load_model(output).metadata["training"]["stopped"]


def test_a_finished_run_without_anything_left_keeps_its_model(scene, tmp_path):
    """Low bands and errors of another, shorter time would be worse."""
    output = tmp_path / "m.pt"
    train_small(scene, 9, output=output)
    before = output.read_bytes()
    again = train_small(scene, 9, output=output, resume=True)
    assert output.read_bytes() == before
    assert again.metadata["training"]["steps"] == 9
    assert again.surface is not None or not again.settings.tells_normal


def test_a_run_whose_time_is_over_has_nothing_left():
    """Although its learning alone took less than the part of the time that it gets at least."""
    run = object.__new__(Run)
    run.steps, run.seconds, run.budget = None, 9.0, Budget(1.0)
    assert not run.nothing_left()
    run.budget.earlier = 61.0
    assert run.budget.learning(9.0) > 0.0
    assert run.nothing_left()


def test_a_full_disk_is_named_when_a_checkpoint_is_written(tmp_path, monkeypatch):
    def fails(*_):
        raise RuntimeError("PytorchStreamWriter failed writing file data/0")

    monkeypatch.setattr(torch, "save", fails)
    with pytest.raises(StorageError, match=r"m\.train\.pt: the checkpoint cannot be written.* disk is full"):
        write_state(tmp_path / "m.pt", {})
    assert not list(tmp_path.iterdir())


def test_resuming_a_finished_run_says_that_nothing_is_left(scene, tmp_path):
    output, sentences = tmp_path / "m.pt", []
    train_small(scene, 9, output=output, say=sentences.append)
    assert not any("nothing is left" in sentence for sentence in sentences)
    assert any("the validation error is that of the transport function" in sentence for sentence in sentences)
    train_small(scene, 9, output=output, resume=True, say=sentences.append)
    assert any("nothing is left to learn: it already had 9 steps" in sentence for sentence in sentences)


def test_a_model_keeps_every_tenth_progress_report_the_first_and_the_last(rough_scene):
    reports = list(range(1, 24))
    assert every_tenth(reports) == [1, 11, 21, 23]
    assert every_tenth(reports[:21]) == [1, 11, 21]
    assert every_tenth(reports[:1]) == [1]
    assert every_tenth([]) == []
    training = train_small(rough_scene, 13, learning=EAGER).metadata["training"]
    assert len(training["validation_vs_time"]) == 3
    assert training["validation_vs_time"][-1][0] == training["seconds"]
    assert training["validation_of"] == "coefficients"


def test_resuming_needs_an_intact_checkpoint_of_the_same_run(scene, tmp_path):
    output = tmp_path / "m.pt"
    with pytest.raises(ModelError, match=r"m\.train\.pt: not found"):
        train_small(scene, 10, output=output, resume=True)
    state_path(output).write_bytes(b"not a state")
    with pytest.raises(ModelError, match="not a readable training state"):
        train_small(scene, 10, output=output, resume=True)
    torch.save({"scene": "another"}, state_path(output))
    with pytest.raises(ModelError, match="belongs to another scene"):
        train_small(scene, 10, output=output, resume=True)
    torch.save({"scene": scene.content_hash}, state_path(output))
    with pytest.raises(ModelError, match="has version None"):
        train_small(scene, 10, output=output, resume=True)
    state_path(output).write_bytes(state_path(output).read_bytes().replace(b"scene", b"scenf"))
    with pytest.raises(ModelError, match=r"m\.train\.pt: the entry .*data\.pkl is damaged"):
        train_small(scene, 10, output=output, resume=True)
    with pytest.raises(QueryError, match="resume needs output"):
        train_small(scene, 10, resume=True)
    train_small(scene, 2, output=output, learning=EAGER)
    state = torch.load(state_path(output), weights_only=True)
    torch.save({**state, "begun": {**state["begun"], "interior": "another grid"}}, state_path(output))
    with pytest.raises(ModelError, match="began with interior 'another grid'"):
        train_small(scene, 10, output=output, resume=True)
    torch.save(state, state_path(output))
    with pytest.raises(ModelError, match="began with seed 1, requested is 2"):
        train_small(scene, 10, output=output, resume=True, seed=2)
    with pytest.raises(ModelError, match="began with network width 32, requested is 16"):
        train_small(scene, 10, output=output, resume=True, settings=dataclasses.replace(SMALL, width=16))
    with pytest.raises(ModelError, match="began with synchronous False"):
        train_small(scene, 10, output=output, resume=True, synchronous=True)


def test_progress_reports_count_waiting_and_walking(scene):
    concurrent, synchronous = [], []
    frequent = dataclasses.replace(EAGER, report_every=0.02)
    train_small(scene, 40, progress=concurrent.append, learning=frequent)
    train_small(scene, 40, progress=synchronous.append, learning=frequent, synchronous=True)
    for reports in (concurrent, synchronous):
        assert reports[-1].step == 40
        assert reports[-1].share == 1.0
        assert all(0.0 <= report.waited <= 1.0 and 0.0 <= report.walking <= 1.0 for report in reports)
        assert [report.walks for report in reports] == sorted(report.walks for report in reports)
        assert reports[-1].walks > 0
    assert concurrent[0].waited > 0.0  # the first fill
    # A synchronous run uses each row once: 40 steps of 128 rows, 512 per block.
    assert synchronous[-1].walks == 40 * 128 * STREAM.exits


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
