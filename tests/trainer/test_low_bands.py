"""Learning low bands: an unbiased loss, weights of their own, and that they stay only if they are better."""

import copy
import itertools
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from prt_bake.mathematics import sh
from prt_bake.network.bssrdf import NeuralBSSRDF
from prt_bake.network.low_bands import low_harmonics
from prt_bake.trainer.learner import Learner, LearningSettings
from prt_bake.trainer.objective import low_loss
from prt_bake.trainer.run import Run
from prt_bake.trainer.samples.rows import CHANNELS, INCIDENT, OUTGOING, POSITION, Batch, rays_of
from tests.network import WITHOUT_MESH
from tests.network.test_low_bands import SETTINGS, glass_ball, network
from tests.trainer.test_learner import ALBEDO, Rows, exits, nodes, sphere_mean, transport, uniform_directions

pytestmark = WITHOUT_MESH
SPHERE = 4.0 * np.pi
TRUTH = SPHERE * sphere_mean(sh.evaluate(nodes(), 2)[:, :, None] * transport(nodes())[:, None])
"""a_lm [9,3] of the transport of `tests.trainer.test_learner`."""


def batch(count: int, rays: int, generator: np.random.Generator, scale: float = 1.0) -> Batch:
    """Rows of queries anywhere in the box, all of whose walks follow `transport`."""
    rows = np.zeros((count, 6 + 6 * rays), np.float32)
    rows[:, POSITION], rows[:, OUTGOING] = generator.random((count, 3)), uniform_directions(count, generator)
    each = rays_of(rows)
    each[..., INCIDENT], each[..., CHANNELS] = exits(count * rays, generator).reshape(count, rays, 3), scale * ALBEDO
    return Batch(rows, np.arange(count))


def test_the_loss_is_the_squared_distance_plus_a_constant() -> None:
    """Differences of the mean loss at several coefficients are those of the distances, within 4 standard errors."""
    generator = np.random.default_rng(1)
    directions = torch.from_numpy(exits(4 * 200_000, generator).reshape(-1, 4, 3))
    throughput = torch.from_numpy(ALBEDO).expand(len(directions), 4, 3).float()
    harmonics = low_harmonics(directions)

    def losses(coefficients: np.ndarray) -> np.ndarray:
        rows = torch.from_numpy(coefficients).float().expand(len(directions), 9, 3)
        return low_loss(rows, harmonics, throughput).double().numpy()

    at_truth = losses(TRUTH)
    for offset in generator.normal(size=(3, 9, 3)):
        difference = losses(TRUTH + 0.1 * offset) - at_truth
        expected = np.sum(np.mean((0.1 * offset) ** 2, axis=1)) / SPHERE
        error = difference.std() / np.sqrt(len(difference))
        assert abs(difference.mean() - expected) < 4.0 * error


@pytest.mark.parametrize("scale", [1.0, 1e3])
def test_low_bands_learn_what_walks_say_in_many_small_steps(scale: float) -> None:
    generator = np.random.default_rng(2)
    made = NeuralBSSRDF(SETTINGS, output_scale=0.7 * scale, interior=glass_ball(1.4))
    learner = Learner(made, LearningSettings(bfloat16=False, low_batch=16, coarse_steps=0))
    for step in range(150):
        rows = batch(64, 16, generator, scale)
        learner.learn(Rows(rows, exits=True), rows, step / 150, generator)
    assert learner.optimizers[-1].state_dict()["param_groups"][0]["lr"] == learner.optimizers[0].param_groups[0]["lr"]
    steps = learner.optimizers[-2].state_dict()["state"][0]["step"]
    assert int(steps) == 4 * 150
    views = torch.from_numpy(batch(200, 1, generator).rows)
    result: Any = learner.result()
    with torch.no_grad():
        found = result.low_coefficients(views[:, POSITION], views[:, OUTGOING])
    off = np.linalg.norm(found.numpy() * result.output_scale / scale - TRUTH, axis=(1, 2)) / np.linalg.norm(TRUTH)
    assert np.sqrt(np.mean(off**2)) < 0.05


def test_low_bands_and_other_layers_learn_apart() -> None:
    """Other layers learn the same, bit by bit, with low bands and without."""
    generators = [np.random.default_rng(3) for _ in range(2)]
    plain = NeuralBSSRDF(replace(SETTINGS, low_width=0), output_scale=0.7, interior=glass_ball(1.4))
    both = NeuralBSSRDF(SETTINGS, output_scale=0.7, interior=glass_ball(1.4))
    before = copy.deepcopy(both.low)
    for made, generator in zip((plain, both), generators, strict=True):
        learner = Learner(made, LearningSettings(bfloat16=False))
        for step in range(3):
            rows = batch(32, 6, generator)
            learner.learn(Rows(rows, exits=True), rows, step / 3, generator)
    for name, weights in plain.named_parameters():
        assert torch.equal(weights, both.get_parameter(name)), name
    assert both.low is not None
    assert before is not None
    for first, last in zip(before.parameters(), both.low.parameters(), strict=True):
        assert not torch.equal(first, last)


def test_a_learner_with_low_bands_continues_bit_by_bit() -> None:
    def steps(learner: Learner, generator: np.random.Generator, count: int) -> None:
        for step in itertools.islice(itertools.count(learner.step), count):
            rows = batch(32, 6, generator)
            learner.learn(Rows(rows, exits=True), rows, step / 6, generator)

    settings = LearningSettings(bfloat16=False, low_batch=16)
    straight, first, second = (Learner(network(), settings) for _ in range(3))
    steps(straight, np.random.default_rng(4), 6)
    generator = np.random.default_rng(4)
    steps(first, generator, 3)
    second.restore(copy.deepcopy(first.state()))
    steps(second, generator, 3)
    for name, weights in straight.network.named_parameters():
        assert torch.equal(weights, second.network.get_parameter(name)), name


@pytest.mark.parametrize("better", ["low bands", "other layers"])
def test_low_bands_stay_only_if_they_are_better(better: str) -> None:
    def error(made: NeuralBSSRDF) -> float:
        return 0.2 if (made.low is not None) == (better == "low bands") else 0.3

    run: Any = SimpleNamespace(reference=SimpleNamespace(relative_rmse=error))
    found: Any = Run._with_useful_bands(run, network())
    assert (found.low is not None) == (better == "low bands")
    plain = network(replace(SETTINGS, low_width=0))
    assert Run._with_useful_bands(run, plain) is plain
