"""Scenes that training must come through: smooth ones, learnt from exits, and extreme ones."""

import dataclasses

import numpy as np
import pytest

from prt_bake.mathematics import sh
from prt_bake.network.bssrdf import NeuralBSSRDF
from prt_bake.tracer.prepared import prepare
from prt_bake.trainer.learner import Learner
from prt_bake.trainer.samples.rows import CHANNELS, INCIDENT, ExitTracer, StreamSettings
from prt_bake.trainer.training_data import PathTracedData, box_of
from prt_bake.trainer.validation import hold_out_coefficients, network_coefficients, noise_free_ratio
from tests.tracer.scenes import make_scene, sphere
from tests.trainer.small_training import LEARNING, SMALL, STREAM, learnt

BRIEF = dataclasses.replace(LEARNING, batch=64, held_out_queries=16, held_out_walks=32)


@pytest.fixture(scope="module")
def smooth(tmp_path_factory):
    return make_scene(tmp_path_factory.mktemp("smooth"), sphere(2), eta=1.4, sigma_t=3.0, albedo=[0.95, 0.8, 0.4])


def test_exits_carry_the_coefficients(tmp_path):
    """Rows of exits are what a_lm = E[T · Y_lm(exit)] is made of, without what met nothing."""
    thin = make_scene(tmp_path, sphere(2), eta=1.4, sigma_t=0.5)  # most walks meet nothing
    settings = StreamSettings(exits=2000, kept=2000, face_share=0.0)
    walks = ExitTracer(prepare(thin), box_of(thin), settings, seed=0x7E57)
    batch = walks.render(0, 4)
    reference = hold_out_coefficients(thin, 4, 4000, 0x7E57, 64)
    rays = batch.rays.astype(np.float64)
    basis = sh.evaluate(rays[..., INCIDENT].reshape(-1, 3), 2).reshape(4, 2000, 9)
    each = basis[..., None] * rays[:, :, None, CHANNELS]
    spread = np.sqrt(each.var(axis=1) / 2000 + reference.standard_error**2)
    assert np.all(np.abs(each.mean(axis=1) - reference.mean) < 5.0 * spread + 1e-12)  # false alarm 6e-5 over 108
    np.testing.assert_array_equal(batch.numbers, np.arange(4))


def test_a_smooth_scene_trains(smooth):
    learning = dataclasses.replace(LEARNING, batch=512, held_out_queries=64, coarse_steps=0)
    network = learnt(smooth, 150, synchronous=True, learning=learning)
    fresh = hold_out_coefficients(smooth, 64, 1000, 5, 64)
    error = fresh.relative_rmse(network)
    one_for_all = noise_free_ratio(fresh.mean.mean(axis=0), fresh.mean, fresh.standard_error)
    assert error < 0.7 * one_for_all
    assert error < 0.4
    figures = network.metadata["training"]["relative_rmse"]
    assert figures["transport"] is None
    assert abs(figures["coefficients"] - error) < 0.3 * error


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
    ("name", "loss"),
    [(name, "l2") for name in EXTREMES]
    + [(name, "relative") for name in ("very dark", "black, smooth", "very forward, rough")],
)
def test_extremes_train_without_nan(tmp_path, name, loss):
    scene = make_scene(tmp_path, sphere(1), **EXTREMES[name])
    learning = dataclasses.replace(BRIEF, loss=loss, report_every=0.0)
    rows = []
    network = learnt(
        scene,
        12,
        synchronous=True,
        learning=learning,
        stream=StreamSettings(queries_a_batch=128),
        progress=rows.append,
        output=tmp_path / "m.pt",
    )
    assert all(np.isfinite([row.loss, row.validation]).all() for row in rows)
    positions = np.array(scene.mesh.positions)[:20]
    outgoing = np.asarray(scene.mesh.normals)[:20]
    assert np.isfinite(network_coefficients(network, positions, outgoing, 32)).all()


@pytest.mark.parametrize("albedo", [2e-4, 0.9])
def test_the_network_answers_in_the_scene_s_own_size(tmp_path, albedo):
    """Values of 1e-5 are learnt as values of 0.1 are: the loss begins near 1 and the error falls."""
    scene = make_scene(tmp_path, sphere(1), albedo=albedo, sigma_t=3.0)
    rows = []
    learning = dataclasses.replace(BRIEF, held_out_queries=64, report_every=0.0)
    learnt(scene, 100, synchronous=True, learning=learning, progress=rows.append)
    assert rows[-1].validation < 0.75 * rows[0].validation


def test_settings_of_exits_take_any_number_of_directions(smooth):
    material = PathTracedData(smooth, dataclasses.replace(STREAM, queries_a_batch=64), 0, True)
    source = material.source(BRIEF, "cpu", None)
    for spread in (1, 3):
        learner = Learner(NeuralBSSRDF(SMALL, *material.box, 0.1), dataclasses.replace(BRIEF, spread=spread))
        generator = np.random.default_rng(0)
        assert np.isfinite(learner.learn(source, source.draw(100, generator), 0.5, generator))
