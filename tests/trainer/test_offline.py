"""Files of samples: recording, the split into training, validation and test sets, and learning from them."""

import dataclasses
import functools

import numpy as np
import pytest

from formats.errors import QueryError, SamplesError
from formats.samples import SamplesHead, read_samples
from formats.samples.writer import SamplesWriter
from prt_bake.cli.shared import after_training
from prt_bake.tracer.estimate import estimate_transport
from prt_bake.tracer.prepared import prepare
from prt_bake.trainer import training_data
from prt_bake.trainer.offline import split_by_key
from prt_bake.trainer.report import picture, report
from prt_bake.trainer.samples.queries import QuerySource
from prt_bake.trainer.samples.record import query_keys, record_samples
from prt_bake.trainer.samples.rows import StreamSettings, trace_values
from prt_bake.trainer.validation import hold_out, noise_free_ratio
from tests.cli.command_line import Run
from tests.trainer.small_training import LEARNING, SMALL, make_scene, train_small

BRIEF = dataclasses.replace(LEARNING, held_out_queries=64, held_out_walks=32, report_every=0.1)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return make_scene(tmp_path_factory.mktemp("scene"))


@pytest.fixture(scope="module")
def file(scene, tmp_path_factory):
    path = tmp_path_factory.mktemp("samples") / "s.h5"
    assert record_samples(scene, path, 4000, walks=4, directions=6, seed=3) == 4000
    return path


def test_samples_are_estimates_of_their_queries(scene, file):
    samples = read_samples(file)
    some = np.arange(0, 4000, 40)
    reference = estimate_transport(
        scene, samples.positions[some], samples.outgoing[some], samples.incident[some], 512, seed=8, connections=6
    )
    difference = samples.mean[some] - reference.mean
    # The error estimate of four walks is itself uncertain, so sums over all queries are compared.
    variance = samples.standard_error[some].astype(np.float64) ** 2
    total = difference.sum(axis=(0, 1))
    spread = np.sqrt(np.sum(np.sum(samples.standard_error[some], axis=1, dtype=np.float64) ** 2, axis=0))
    assert np.all(np.abs(total) < 4.5 * spread)
    assert np.sum(difference**2) == pytest.approx(variance.sum() + np.sum(reference.standard_error**2), rel=0.35)


def test_a_longer_file_begins_with_the_shorter_one(scene, file, tmp_path):
    record_samples(scene, tmp_path / "short.h5", 50, walks=4, directions=6, seed=3)
    short, long = read_samples(tmp_path / "short.h5"), read_samples(file)
    for name in ("keys", "positions", "mean"):
        np.testing.assert_array_equal(getattr(short, name), getattr(long, name)[:50])
    assert not set(query_keys(4, np.arange(1000))) & set(long.keys)


def test_stopping_keeps_the_queries_so_far(scene, tmp_path):
    count = record_samples(scene, tmp_path / "s.h5", 4000, directions=64, walks=2, stop=lambda: True)
    found = read_samples(tmp_path / "s.h5")
    assert 0 < count < 4000
    assert (len(found.keys), found.complete) == (count, False)
    assert record_samples(scene, tmp_path / "s.h5", 8, stop=lambda: True) == 8
    assert read_samples(tmp_path / "s.h5").complete


def test_a_value_that_is_not_finite_names_its_query_and_keeps_those_before_it(scene, tmp_path, monkeypatch):
    def broken(prepared, source, queries, *more):
        mean, error = trace_values(prepared, source, queries, *more)
        mean[queries.keys == 13] = np.nan
        return mean, error

    monkeypatch.setattr("prt_bake.trainer.samples.record.trace_values", broken)
    monkeypatch.setattr("prt_bake.trainer.samples.record._VALUES_AT_ONCE", 20)
    (tmp_path / "s.h5").write_text("older")
    with pytest.raises(SamplesError, match=r"query 13 of seed 0, on face \d+ is not finite; .*s.h5 has the 10 before"):
        record_samples(scene, tmp_path / "s.h5", 40, walks=2, directions=2)
    found = read_samples(tmp_path / "s.h5")
    assert (len(found.keys), found.complete) == (10, False)
    monkeypatch.setattr("prt_bake.trainer.samples.record._VALUES_AT_ONCE", 80)
    with pytest.raises(SamplesError, match="no query was kept"):
        record_samples(scene, tmp_path / "s.h5", 40, walks=2, directions=2)
    assert len(read_samples(tmp_path / "s.h5").keys) == 10


@pytest.mark.statistics
def test_recorded_queries_are_those_of_the_trainer(scene, tmp_path):
    """With the trainer's shares of faces and edges; `stop` is also called between few long queries."""
    calls = []
    record_samples(scene, tmp_path / "s.h5", 64, walks=1 << 14, directions=8, stop=lambda: bool(calls.append(1)))
    assert len(calls) > 4
    stream = StreamSettings()
    source = QuerySource(prepare(scene), 8, 0, stream.face_share, stream.edge_share)
    found = read_samples(tmp_path / "s.h5").positions
    np.testing.assert_array_equal(found, source.draw(0, 64).positions)


def test_numbers_out_of_range_are_refused(scene, tmp_path):
    for wrong in ({"count": 0}, {"count": 1, "walks": 1}, {"count": 1, "directions": 0}):
        with pytest.raises(QueryError, match="or more, found"):
            record_samples(scene, tmp_path / "s.h5", **wrong)


def test_five_percent_validate_and_five_percent_test():
    keys = query_keys(0, np.arange(100_000))
    split = split_by_key(keys)
    np.testing.assert_array_equal(np.sum(split, axis=0), 1)
    for chosen in (split.validation, split.test):
        assert abs(chosen.mean() - 0.05) < 4.5 * np.sqrt(0.05 * 0.95 / len(keys))  # false alarm 1e-5
    # Neighbouring queries are independent.
    both = np.mean(split.test[1:] & split.test[:-1])
    assert abs(both - 0.0025) < 5 * np.sqrt(0.0025 / len(keys))


def test_a_query_is_in_the_same_set_in_any_file():
    keys = query_keys(9, np.arange(5000))
    order = np.random.default_rng(0).permutation(5000)[:700]
    for every, part in zip(split_by_key(keys), split_by_key(keys[order]), strict=True):
        np.testing.assert_array_equal(every[order], part)
    # The hash must never change: these keys were split by the first version of the program.
    np.testing.assert_array_equal(np.flatnonzero(split_by_key(keys).test)[:6], [3, 39, 61, 67, 115, 128])


def test_a_network_learns_from_a_file(scene, file, tmp_path):
    reports = []
    network = train_small(scene, 400, samples=file, learning=BRIEF, output=tmp_path / "m.pt", progress=reports.append)
    training = network.metadata["training"]
    counts = {name: training["samples"][f"{name}_queries"] for name in ("learning", "validation", "test")}
    assert sum(counts.values()) == 4000
    assert training["walks"] == 4 * counts["learning"]
    held_out = hold_out(prepare(scene), 256, 4, 64, seed=99)
    error = held_out.relative_rmse(network)
    constant = noise_free_ratio(held_out.mean.mean(axis=(0, 1)), held_out.mean, held_out.standard_error)
    assert error < 0.8 * constant
    assert training["test_relative_rmse"]["transport"] == pytest.approx(error, rel=0.35)
    assert training["test_relative_rmse"]["transport_noise"] > 0.1
    assert reports[-1].reuse == pytest.approx(400 * 128 / counts["learning"])
    assert reports[-1].walks_per_second == 0.0


def test_test_queries_are_never_learnt_from(scene, file, tmp_path):
    """A file with other values in its test set trains the same network."""
    samples = read_samples(file)
    changed = samples.mean.copy()
    changed[split_by_key(samples.keys).test] += 100.0
    with SamplesWriter(tmp_path / "s.h5", samples.head) as writer:
        writer.append(
            samples.keys, samples.positions, samples.outgoing, samples.incident, changed, samples.standard_error
        )
        writer.finish()
    first = train_small(scene, 20, samples=file, learning=BRIEF, synchronous=True)
    second = train_small(scene, 20, samples=tmp_path / "s.h5", learning=BRIEF, synchronous=True)
    for a, b in zip(first.parameters(), second.parameters(), strict=True):
        assert a.detach().numpy().tobytes() == b.detach().numpy().tobytes()
    test = [network.metadata["training"]["test_relative_rmse"]["transport"] for network in (first, second)]
    assert test[0] != test[1]


def test_a_resumed_run_continues_in_the_file(scene, file, tmp_path):
    eager = dataclasses.replace(BRIEF, report_every=0.0, checkpoint_every=0.0)

    class Killed(Exception):
        pass

    def die(report):
        if report.step == 31:
            raise Killed

    arguments = {"samples": file, "learning": eager, "synchronous": True}
    with pytest.raises(Killed):
        train_small(scene, 50, output=tmp_path / "m.pt", progress=die, **arguments)
    resumed = train_small(scene, 50, output=tmp_path / "m.pt", resume=True, **arguments)
    for a, b in zip(resumed.parameters(), train_small(scene, 50, **arguments).parameters(), strict=True):
        assert a.detach().numpy().tobytes() == b.detach().numpy().tobytes()


def test_files_that_do_not_fit_are_refused(scene, file, tmp_path):
    other = make_scene(tmp_path, eta=1.2, roughness=0.4)
    with pytest.raises(SamplesError, match="was sampled from another scene"):
        train_small(other, 1, samples=file)
    record_samples(scene, tmp_path / "few.h5", 3, walks=2, directions=1)
    with pytest.raises(SamplesError, match="none of its 3 queries is left for"):
        train_small(scene, 1, samples=tmp_path / "few.h5")
    samples = read_samples(file)
    moved = SamplesHead(**{**dataclasses.asdict(samples.head), "scene_hash": scene.content_hash})
    with SamplesWriter(tmp_path / "moved.h5", moved) as writer:
        writer.append(
            samples.keys,
            samples.positions * 1.5,
            samples.outgoing,
            samples.incident,
            samples.mean,
            samples.standard_error,
        )
        writer.finish()
    with pytest.raises(QueryError, match="expected points within"):
        train_small(scene, 1, samples=tmp_path / "moved.h5")


@pytest.fixture
def short_runs(monkeypatch):
    """Shortens training, report and importance module."""
    monkeypatch.setattr(training_data, "LearningSettings", lambda: BRIEF)
    monkeypatch.setattr(after_training, "_LEAST_SECONDS", 0.1)
    brief = functools.partial(report.report_training, queries=64, vertices=16)
    monkeypatch.setattr(report, "report_training", brief)
    monkeypatch.setattr(picture, "_SPP", 16)


@pytest.mark.statistics
@pytest.mark.usefixtures("short_runs")
def test_sample_and_train_commands_work_together(prtbake: Run, tmp_path):
    sampled = prtbake("sample", "scene.toml", "--count", 600, "-o", tmp_path / "s.h5", "--walks", 2, "--directions", 3)
    assert (sampled.code, sampled.out) == (0, f"{tmp_path}/s.h5: 600 queries of 3 directions, 1,200 paths\n")
    info = prtbake("info", tmp_path / "s.h5")
    assert "\npaths per query  2\n" in info.out
    assert prtbake("check", tmp_path / "s.h5").code == 0
    alone = ("--no-report", "--no-importance")
    trained = prtbake(
        "train", "scene.toml", "--samples", tmp_path / "s.h5", "-o", tmp_path / "m.pt", "--steps", 3, *alone
    )
    assert trained.code == 0, trained.err
    assert {path.name for path in tmp_path.iterdir()} == {"s.h5", "m.pt", "m.train.pt"}
    assert "test queries of" in trained.out
    assert "of the coefficients" in trained.out


@pytest.mark.statistics
@pytest.mark.usefixtures("short_runs")
def test_report_and_importance_follow_a_training(prtbake: Run, tmp_path):
    trained = prtbake("train", "scene.toml", "--synchronous", "-o", tmp_path / "m.pt", "--steps", 3)
    assert trained.code == 0, trained.err
    written = {path.name for path in tmp_path.iterdir()}
    assert written == {"m.pt", "m.train.pt", "m.importance.pt", "m.report.json", "m.report.html"}
    assert "KL divergence" in trained.out


def test_a_file_of_values_has_no_paths_for_low_bands(tmp_path):
    """Untrained low bands would be what bakes use."""
    scene = make_scene(tmp_path, eta=1.3, roughness=0.4)
    record_samples(scene, tmp_path / "s.h5", 2000, walks=2, directions=4)
    settings = dataclasses.replace(SMALL, light_layers=1, low_width=16)
    network = train_small(scene, 4, samples=tmp_path / "s.h5", settings=settings, learning=BRIEF)
    assert network.low is None
    assert network.settings.low_width == 0
