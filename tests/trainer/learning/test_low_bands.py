"""Fitting low bands: an unbiased loss, passes over all queries, and which low bands a run keeps."""

import itertools
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from formats.errors import ModelError, QueryError
from formats.scene import Scene
from prt_bake.mathematics import sh
from prt_bake.network.bssrdf import PRESETS, NetworkSettings, NeuralBSSRDF, load_model
from prt_bake.network.file_names import state_path
from prt_bake.trainer import run as run_module
from prt_bake.trainer.learning import correction, low_bands
from prt_bake.trainer.learning.learner import LearningSettings
from prt_bake.trainer.learning.low_bands import fit_low_bands, orders
from prt_bake.trainer.learning.objective import low_loss
from prt_bake.trainer.run import Run
from prt_bake.trainer.samples.rows import OUTGOING, POSITION
from prt_bake.trainer.samples.traced import Traced, TracedQueries, mean_coefficients
from prt_bake.trainer.train import train
from tests.network import WITHOUT_MESH
from tests.network.test_lobes import glass_ball
from tests.network.test_low_bands import SETTINGS, network
from tests.trainer.learning.test_learner import ALBEDO, exits, nodes, sphere_mean, transport, uniform_directions
from tests.trainer.small_training import LEARNING, STREAM, make_scene

pytestmark = WITHOUT_MESH
SPHERE = 4.0 * np.pi
TRUTH = SPHERE * sphere_mean(sh.evaluate(nodes(), 2)[:, :, None] * transport(nodes())[:, None])
"""a_lm [9,3] of the transport of `tests.trainer.learning.test_learner`."""
_OF_LOW_BANDS = "low", "correction"
SMALL = replace(
    PRESETS["measured"], features=12, width=16, ray_samples=4, grid_places=4, lobes=0, low_width=12, low_layers=3
)
QUICK = replace(LEARNING, batch=64, low_batch=64, held_out_queries=16, held_out_walks=16)


def queries(count: int, walks: int, generator: np.random.Generator, scale: float = 1.0) -> Traced:
    """Queries anywhere in the box, all of whose walks follow `transport`."""
    made = TracedQueries()
    directions = exits(count * walks, generator).reshape(count, walks, 3)
    views = np.concatenate([generator.random((count, 3)), uniform_directions(count, generator)], axis=1)
    made.add(0, views, mean_coefficients(directions, np.broadcast_to(scale * ALBEDO, directions.shape)))
    found = made.joined()
    assert found is not None
    return found


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return make_scene(tmp_path_factory.mktemp("scene"), eta=1.3, roughness=0.3)


def trained(scene: Scene, steps: int | None, settings: NetworkSettings = SMALL, **arguments: Any) -> NeuralBSSRDF:
    chosen = {"settings": settings, "learning": QUICK, "stream": STREAM, "seed": 1}
    return train(scene, steps=steps, **{**chosen, **arguments})


def other_layers(made: NeuralBSSRDF) -> dict[str, torch.Tensor]:
    return {name: weights for name, weights in made.named_parameters() if name.split(".")[0] not in _OF_LOW_BANDS}


def test_the_loss_is_the_squared_distance_plus_a_constant() -> None:
    """Differences of the mean loss at several coefficients are those of the distances, within 4 standard errors."""
    generator = np.random.default_rng(1)
    estimates = queries(100_000, 4, generator).coefficients(slice(None))

    def losses(coefficients: np.ndarray) -> np.ndarray:
        return low_loss(torch.from_numpy(coefficients).float().expand(estimates.shape), estimates).double().numpy()

    at_truth = losses(TRUTH)
    for offset in generator.normal(size=(3, 9, 3)):
        difference = losses(TRUTH + 0.1 * offset) - at_truth
        expected = np.sum(np.mean((0.1 * offset) ** 2, axis=1)) / SPHERE
        error = difference.std() / np.sqrt(len(difference))
        assert abs(difference.mean() - expected) < 4.0 * error


@pytest.mark.parametrize("scale", [1.0, 1e3])
@pytest.mark.parametrize("threads", [0, 2])
def test_a_fit_finds_what_walks_say(scale: float, threads: int) -> None:
    generator = np.random.default_rng(2)
    made = NeuralBSSRDF(SETTINGS, output_scale=0.7 * scale, interior=glass_ball(1.4))
    learning, shares = LearningSettings(low_batch=32), list[float]()
    fit_low_bands(made, queries(3000, 16, generator, scale), learning, 0, threads, steps=400, follow=shares.append)
    np.testing.assert_allclose(shares, np.arange(400) / 400)
    views = queries(200, 1, generator).views
    with torch.no_grad():
        found = made.low_coefficients(views[:, POSITION], views[:, OUTGOING])
    off = np.linalg.norm(found.numpy() * made.output_scale / scale - TRUTH, axis=(1, 2)) / np.linalg.norm(TRUTH)
    assert np.sqrt(np.mean(off**2)) < 0.05


def test_a_fit_is_repeated_by_its_seed_on_any_number_of_threads() -> None:
    traced, learning = queries(100, 4, np.random.default_rng(3)), LearningSettings(low_batch=16)
    weights = []
    for seed, threads in ((0, 0), (0, 3), (1, 0)):
        made = network()
        fit_low_bands(made, traced, learning, seed, threads, steps=9)
        assert made.low is not None
        weights.append(made.low.output.weight)
    assert torch.equal(weights[0], weights[1])
    assert not torch.equal(weights[0], weights[2])


def test_a_fit_ends_after_eight_passes_or_with_the_time(monkeypatch: pytest.MonkeyPatch) -> None:
    traced, shares = queries(100, 4, np.random.default_rng(4)), list[float]()
    fit_low_bands(network(), traced, LearningSettings(low_batch=32), 0, 0, follow=shares.append)
    assert len(shares) == 8 * 3
    shares.clear()
    fit_low_bands(network(), traced, LearningSettings(low_batch=1000), 0, 0, follow=shares.append)
    assert len(shares) == 8
    shares.clear()
    seconds = itertools.count()
    monkeypatch.setattr(low_bands, "time", SimpleNamespace(perf_counter=lambda: next(seconds)))
    fit_low_bands(network(), traced, LearningSettings(low_batch=32), 0, 0, seconds=0.0, follow=shares.append)
    assert not shares
    fit_low_bands(network(), traced, LearningSettings(low_batch=32), 0, 0, seconds=5.0, follow=shares.append)
    np.testing.assert_allclose(shares, [0.2, 0.4, 0.6, 0.8])


def test_many_queries_have_larger_batches_at_a_higher_rate_in_more_passes(monkeypatch: pytest.MonkeyPatch) -> None:
    requested = list[tuple[int, float, int]]()

    def fit(_low: Any, _average: Any, _batches: Any, settings: LearningSettings, most: int, *_rest: Any) -> None:
        requested.append((settings.batch, settings.rate, most))

    monkeypatch.setattr(low_bands, "fit_layers", fit)
    monkeypatch.setattr(low_bands, "_MANY", 100)
    for count in (99, 100):
        traced = queries(count, 1, np.random.default_rng(8))
        fit_low_bands(network(), traced, LearningSettings(low_batch=16, rate=0.02), 0, 0)
    assert requested == [(16, 0.02, 8 * 6), (32, pytest.approx(0.03), 16 * 3)]


def test_weights_without_gradient_decay_as_for_several_passes() -> None:
    """By a rate of their own, whatever that of the other layers is."""
    made, traced = network(), TracedQueries()
    assert made.low is not None
    with torch.no_grad():
        made.low.output.weight.zero_()
    traced.add(0, queries(50, 1, np.random.default_rng(6)).views, np.zeros((50, 27)))
    dark = traced.joined()
    assert dark is not None
    before = [weights.detach().clone() for weights in made.low.parameters()]
    learning = LearningSettings(rate=0.1, warm_up=0.0, decay=0.9)
    fit_low_bands(made, dark, learning, 0, 0, steps=1)
    for weights, earlier in zip(made.low.parameters(), before, strict=True):
        torch.testing.assert_close(weights, earlier * (1.0 - 0.1 * 0.15))


def test_a_fit_that_is_ended_early_keeps_its_average() -> None:
    made, traced = network(), queries(100, 4, np.random.default_rng(5))
    assert made.low is not None
    last, before = made.low, made.low.output.weight.detach().clone()

    def end(share: float) -> None:
        if share > 0.5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit_low_bands(made, traced, LearningSettings(low_batch=16), 0, 1, steps=20, follow=end)
    assert made.low is not None
    for other in (before, last.output.weight):
        assert not torch.equal(made.low.output.weight, other)
    assert made.low.output.weight.isfinite().all()


@pytest.mark.parametrize(("count", "batch"), [(10, 3), (9, 3), (4, 4)])
def test_every_pass_has_each_query_once_but_for_an_incomplete_batch(count: int, batch: int) -> None:
    in_a_pass = count // batch
    found = [some.numpy() for some in itertools.islice(orders(count, batch, 0), 6 * in_a_pass)]
    passes = [np.concatenate(found[n : n + in_a_pass]) for n in range(0, len(found), in_a_pass)]
    for order in passes:
        assert len(np.unique(order)) == len(order) == in_a_pass * batch
    assert not np.array_equal(passes[0], passes[1])
    assert set(np.concatenate(passes)) == set(range(count))


def test_other_layers_learn_the_same_with_low_bands_and_without(scene: Scene) -> None:
    both = trained(scene, 4, synchronous=True)
    plain = trained(scene, 4, replace(SMALL, low_width=0), synchronous=True)
    for name, weights in plain.named_parameters():
        assert torch.equal(weights, both.get_parameter(name)), name
    assert plain.low is plain.correction is None
    assert both.correction is not None
    for weights in both.parameters():
        assert torch.equal(weights.half().float(), weights)


class Killed(Exception):
    """Ends a run like a killed process."""


@pytest.mark.parametrize("name", ["learning", "low bands"])
def test_a_killed_run_resumes_to_the_same_low_bands(scene: Scene, tmp_path: Path, name: str) -> None:
    """Of all queries, those before it was killed included."""
    settings: dict[str, Any] = {
        "synchronous": True,
        "learning": replace(QUICK, checkpoint_every=0.0, report_every=0.0),
    }
    stream = replace(STREAM, queries_a_batch=100)

    def die(part: str, share: float) -> None:
        if part == name == "low bands" and share > 0.5:
            raise Killed

    def die_learning(report: Any) -> None:
        if name == "learning" and report.step == 12:
            raise Killed

    output = tmp_path / "m.pt"
    with pytest.raises(Killed):
        trained(scene, 20, output=output, part=die, progress=die_learning, stream=stream, **settings)
    resumed = trained(scene, 20, output=output, resume=True, stream=stream, **settings)
    straight = trained(scene, 20, stream=stream, **settings)
    assert straight.low is not None
    for key, weights in straight.named_parameters():
        assert torch.equal(weights, resumed.get_parameter(key)), key


def test_a_resumed_run_does_not_lose_its_low_bands(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """If the time that is left is too short for better ones, as those of a run by minutes may be."""
    output = tmp_path / "m.pt"
    first = trained(scene, 40, output=output)
    assert first.low is not None
    before = torch.load(state_path(output), weights_only=True)
    assert before["low"] is not None
    monkeypatch.setattr(Run, "_fit_low_bands", lambda run, made: made.low.output.weight.data.fill_(9.0))
    again = trained(scene, 41, output=output, resume=True)
    assert again.low is not None
    assert torch.equal(again.low.output.weight, first.low.output.weight)


@pytest.mark.parametrize("best", ["fitted", "earlier", "none"])
def test_a_run_keeps_the_best(best: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def fit(run: Any, made: Any) -> None:
        with torch.no_grad():
            made.low.output.bias.fill_(2.0)

    def kind(made: NeuralBSSRDF) -> str:
        return "none" if made.low is None else "fitted" if made.low.output.bias[0].item() == 2.0 else "earlier"

    def correct(run: Any, made: Any) -> None:
        made.metadata["corrected"] = kind(made)

    monkeypatch.setattr(Run, "_fit_low_bands", fit)
    monkeypatch.setattr(Run, "_fit_correction", correct)
    run: Any = object.__new__(Run)
    run.low, run.earlier_low, run.stopped = network().low, network(replace(SETTINGS, low_layers=4)).low, False
    run.earlier_correction, run.source = None, SimpleNamespace(traced=TracedQueries())
    run.reference = SimpleNamespace(relative_rmse=lambda made: 0.1 if kind(made) == best else 0.2)
    plain = network(replace(SETTINGS, low_width=0))
    found = run._with_low_bands(plain)
    assert kind(found) == found.metadata["corrected"] == best
    assert found.settings.low_width == (0 if best == "none" else SETTINGS.low_width)
    assert found.low is None or found.settings.low_layers == len(found.low.hidden) == (4 if best == "earlier" else 5)
    run.source = SimpleNamespace(traced=None)
    assert run._with_low_bands(plain) is plain
    run.low, run.source = None, SimpleNamespace(traced=TracedQueries())
    assert run._with_low_bands(plain) is plain


def test_low_bands_that_are_not_finite_are_not_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    run: Any = object.__new__(Run)
    run.low, run.earlier_low, run.earlier_correction, run.stopped = network().low, None, None, True
    run.reference = SimpleNamespace(relative_rmse=lambda made: 0.5 if made.low is None else float("nan"))
    run.source = SimpleNamespace(traced=TracedQueries())
    assert run._with_low_bands(network(replace(SETTINGS, low_width=0))).low is None


def test_a_run_by_time_leaves_four_tenths_of_it_for_low_bands_and_correction() -> None:
    run: Any = object.__new__(Run)
    run.budget = SimpleNamespace(learning=lambda learned: 100.0 - learned)
    for low, traced, length in ((network().low, TracedQueries(), 68.0), (None, TracedQueries(), 100.0)):
        run.low, run.source = low, SimpleNamespace(traced=traced)
        run._set_length(20.0)
        assert run.length == pytest.approx(length)
    run.low, run.source = network().low, SimpleNamespace(traced=None)
    run._set_length(20.0)
    assert run.length == pytest.approx(100.0)


def test_both_fits_share_the_time_that_learning_leaves(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three quarters for the low bands; what they do not need, for the correction."""
    run, requested = object.__new__(Run), list[tuple[float, int | None]]()
    made: Any = run
    made.budget = SimpleNamespace(learning=lambda learned: 100.0 - learned)
    made.source = SimpleNamespace(traced=SimpleNamespace(joined=lambda: queries(5, 1, np.random.default_rng(7))))
    made.learner = SimpleNamespace(network=network(), step=3)
    made.data = SimpleNamespace(learner_threads=lambda *_: 1)
    made.seconds, made.low_seconds, made.stopped, made.synchronous = 20.0, 0.0, False, False
    made.learning, made.seed, made.part, made.steps = QUICK, 0, lambda *_: None, None

    def fit(*_arguments: Any, steps: int | None, seconds: float, follow: Any) -> None:
        requested.append((seconds, steps))
        run.low_seconds += 30.0

    monkeypatch.setattr(run_module, "time", SimpleNamespace(perf_counter=lambda: 0.0))
    monkeypatch.setattr(low_bands, "fit_low_bands", fit)
    monkeypatch.setattr(correction, "fit_correction", fit)
    run._fit_low_bands(network())
    run._fit_correction(network())
    np.testing.assert_allclose([seconds for seconds, _ in requested], [60.0, 50.0])
    made.steps = 3
    run._fit_low_bands(network())
    run._fit_correction(network())
    assert [steps for _, steps in requested] == [None, None, 12, 3]


def test_a_run_reports_the_fit_and_can_be_stopped_in_it(scene: Scene) -> None:
    parts: dict[str, list[float]] = {}

    def part(name: str, share: float) -> None:
        parts.setdefault(name, []).append(share)

    made = trained(scene, 3, part=part)
    of_low_bands, of_correction = 0.75 * np.arange(12) / 12, 0.75 + 0.25 * np.arange(3) / 3
    np.testing.assert_allclose(parts["low bands"], [*of_low_bands, *of_correction])
    history = made.metadata["training"]["validation_vs_time"]
    assert len(history) == 2
    for steps in (3, 13):  # in the fit of the low bands, and in that of the correction
        parts.clear()
        stopped = trained(
            scene,
            3,
            synchronous=True,
            part=part,
            stop=lambda steps=steps: len(parts.get("low bands", [])) >= steps,
        )
        assert len(parts["low bands"]) == steps
        assert stopped.metadata["training"]["stopped"]
        assert "relative_rmse" not in stopped.metadata["training"]


def test_a_run_that_is_stopped_before_has_no_low_bands(scene: Scene, tmp_path: Path) -> None:
    parts, asked = list[str](), itertools.count()

    def part(name: str, share: float) -> None:
        parts.append(name)

    stopped = trained(scene, 30, part=part, output=tmp_path / "m.pt", stop=lambda: next(asked) == 5)
    assert "low bands" not in parts
    for made in (stopped, load_model(tmp_path / "m.pt")):
        assert isinstance(made, NeuralBSSRDF)
        assert (made.low, made.settings.low_width) == (None, 0)


def test_only_low_bands_change_if_that_is_requested(scene: Scene, tmp_path: Path) -> None:
    start, output = trained(scene, 4, synchronous=True), tmp_path / "m.pt"
    made = trained(scene, 40, start=start, only_low_bands=True, synchronous=True, output=output)
    for name, weights in other_layers(start).items():
        assert torch.equal(weights, made.get_parameter(name)), name
    assert made.low is not None
    stream = made.metadata["training"]["stream"]
    assert stream["least_exits"] == stream["exits"] == 64
    with pytest.raises(ModelError, match="began with only low bands True, requested is False"):
        trained(scene, 80, start=start, synchronous=True, output=output, resume=True)


@pytest.mark.parametrize(("layers", "axes"), [(3, True), (5, True), (3, False), (5, False)])
def test_a_short_run_keeps_the_low_bands_of_the_start(scene: Scene, layers: int, axes: bool) -> None:
    """Also those of another depth, which it does not learn from, and those without lobes."""
    start = trained(scene, 40, replace(SMALL, low_axes=axes), synchronous=True)
    settings = replace(SMALL, low_layers=layers)
    quick = replace(QUICK, rate=1e-9)
    made = trained(scene, 1, settings, start=start, only_low_bands=True, synchronous=True, learning=quick)
    assert made.low is not None
    assert made.settings.low_layers == len(made.low.hidden) == 3
    assert made.settings.low_axes
    x, eye = torch.from_numpy(scene.mesh.positions), torch.from_numpy(scene.mesh.normals)
    with torch.no_grad():
        found, before = (some.low_coefficients(x, eye) for some in (made, start))
    torch.testing.assert_close(found, before, rtol=1e-3, atol=2e-4 * float(before.abs().max()))


def test_only_low_bands_needs_some_to_learn(scene: Scene, tmp_path: Path) -> None:
    start = trained(scene, 1, synchronous=True)
    requests: list[tuple[Scene, dict[str, Any], str]] = [
        (scene, {}, "only_low_bands: needs start"),
        (scene, {"start": start, "samples": "samples.h5"}, "train without samples"),
        (scene, {"start": start, "stream": replace(STREAM, rays="values")}, "low bands learn from exits of paths"),
        (make_scene(tmp_path), {"start": start}, "its networks have no low bands"),
    ]
    for some, arguments, fault in requests:
        with pytest.raises(QueryError, match=fault):
            trained(some, 2, only_low_bands=True, **arguments)
