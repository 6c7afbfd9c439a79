"""Networks on a simulated GPU: all tensors that they need are on it, and results agree with the CPU."""

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
from tests.network import WITHOUT_MESH, simulated_gpu
from tests.network.test_lobes import LOBED, glass_ball
from tests.shapes import ball
from tests.trainer.small_training import SMALL, make_scene, train_small

pytestmark = WITHOUT_MESH

SHIPPED = Path(shipped.__file__).parent
SMALL_PAPER = replace(PRESETS["paper"], width=32)
CLEAR = replace(LOBED, interfaces=2)
COPIES, DIRECTIONS, BINS = 4, 16, 40
TOLERANCE = {"float32": 1e-5, "bfloat16": 1e-2}


@pytest.fixture(autouse=True)
def gpu(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """The name of the device; its tiles are small, because the CPU computes them."""
    monkeypatch.setitem(fused.ROWS_PER_TILE, "cuda", 2048)
    monkeypatch.setitem(fused.VIEWS_PER_BATCH, "cuda", 128)
    yield simulated_gpu.install()
    simulated_gpu.steps.clear()


def network_of(name: str) -> NeuralBSSRDF:
    if name == "shipped":
        return load_model(SHIPPED / "spot.pt").up_to(2)
    settings = {"paper": SMALL_PAPER, "clear": CLEAR}[name]
    network = NeuralBSSRDF(settings, interior=glass_ball(1.4) if settings.ray_samples else None)
    with torch.no_grad():
        for weight in network.parameters():
            weight += 0.02 * torch.randn(weight.shape, generator=torch.Generator().manual_seed(5))
    return network


def queries(network: NeuralBSSRDF) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A block: directions [R,D,3], rotations [1,B], a position [1,3] on the object, outgoing directions [1,B,3]."""
    incident = uniform(COPIES * DIRECTIONS, 1).reshape(COPIES, DIRECTIONS, 3)
    rotation = np.random.default_rng(2).integers(0, COPIES, (1, BINS))
    position = network.box_min.numpy() + network.box_side * np.array([[0.5, 0.5, 0.951]])
    return incident, rotation, position, uniform(BINS, 3)[None]


def relative_error(found: np.ndarray, expected: np.ndarray) -> float:
    return float(np.linalg.norm(found.astype(float) - expected) / np.linalg.norm(expected))


@pytest.mark.parametrize("precision", TOLERANCE)
@pytest.mark.parametrize("name", ["paper", "clear", "shipped"])
def test_a_gpu_agrees_with_the_cpu(name: str, precision: str, gpu: str) -> None:
    network = network_of(name)
    incident, rotation, position, outgoing = queries(network)
    expected = network.prepared(precision).evaluate_block(incident, rotation, position, outgoing)
    found = network.prepared(precision, gpu).evaluate_block(incident, rotation, position, outgoing)
    assert sum(simulated_gpu.steps.values()) > 0
    assert relative_error(found, expected) < TOLERANCE[precision]
    pairs = incident[rotation[0]], np.tile(position, (BINS, 1)), outgoing[0]
    found = pair_transport(network, precision, gpu).evaluate_pairs(*pairs)
    assert relative_error(found, expected[0]) < TOLERANCE[precision]


def test_a_model_is_loaded_onto_the_gpu(gpu: str) -> None:
    network = load_model(SHIPPED / "spot.pt", gpu)
    assert {tensor.device.type for tensor in (*network.parameters(), *network.buffers())} == {gpu}
    incident, _rotation, position, outgoing = queries(load_model(SHIPPED / "spot.pt"))
    expected = load_model(SHIPPED / "spot.pt").evaluate(incident[0], position, outgoing[:, 0])
    assert relative_error(network.evaluate(incident[0], position, outgoing[:, 0]), expected) < TOLERANCE["float32"]


@pytest.mark.statistics
@pytest.mark.parametrize("options", [{"samples": 32}, {"error": 0.05}], ids=["samples", "error"])
def test_a_bake_on_the_gpu_agrees_with_the_cpu(options: dict[str, float], gpu: str) -> None:
    """A bake to an error takes the same decisions, also with several workers."""
    sphere = ball(1, 0.45)
    network, mesh = network_of("clear"), build_mesh(sphere.positions + 0.5, sphere.faces)
    baked = [
        bake(network, mesh, rings=2, sectors=4, workers=workers, device=device, **options)
        for workers, device in ((1, "cpu"), (2, gpu))
    ]
    assert simulated_gpu.steps
    assert relative_error(baked[1].coefficients, baked[0].coefficients) < TOLERANCE["float32"]
    np.testing.assert_allclose(baked[1].standard_error, baked[0].standard_error, rtol=1e-3, atol=1e-7)
    np.testing.assert_array_equal(baked[1].error_vs_time[:, 1], baked[0].error_vs_time[:, 1])


def test_a_network_on_the_gpu_is_baked(gpu: str, tmp_path: Path) -> None:
    """Commands load the network onto the device."""
    sphere = ball(1, 0.45)
    network, mesh = network_of("clear"), build_mesh(sphere.positions + 0.5, sphere.faces)
    # In float16 a value next to a tie would be rounded either way.
    options = {"rings": 2, "sectors": 4, "samples": 16, "storage": "float32", "out": tmp_path / "asset.h5"}
    expected, digest = bake(network, mesh, **options).coefficients[:], content_hash(network)
    found = bake(network.to(gpu), mesh, device=gpu, **options).coefficients[:]
    assert relative_error(found, expected) < TOLERANCE["float32"]
    assert content_hash(network) == digest


def train_on_both(folder: Path) -> None:
    scene, gpu = make_scene(folder, eta=1.3), simulated_gpu.install()
    with mock.patch.object(train, "select_device", lambda name: name):
        for settings in (SMALL, replace(PRESETS["measured"], features=16, width=16)):
            on_cpu, on_gpu = (train_small(scene, 20, settings=settings, device=device) for device in ("cpu", gpu))
            assert on_gpu.frequencies.device.type == gpu
            for (name, found), expected in zip(on_gpu.named_parameters(), on_cpu.parameters(), strict=True):
                assert relative_error(found.detach().cpu().numpy(), expected.detach().numpy()) < 1e-3, name


@pytest.mark.statistics
def test_training_on_the_gpu_agrees_with_the_cpu(tmp_path: Path) -> None:
    """In a separate process: autograd counts the devices once, on first use."""
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        pool.submit(train_on_both, tmp_path).result()


def test_the_simulated_gpu_is_strict(gpu: str) -> None:
    on_gpu, on_cpu = torch.ones(3, device=gpu), torch.ones(3)
    with pytest.raises(RuntimeError, match="on one device"):
        on_gpu + on_cpu
    with pytest.raises((RuntimeError, TypeError)):
        on_gpu.numpy()
    on_gpu[:2] += 1.0
    np.testing.assert_array_equal(on_gpu.cpu().numpy(), [2.0, 2.0, 1.0])
    assert not isinstance(on_gpu.cpu(), simulated_gpu.SimulatedTensor)
