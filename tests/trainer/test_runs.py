"""Training runs: resuming, synchronous runs that repeat to the last bit, and progress reports."""

import dataclasses
import math

import pytest
import torch

from formats.errors import ModelError, QueryError, StorageError
from prt_bake.network.bssrdf import load_model
from prt_bake.network.file_names import state_path
from prt_bake.trainer import cores, run
from prt_bake.trainer.budget import Budget
from prt_bake.trainer.history import every_tenth
from prt_bake.trainer.resume import write_state
from prt_bake.trainer.run import Run
from prt_bake.trainer.training_data import PathTracedData
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


@pytest.mark.parametrize(
    ("words", "error", "message"),
    [
        ("PytorchStreamWriter failed writing file data/0", StorageError, r"m\.train\.pt: the .* disk is full"),
        ("CUDA error: out of memory", RuntimeError, "CUDA error: out of memory"),
    ],
)
def test_a_full_disk_is_named_when_a_checkpoint_is_written(tmp_path, monkeypatch, words, error, message):
    def fails(*_):
        raise RuntimeError(words)

    monkeypatch.setattr(torch, "save", fails)
    with pytest.raises(error, match=message):
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
