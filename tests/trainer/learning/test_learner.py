"""The learner: its losses, its rate schedule, its average of weights, and its errors."""

import dataclasses
import itertools

import numpy as np
import pytest
import torch

from formats.errors import QueryError
from prt_bake.mathematics import sphere
from prt_bake.network.bssrdf import NeuralBSSRDF
from prt_bake.trainer.learning.learner import (
    Learner,
    LearningSettings,
    every_third,
    learning_rate,
    move_average,
    rotated_lattice,
    share_of_average,
)
from prt_bake.trainer.learning.objective import exit_loss, value_loss
from prt_bake.trainer.samples.rows import CHANNELS, INCIDENT, OUTGOING, POSITION, Batch, rays_of
from tests.trainer.small_training import LEARNING, SMALL

SPHERE = 4.0 * np.pi
ALBEDO = np.array([0.9, 0.5, 0.1])


class Rows:
    """A source that always returns the same rows."""

    def __init__(self, batch, exits=False):
        self.batch, self.exits = batch, exits

    def describe(self, number):
        return f"query {number} on face 7"


def network_value(directions):
    """Values [M,3] of a network at one query, negative in places."""
    x, y, z = np.moveaxis(directions, -1, 0)
    return np.stack([0.1 + 0.05 * z, 0.04 + 0.1 * x * y, 0.02 - 0.06 * z + 0.03 * y], axis=-1)


def transport(directions):
    """Ŝ [M,3]: a cosine lobe about z whose integral is ALBEDO."""
    return ALBEDO * (1.0 + 0.8 * directions[..., 2:]) / SPHERE


def uniform_directions(count, generator):
    """Directions [count,3], uniform over the sphere."""
    d = generator.normal(size=(count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def exits(count, generator):
    """Directions [M,3] that follow (1 + 0.8 z) / 4π, by inversion; the throughput is ALBEDO."""
    u, v = generator.random((2, count))
    # CDF (z + 1)/2 + 0.2 (z² − 1) = u
    z = (-0.5 + np.sqrt(0.25 - 0.8 * (0.5 - 0.2 - u))) / 0.4
    r = np.sqrt(np.maximum(0.0, 1.0 - z * z))
    return np.stack([r * np.cos(2 * np.pi * v), r * np.sin(2 * np.pi * v), z], axis=1)


def sphere_mean(values):
    """Means over the sphere of values at the nodes [D] of a product quadrature."""
    return np.average(values, axis=0, weights=sphere_weights())


def nodes():
    z, _ = np.polynomial.legendre.leggauss(16)
    turn = 2 * np.pi * np.arange(32) / 32
    r = np.sqrt(1 - z * z)[:, None]
    grid = np.stack([r * np.cos(turn), r * np.sin(turn), np.repeat(z[:, None], 32, axis=1)], axis=-1)
    return grid.reshape(-1, 3)


def sphere_weights():
    return np.repeat(np.polynomial.legendre.leggauss(16)[1], 32)


def test_the_exit_loss_is_the_squared_distance_less_a_constant():
    count = 200_000
    generator = np.random.default_rng(5)
    out = exits(3 * count, generator).reshape(count, 3, 3)
    uniform = uniform_directions(2 * count, generator).reshape(count, 2, 3)
    throughput = np.broadcast_to(ALBEDO, out.shape).copy()
    tensors = (torch.from_numpy(values) for values in (network_value(out), throughput, network_value(uniform)))
    losses = exit_loss(*tensors)
    at = nodes()
    distance = sphere_mean((network_value(at) - transport(at)) ** 2).mean()
    constant = sphere_mean(transport(at) ** 2).mean()
    standard_error = float(losses.std()) / np.sqrt(count)
    assert abs(float(losses.mean()) - (distance - constant)) < 4.5 * standard_error  # false alarm 1e-5
    assert standard_error < 0.02 * constant  # else the test is too weak


def test_the_value_loss_is_the_squared_distance():
    at = nodes()
    predicted, truth = (torch.from_numpy(f(at).reshape(-1, 8, 3)) for f in (network_value, transport))
    losses = value_loss(predicted, truth).numpy()
    expected = ((network_value(at) - transport(at)) ** 2).mean(axis=1)
    np.testing.assert_allclose(losses, expected.reshape(-1, 8).mean(axis=1), rtol=1e-12)


def test_lattice_directions_are_uniform():
    lattices = rotated_lattice(100_000, 5, np.random.default_rng(1)).astype(np.float64)
    np.testing.assert_allclose(np.linalg.norm(lattices, axis=2), 1.0, atol=1e-6)
    basis = sphere.fibonacci(64)
    for d in np.moveaxis(lattices, 1, 0):  # each alone is uniform, together they are evenly spread
        assert np.abs(d.mean(axis=0)).max() < 4.5 / np.sqrt(3 * len(d))
        share = np.mean(d @ basis.T > 0.9, axis=0)
        assert np.abs(share - 0.05).max() < 5 * np.sqrt(0.05 / len(d))  # false alarm 2e-4 over 320 caps


@pytest.mark.parametrize("rays", [2, 3, 4, 11, 12])
def test_the_mean_over_thirds_of_the_rays_is_that_of_all_rays(rays):
    all_rays = torch.rand((5, rays, 6), dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    before = all_rays.clone()
    thirds = [every_third(all_rays, first) for first in range(3)]
    assert sum(third.shape[1] for third in thirds) == (rays if rays >= 3 else 3 * rays)
    means = torch.stack([third[..., CHANNELS].mean(dim=1) for third in thirds]).mean(dim=0)
    torch.testing.assert_close(means, all_rays[..., CHANNELS].mean(dim=1))
    assert torch.equal(all_rays, before)


def test_coarse_steps_evaluate_a_third_of_the_directions():
    batch, evaluated = random_rows(np.full(3, 0.2), rays=12), []
    learner = Learner(small_network(), dataclasses.replace(LEARNING, spread=24, coarse_steps=2))
    predict = learner._predict
    learner._predict = lambda incident, *rest: evaluated.append(incident.shape[1]) or predict(incident, *rest)
    for _step in range(3):
        learner.learn(Rows(batch, True), batch, 0.0, np.random.default_rng(0))
    assert evaluated == [4 + 8, 4 + 8, 12 + 24]


def test_coarse_steps_use_all_thirds():
    batch, evaluated = random_rows(np.full(3, 0.2), rays=12), []
    learner = Learner(small_network(), dataclasses.replace(LEARNING, coarse_steps=30))
    predict, generator = learner._predict, np.random.default_rng(0)
    learner._predict = lambda incident, *rest: evaluated.append(incident[0, 0].numpy()) or predict(incident, *rest)
    for _step in range(30):
        learner.learn(Rows(batch, True), batch, 0.0, generator)
    first = [[np.array_equal(direction, ray[INCIDENT]) for direction in evaluated] for ray in batch.rays[0, :3]]
    assert np.sum(first) == 30
    assert np.sum(first, axis=1).min() >= 2  # false alarm 3 (2/3)^30 · 16, 2e-4, at one fixed seed


@pytest.mark.parametrize("ray", range(12))
def test_coarse_steps_stop_at_any_ray_that_is_not_finite(ray):
    batch = random_rows(np.full(3, 0.2), rays=12)
    batch.rays[5, ray, CHANNELS] = np.nan
    learner = Learner(small_network(), dataclasses.replace(LEARNING, coarse_steps=2))
    with pytest.raises(QueryError, match="query 105"):
        learner.learn(Rows(batch, True), batch, 0.0, np.random.default_rng(0))


def small_network(**arguments):
    return NeuralBSSRDF(SMALL, (0.0, 0.0, 0.0), 2.0, **arguments)


def random_rows(channels, count=64, seed=0, rays=2):
    generator = np.random.default_rng(seed)
    rows = np.empty((count, 6 + 6 * rays), np.float32)
    rows[:, POSITION], rows[:, OUTGOING] = generator.random((count, 3)), uniform_directions(count, generator)
    each = rays_of(rows)
    each[..., INCIDENT] = uniform_directions(rays * count, generator).reshape(count, rays, 3)
    each[..., CHANNELS] = channels
    return Batch(rows, np.arange(100, 100 + count))


@pytest.mark.parametrize("exits", [False, True])
@pytest.mark.parametrize("scale", [1e-4, 1.0, 1e4])
def test_steps_scale_with_the_output(exits, scale):
    """Learning does not depend on the unit of radiance, however dark the scene."""
    fitted = []
    for factor in (1.0, scale):
        learner = Learner(small_network(output_scale=factor), dataclasses.replace(LEARNING, warm_up=0.0, spread=2))
        batch = random_rows(np.array([0.5, 1.0, 2.0], np.float32) * np.float32(factor))
        generator = np.random.default_rng(3)
        for _ in range(10):
            assert np.isfinite(learner.learn(Rows(batch, exits), batch, 0.5, generator))
        fitted.append(learner.network.output.weight.detach().numpy().copy())
    np.testing.assert_allclose(fitted[0], fitted[1], rtol=2e-2, atol=2e-3)


def test_the_average_weights_late_steps_more():
    """The average of weights that grow by one per step lags by `average_length` of the steps."""
    for length in (0.05, 0.2, 0.5):
        learner = Learner(small_network(), dataclasses.replace(LEARNING, average_length=length))
        for step in range(1, 401):
            learner.step = step
            with torch.no_grad():
                for parameter in learner.network.parameters():
                    parameter.fill_(float(step))
            move_average(learner.model, learner.network, share_of_average(learner.settings, step))
        lag = 1.0 - float(learner.model.output.bias.detach()[0]) / 400
        assert lag == pytest.approx(length, abs=0.01)


@pytest.mark.parametrize("decay", [0.0, 0.1, 2.0])
def test_weights_without_gradient_decay_with_the_rate(decay):
    """The prediction is exact and no weight has a gradient, so only decay changes the weights."""
    learner = Learner(small_network(), dataclasses.replace(LEARNING, decay=decay, rate=0.02, warm_up=0.0))
    with torch.no_grad():
        learner.network.output.weight.zero_()
        learner.network.output.bias.zero_()
    before = learner.network.hidden[0].weight.detach().clone()
    for _ in range(3):
        learner.learn(Rows(random_rows(np.zeros(3, np.float32))), random_rows(np.zeros(3, np.float32)), 0.0, None)
    rate = learning_rate(learner.settings, 0.0)
    decayed = before * (1.0 - rate * decay) ** 3
    np.testing.assert_allclose(learner.network.hidden[0].weight.detach(), decayed, rtol=1e-5)


def test_the_rate_rises_and_falls_to_zero():
    settings = LearningSettings(rate=1.0, warm_up=0.1)
    rates = [learning_rate(settings, share) for share in np.linspace(0.0, 1.0, 101)]
    assert rates[0] < 0.01
    assert max(rates) > 0.9
    assert rates[-1] == pytest.approx(0.0)
    assert all(a < b for a, b in itertools.pairwise(rates[:10]))
    assert all(a > b for a, b in itertools.pairwise(rates[11:]))


@pytest.mark.parametrize(
    "wrong",
    [
        {"batch": 0},
        {"average_length": 0.6},
        {"rate": float("nan")},
        {"decay": -0.1},
    ],
)
def test_settings_out_of_range_are_refused(wrong):
    with pytest.raises(QueryError, match=f"{next(iter(wrong))}: expected .*, found"):
        LearningSettings(**wrong)


@pytest.mark.parametrize("exits", [False, True])
@pytest.mark.parametrize("value", [np.nan, np.inf, 1e38])
def test_a_loss_that_is_not_finite_names_its_query_and_changes_no_weight(exits, value):
    network = small_network(output_scale=0.5 if value < np.inf else 1.0)
    learner = Learner(network, LEARNING)
    batch = random_rows(np.ones(3, np.float32))
    ray = batch.rays[17, 1]
    ray[CHANNELS] = 3e38 if exits and value == 1e38 else value
    before = [parameter.detach().clone() for parameter in network.parameters()]
    with pytest.raises(QueryError) as fault:
        learner.learn(Rows(batch, exits), batch, 0.5, np.random.default_rng(0))
    message = str(fault.value)
    assert "query 117 on face 7" in message
    assert "position (" in message
    for part in (batch.rows[17, OUTGOING], ray[INCIDENT]):
        assert f"{part[0]:.6g}" in message
    assert all(torch.equal(a, b) for a, b in zip(before, network.parameters(), strict=True))


def test_a_diverged_network_is_distinguished_from_a_bad_query():
    learner = Learner(small_network(), LEARNING)
    with torch.no_grad():
        learner.network.output.bias.fill_(torch.nan)
    batch = random_rows(np.ones(3, np.float32))
    with pytest.raises(QueryError, match="so are the losses of all other queries: lower the rate"):
        learner.learn(Rows(batch), batch, 0.5, np.random.default_rng(0))
