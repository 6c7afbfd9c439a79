"""Networks on a graphics card that is not there (`simulated_gpu`): all they need is on it, and they answer alike."""

from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
import torch

from formats.mesh import build_mesh
from prt_bake import shipped
from prt_bake.baking.bake import bake
from prt_bake.mathematics.sphere import uniform
from prt_bake.network.bssrdf import PRESETS, NeuralBSSRDF, load_model
from prt_bake.network.inference import fused
from prt_bake.network.inference.pairs import content_hash, pair_transport
from prt_bake.trainer import train
from tests.network import simulated_gpu as simulated_gpu
from tests.network.test_lobes import LOBED, glass_ball
from tests.shapes import ball
from tests.trainer.small_training import SMALL, learnt, make_scene

SHIPPED = Path(shipped.__file__).parent
SMALL_PAPER = replace(PRESETS["paper"], width=32)
TURNING = replace(LOBED, ray_turns=2)
COPIES, DIRECTIONS, BINS = 4, 16, 40
OFF = {"float32": 1e-5, "bfloat16": 1e-2}


@pytest.fixture(autouse=True)
def card(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Its tiles are small: a processor fills them here."""
    monkeypatch.setitem(fused.ROWS_PER_TILE, "cuda", 2048)
    monkeypatch.setitem(fused.VIEWS_PER_BATCH, "cuda", 128)
    yield simulated_gpu.install()
    simulated_gpu.steps.clear()


def network_of(name: str) -> NeuralBSSRDF:
    if name == "shipped":
        return load_model(SHIPPED / "spot.pt").up_to(2)
    settings = {"paper": SMALL_PAPER, "turning": TURNING}[name]
    network = NeuralBSSRDF(settings, interior=glass_ball(1.4) if settings.ray_samples else None)
    with torch.no_grad():
        for weight in network.parameters():
            weight += 0.02 * torch.randn(weight.shape, generator=torch.Generator().manual_seed(5))
    return network


def queries(network: NeuralBSSRDF) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A block: directions [R,D,3], which of them [1,B], a position [1,3] on the object, outgoing directions [1,B,3]."""
    incident = uniform(COPIES * DIRECTIONS, 1).reshape(COPIES, DIRECTIONS, 3)
    rotation = np.random.default_rng(2).integers(0, COPIES, (1, BINS))
    position = network.box_min.numpy() + network.box_side * np.array([[0.5, 0.5, 0.951]])
    return incident, rotation, position, uniform(BINS, 3)[None]


def apart(found: np.ndarray, expected: np.ndarray) -> float:
    return float(np.linalg.norm(found.astype(float) - expected) / np.linalg.norm(expected))


@pytest.mark.parametrize("precision", OFF)
@pytest.mark.parametrize("name", ["paper", "turning", "shipped"])
def test_a_card_answers_as_the_processor(name: str, precision: str, card: str) -> None:
    network = network_of(name)
    incident, rotation, position, outgoing = queries(network)
    expected = network.prepared(precision).evaluate_block(incident, rotation, position, outgoing)
    found = network.prepared(precision, card).evaluate_block(incident, rotation, position, outgoing)
    assert sum(simulated_gpu.steps.values()) > 0
    assert apart(found, expected) < OFF[precision]
    pairs = incident[rotation[0]], np.tile(position, (BINS, 1)), outgoing[0]
    in_pairs = pair_transport(network, precision, card).evaluate_pairs(*pairs)
    assert apart(in_pairs, expected[0]) < OFF[precision]


def test_a_model_is_loaded_onto_a_card(card: str) -> None:
    network = load_model(SHIPPED / "spot.pt", card)
    assert {tensor.device.type for tensor in (*network.parameters(), *network.buffers())} == {card}
    incident, _rotation, position, outgoing = queries(load_model(SHIPPED / "spot.pt"))
    expected = load_model(SHIPPED / "spot.pt").evaluate(incident[0], position, outgoing[:, 0])
    assert apart(network.evaluate(incident[0], position, outgoing[:, 0]), expected) < OFF["float32"]


def test_rays_that_turn_cost_a_card_no_steps_of_their_own(card: str) -> None:
    """Followed there they took thousands a block: each step of a ray is asked for after a look at the one before."""
    steps = []
    for settings in (TURNING, replace(TURNING, ray_turns=0)):
        network = NeuralBSSRDF(settings, interior=glass_ball(1.4))
        simulated_gpu.steps.clear()
        network.prepared(device=card).evaluate_block(*queries(network))
        steps.append(sum(simulated_gpu.steps.values()))
    assert steps[0] < steps[1] + 60


@pytest.mark.parametrize("asked", [{"samples": 32}, {"error": 0.05}], ids=["samples", "error"])
def test_a_bake_on_a_card_is_the_processors(asked: dict[str, float], card: str) -> None:
    """To an error too: what a bake decides on the way is decided alike; in threads beside the one that asks."""
    round_one = ball(1, 0.45)
    network, mesh = network_of("turning"), build_mesh(round_one.positions + 0.5, round_one.faces)
    baked = [
        bake(network, mesh, rings=2, sectors=4, workers=workers, device=device, **asked)
        for workers, device in ((1, "cpu"), (2, card))
    ]
    assert simulated_gpu.steps
    assert apart(baked[1].coefficients, baked[0].coefficients) < OFF["float32"]
    np.testing.assert_allclose(baked[1].standard_error, baked[0].standard_error, rtol=1e-3, atol=1e-7)
    np.testing.assert_array_equal(baked[1].error_vs_time[:, 1], baked[0].error_vs_time[:, 1])


def test_a_network_that_lies_on_a_card_is_baked(card: str, tmp_path: Path) -> None:
    """As commands hand it over: loaded onto the card."""
    round_one = ball(1, 0.45)
    network, mesh = network_of("turning"), build_mesh(round_one.positions + 0.5, round_one.faces)
    how = {"rings": 2, "sectors": 4, "samples": 16, "out": tmp_path / "asset.h5"}
    baked, known = bake(network, mesh, **how).coefficients[:], content_hash(network)
    assert apart(bake(network.to(card), mesh, device=card, **how).coefficients[:], baked) < OFF["float32"]
    assert content_hash(network) == known


def learn_on_both(folder: Path) -> None:
    scene, card = make_scene(folder, eta=1.3), simulated_gpu.install()
    with mock.patch.object(train, "select_device", lambda name: name):
        for settings in (SMALL, replace(PRESETS["measured"], features=16, width=16)):
            here, there = (learnt(scene, 20, settings=settings, device=device) for device in ("cpu", card))
            assert there.frequencies.device.type == card
            for (name, found), expected in zip(there.named_parameters(), here.parameters(), strict=True):
                assert apart(found.detach().cpu().numpy(), expected.detach().numpy()) < 1e-3, name


def test_networks_learn_on_a_card_what_they_learn_on_the_processor(tmp_path: Path) -> None:
    """In a process of its own: what differentiates counts its devices once, when it is first used."""
    with ProcessPoolExecutor(1, get_context("spawn")) as another:
        another.submit(learn_on_both, tmp_path).result()


def test_the_card_is_as_strict_as_one(card: str) -> None:
    there, here = torch.ones(3, device=card), torch.ones(3)
    with pytest.raises(RuntimeError, match="on one device"):
        there + here
    with pytest.raises((RuntimeError, TypeError)):
        there.numpy()
    there[:2] += 1.0
    np.testing.assert_array_equal(there.cpu().numpy(), [2.0, 2.0, 1.0])
    assert not isinstance(there.cpu(), simulated_gpu.SimulatedTensor)
