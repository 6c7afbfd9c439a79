"""Tests of lobes: their values and means, their axes, their training and their settings."""

from copy import deepcopy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from formats.errors import ModelError
from prt_bake.mathematics.sphere import fibonacci, uniform
from prt_bake.network.bssrdf import PRESETS, NeuralBSSRDF, load_model, save_model
from prt_bake.network.features.interior import LEVELS, REACH, Interior
from prt_bake.network.features.view_features import ViewFeatures
from prt_bake.network.inference.pairs import PairNetwork
from prt_bake.network.lobes import LOBE_PARAMETERS, decode_lobes, evaluate_lobes, mean_square
from prt_bake.network.settings import EXIT_INPUTS, NetworkSettings
from prt_bake.trainer.learning.learner import Learner
from prt_bake.trainer.learning.objective import LobeTerms, exit_loss
from prt_bake.trainer.samples.rows import Batch
from prt_bake.trainer.train import train
from tests.network import WITHOUT_MESH
from tests.shapes import ball
from tests.tracer.scenes import make_scene
from tests.trainer import small_training

pytestmark = WITHOUT_MESH

LOBED = replace(PRESETS["measured"], features=9, width=12, light_features=4, interfaces=0, lobes=3, low_width=0)
SPACING = 0.02


def lobe_parameters(views: int, lobes: int, spread: float, seed: int = 1) -> torch.Tensor:
    return spread * torch.randn((views, LOBE_PARAMETERS * lobes), generator=torch.Generator().manual_seed(seed))


def unit(count: int, seed: int) -> torch.Tensor:
    return torch.from_numpy(uniform(count, seed)).float()


def glass_ball(eta: float) -> Interior:
    """A clear ball of radius 0.45 in the middle of the box."""
    at = -0.1 + SPACING * np.arange(61)
    x, y, z = np.meshgrid(*[at - 0.5] * 3, indexing="ij")
    levels = np.rint((0.45 - np.sqrt(x * x + y * y + z * z)) * (LEVELS / (REACH * SPACING)))
    return Interior(np.clip(levels, -LEVELS, LEVELS)[None].astype(np.int8), (-0.1, -0.1, -0.1), SPACING, (0.5,), eta)


def lobed(low_width: int = 0) -> NeuralBSSRDF:
    network = NeuralBSSRDF(replace(LOBED, low_width=low_width), output_scale=0.7, interior=glass_ball(1.4))
    assert network.lobes is not None
    with torch.no_grad():
        network.lobes.weight.normal_(0.0, 0.5, generator=torch.Generator().manual_seed(2))
        network.lobes.bias.normal_(0.0, 0.5, generator=torch.Generator().manual_seed(3))
    return network


def over_the_sphere(lobes: int, spread: float) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Values in 40,000 directions [5,D,3], the means that the parameters give, and the mean square in closed form."""
    parameters = lobe_parameters(5, lobes, spread)
    found = decode_lobes(parameters, unit(5, 4))
    everywhere = torch.from_numpy(fibonacci(40_000)).float().expand(5, -1, 3)
    means = torch.nn.functional.softplus(parameters.reshape(5, lobes, LOBE_PARAMETERS)[..., :3] - 3.0).sum(dim=1)
    parts = [part.double().numpy() for part in (evaluate_lobes(found, everywhere), means, mean_square(found))]
    return parts[0], parts[1], parts[2]


@pytest.mark.parametrize("lobes", [1, 3])
@pytest.mark.parametrize("spread", [0.0, 0.5, 3.0])
def test_lobes_have_the_mean_of_their_parameters_and_the_exact_mean_square(lobes: int, spread: float) -> None:
    """At a spread of 3 some lobes have the maximum sharpness and some the minimum."""
    values, means, square = over_the_sphere(lobes, spread)
    np.testing.assert_allclose(values.mean(axis=1), means, rtol=1e-3)
    np.testing.assert_allclose((values**2).mean(axis=1), square, rtol=2e-3)


def test_parameters_of_zero_give_a_faint_lobe_along_the_exit() -> None:
    exits = unit(4, 5)
    lobes = decode_lobes(torch.zeros((4, LOBE_PARAMETERS)), exits)
    torch.testing.assert_close(lobes.axes[:, 0], exits)
    through, back = (evaluate_lobes(lobes, sign * exits[:, None])[:, 0, 0] for sign in (1.0, -1.0))
    assert 1.0 < float(through.min()) < 4.0
    assert float(back.max()) < 1e-6


@pytest.mark.parametrize("eta", [0.8, 1.0, 1.4])
def test_rays_leave_a_ball_by_snells_law(eta: float) -> None:
    """A chord of a ball has the same angle at both ends: a ray is refracted twice by the same angle."""
    view = ViewFeatures(LOBED, torch.zeros((LOBED.features, 6)), glass_ball(eta))
    normal, eye = uniform(400, 21), uniform(400, 22)
    cosine = np.sum(normal * eye, axis=1)
    visible = cosine > (0.7 if eta < 1.0 else 0.1)
    normal, eye, cosine = normal[visible], eye[visible], cosine[visible, None]
    inner = np.sqrt(1.0 - (1.0 - cosine**2) / eta**2)
    back = eye / eta + (inner - cosine / eta) * normal
    other = normal - 2.0 * inner * back
    expected = -eta * back + (cosine - eta * inner) * other
    x = torch.from_numpy(0.5 + 0.45 * normal)
    found = view(x, torch.from_numpy(eye), torch.from_numpy(normal)).detach().numpy()[:, -EXIT_INPUTS:]
    error = np.degrees(np.arccos(np.clip(np.sum(found * expected, axis=1), -1.0, 1.0)))
    assert np.median(error) < 1.5
    assert np.mean(error < 6.0) > 0.9


def test_initial_lobes_are_nearly_alike_and_depend_on_the_seed() -> None:
    one, same, other = (NeuralBSSRDF(replace(LOBED, seed=seed), interior=glass_ball(1.4)).lobes for seed in (1, 1, 2))
    assert one is not None
    assert same is not None
    assert other is not None
    assert torch.equal(one.weight, same.weight)
    assert not torch.equal(one.weight, other.weight)
    assert 0.01 < float(one.weight.detach().std()) < 0.03
    assert not one.bias.any()


def test_all_evaluations_are_the_sum_of_layers_and_lobes(tmp_path: Path) -> None:
    network = lobed()
    incident, positions, outgoing = uniform(6, 6).reshape(3, 2, 3), np.full((3, 3), 0.4), uniform(3, 7)
    query = [torch.from_numpy(part) for part in (incident, positions, outgoing)]
    with torch.no_grad():
        smooth, lobes = network.components(*query)
        assert lobes is not None
        expected = 0.7 * (smooth + evaluate_lobes(lobes, query[0])).numpy()
    assert np.abs(expected - 0.7 * smooth.numpy()).max() > 0.1 * np.abs(expected).max()
    np.testing.assert_allclose(network.evaluate(incident, positions, outgoing), expected, rtol=1e-6)
    pairs = PairNetwork(network).evaluate_pairs(incident, positions, outgoing)
    np.testing.assert_allclose(pairs, expected, atol=2e-5)
    block = network.evaluate_block(incident, np.arange(3)[:, None], positions, outgoing[:, None])
    np.testing.assert_allclose(block[:, 0], expected, atol=2e-5)
    save_model(network, tmp_path / "model.pt")
    read = load_model(tmp_path / "model.pt").evaluate(incident, positions, outgoing)
    np.testing.assert_array_equal(read, network.evaluate(incident, positions, outgoing))


def test_the_exit_loss_uses_the_exact_mean_square_of_lobes() -> None:
    """A few directions sample the square of sharp lobes with much noise; the exact one has the same mean."""
    draws, spread = 4000, 8
    lobes = decode_lobes(lobe_parameters(1, 2, 1.5).expand(draws, -1), unit(1, 8).expand(draws, -1))
    everywhere = unit(draws * spread, 9).reshape(draws, spread, 3)
    smooth = 0.3 + 0.2 * everywhere
    added = evaluate_lobes(lobes, everywhere)
    none = torch.zeros((draws, 1, 3))
    plain = exit_loss(none, none, smooth + added)
    exact = exit_loss(none, none, smooth + added, LobeTerms(added, mean_square(lobes)))
    difference = (plain - exact).double()
    assert abs(float(difference.mean())) < 4.0 * float(difference.std()) / draws**0.5
    assert float(exact.std()) < 0.3 * float(plain.std())


def test_the_exit_loss_of_lobes_does_not_depend_on_the_directions() -> None:
    """If only lobes contribute, the exact mean square replaces all sampled directions."""
    network = lobed()
    with torch.no_grad():
        network.output.weight.zero_()
        network.output.bias.zero_()
    rng = np.random.default_rng(10)
    rows = np.concatenate([rng.uniform(0.3, 0.7, (64, 3)), uniform(64, 11), np.zeros((64, 12))], axis=1)
    rows_of_rays = rows[:, 6:].reshape(64, 2, 6)
    rows_of_rays[..., :3], rows_of_rays[..., 3:] = uniform(128, 12).reshape(64, 2, 3), rng.uniform(0.0, 2.0, (64, 2, 3))
    batch = Batch(rows.astype(np.float32), np.arange(64))
    settings = replace(small_training.LEARNING, bfloat16=False, warm_up=0.0)
    losses = [
        Learner(deepcopy(network), settings).learn(Exits(), batch, 0.5, np.random.default_rng(seed)) for seed in (1, 2)
    ]
    assert losses[0] == pytest.approx(losses[1], rel=1e-5)


class Exits:
    """A source of exits with what the learner uses."""

    exits = True

    def describe(self, number: int) -> str:
        return f"query {number}"


def test_lobes_need_a_normal() -> None:
    with pytest.raises(ModelError, match="lobes must not be negative, and must be 0 without tells_normal"):
        NetworkSettings(lobes=1)
    with pytest.raises(ModelError, match="found -1"):
        replace(LOBED, lobes=-1)


@pytest.mark.statistics
@pytest.mark.parametrize(
    ("eta", "roughness", "sigma_t", "lobes"),
    [(1.0, 0.2, 0.5, 0), (1.4, 0.2, 0.5, 2), (1.4, 0.0, 0.5, 0), (1.4, 0.2, 3.0, 0)],
)
def test_training_uses_lobes_for_clear_objects_behind_rough_interfaces(
    tmp_path: Path, eta: float, roughness: float, sigma_t: float, lobes: int
) -> None:
    """A ball of diameter 2 is clear up to an optical depth of 4; a smooth interface leaves no such light in Ŝ."""
    scene = make_scene(tmp_path, ball(3), eta=eta, roughness=roughness, sigma_t=sigma_t)
    settings = replace(PRESETS["measured"], features=8, width=8)
    given = {"stream": small_training.STREAM, "learning": small_training.LEARNING}
    assert train(scene, steps=1, synchronous=True, settings=settings, **given).settings.lobes == lobes
