"""Training on smooth scenes, from exits, and on extreme scenes."""

import dataclasses

import numpy as np
import pytest

from prt_bake.mathematics import sh
from prt_bake.network.bssrdf import NeuralBSSRDF
from prt_bake.tracer.prepared import prepare
from prt_bake.trainer.learning.learner import Learner
from prt_bake.trainer.samples.rows import CHANNELS, INCIDENT, ExitTracer, StreamSettings
from prt_bake.trainer.training_data import PathTracedData, box_of
from prt_bake.trainer.validation import hold_out_coefficients, network_coefficients, noise_free_ratio
from tests.tracer.scenes import make_scene, sphere
from tests.trainer.small_training import LEARNING, SMALL, STREAM, train_small

pytestmark = pytest.mark.statistics

BRIEF = dataclasses.replace(LEARNING, batch=64, held_out_queries=16, held_out_walks=32)


@pytest.fixture(scope="module")
def smooth(tmp_path_factory):
    return make_scene(tmp_path_factory.mktemp("smooth"), sphere(2), eta=1.4, sigma_t=3.0, albedo=[0.95, 0.8, 0.4])


def test_exits_estimate_the_coefficients(tmp_path):
    """a_lm = E[T · Y_lm(exit)] over rows of exits, without walks that cross unscattered."""
    thin = make_scene(tmp_path, sphere(2), eta=1.4, sigma_t=0.5)  # most walks cross unscattered
    settings = StreamSettings(exits=2000, kept=2000, face_share=0.0)
    batch = ExitTracer(prepare(thin), box_of(thin), settings, seed=0x7E57).render(0, 4)
    reference = hold_out_coefficients(thin, 4, 4000, 0x7E57, 64)
    rays = batch.rays.astype(np.float64)
    basis = sh.evaluate(rays[..., INCIDENT].reshape(-1, 3), 2).reshape(4, 2000, 9)
    products = basis[..., None] * rays[:, :, None, CHANNELS]
    spread = np.sqrt(products.var(axis=1) / 2000 + reference.standard_error**2)
    assert np.all(np.abs(products.mean(axis=1) - reference.mean) < 5.0 * spread + 1e-12)  # false alarm 6e-5 over 108
    np.testing.assert_array_equal(batch.numbers, np.arange(4))


def test_a_smooth_scene_trains(smooth):
    learning = dataclasses.replace(LEARNING, batch=512, held_out_queries=64, coarse_steps=0)
    network = train_small(smooth, 150, synchronous=True, learning=learning)
    fresh = hold_out_coefficients(smooth, 64, 1000, 5, 64)
    error = fresh.relative_rmse(network)
    constant = noise_free_ratio(fresh.mean.mean(axis=0), fresh.mean, fresh.standard_error)
    assert error < 0.7 * constant
    assert error < 0.4
    errors = network.metadata["training"]["relative_rmse"]
    assert errors["transport"] is None
    assert abs(errors["coefficients"] - error) < 0.3 * error


EXTREMES = {
    "white": {"albedo": 1.0, "sigma_t": 8.0},
    "nearly white, thick, rough": {"albedo": 0.9999, "sigma_t": 60.0, "eta": 1.5, "roughness": 0.3},
    "white, smooth": {"albedo": 1.0, "sigma_t": 5.0, "eta": 1.5},
    "very dark": {"albedo": 2e-4, "sigma_t": 5.0},
    "dark in one channel": {"albedo": [0.9, 0.5, 0.0], "sigma_t": 5.0},
    "black": {"albedo": 0.0, "sigma_t": 5.0},
    "black, smooth": {"albedo": 0.0, "sigma_t": 5.0, "eta": 1.5},
    "very thick": {"albedo": 0.8, "sigma_t": 5e3},
    "very thin": {"albedo": 0.8, "sigma_t": 1e-4},
    "very forward": {"albedo": 0.9, "sigma_t": 20.0, "phase_g": 0.99},
    "very forward, rough": {"albedo": 0.9, "sigma_t": 20.0, "phase_g": 0.95, "eta": 1.3, "roughness": 0.05},
}


@pytest.mark.parametrize(
    ("name", "rays"),
    [(name, "exits") for name in EXTREMES] + [(name, "values") for name in ("very dark", "very thin", "very forward")],
)
def test_extreme_scenes_train_without_nan(tmp_path, name, rays):
    scene = make_scene(tmp_path, sphere(1), **EXTREMES[name])
    learning = dataclasses.replace(BRIEF, report_every=0.0)
    reports = []
    network = train_small(
        scene,
        12,
        synchronous=True,
        learning=learning,
        stream=StreamSettings(queries_a_batch=128, rays=rays),
        progress=reports.append,
        output=tmp_path / "m.pt",
    )
    assert all(np.isfinite(report.loss) for report in reports)
    # Without light in the reference, beside its noise, the error is unknown.
    unknown = name.startswith("black") or name == "very thin"
    assert all(np.isnan(report.validation) == unknown for report in reports)
    assert unknown or all(np.isfinite(report.validation) for report in reports)
    positions = np.array(scene.mesh.positions)[:20]
    outgoing = np.asarray(scene.mesh.normals)[:20]
    assert np.isfinite(network_coefficients(network, positions, outgoing, 32)).all()


@pytest.mark.parametrize("albedo", [2e-4, 0.9])
def test_learning_does_not_depend_on_the_scale_of_the_transport(tmp_path, albedo):
    """Values of 1e-5 are learnt like values of 0.1: the error falls."""
    scene = make_scene(tmp_path, sphere(1), albedo=albedo, sigma_t=3.0)
    reports = []
    learning = dataclasses.replace(BRIEF, held_out_queries=64, report_every=0.0)
    values = dataclasses.replace(STREAM, rays="values")
    train_small(scene, 100, synchronous=True, learning=learning, stream=values, progress=reports.append)
    assert reports[-1].validation < 0.75 * reports[0].validation


def test_exits_are_learnt_with_any_number_of_uniform_directions(smooth):
    data = PathTracedData(smooth, dataclasses.replace(STREAM, queries_a_batch=64), 0, True)
    source = data.source(BRIEF, "cpu", None)
    for spread in (1, 3):
        learner = Learner(NeuralBSSRDF(SMALL, *data.box, 0.1), dataclasses.replace(BRIEF, spread=spread))
        generator = np.random.default_rng(0)
        assert np.isfinite(learner.learn(source, source.draw(100), 0.5, generator))
