"""The kernels for graphics cards: on one where there is one, else in Triton's interpreter, in float32 alone."""

import pickle
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
import torch

from formats.errors import QueryError
from formats.mesh import read_mesh
from prt_bake import shipped
from prt_bake.mathematics.sphere import uniform
from prt_bake.network.bssrdf import PRESETS, NeuralBSSRDF, load_model
from prt_bake.network.inference import cuda, cuda_views
from prt_bake.network.inference.cuda_views import RecordedGraph, ViewTerms
from prt_bake.network.inference.fused import FusedNetwork
from prt_bake.network.inference.pairs import pair_transport
from prt_bake.network.settings import NetworkSettings
from tests.network import simulated_gpu as simulated_gpu
from tests.network.test_lobes import LOBED, glass_ball
from tests.network.test_view_ray import TURNING, cube, looking, rays, trapped

REAL = torch.cuda.is_available()
DEVICE = "cuda" if REAL else "cpu"
MESH = read_mesh(Path(shipped.__file__).parent / "spot.obj")
OFF = {"float32": 5e-6, "bfloat16": 2e-2}
PAPER = replace(PRESETS["paper"], features=64, width=32)
LATE = replace(LOBED, width=16, lobes=0)
SETTINGS = {
    "paper": PAPER,
    "one layer": replace(PAPER, layers=1, skips=()),
    "other skips": replace(PAPER, activation="silu", skips=((1, 3), (3, 5))),
    "late": replace(PAPER, directions="cartesian", features=9, light_layers=2, skips=((1, 3),)),
    "late alone": replace(PAPER, features=9, light_layers=1, angle_powers=3),
    "three late": replace(PAPER, features=9, light_layers=3, skips=((1, 4), (2, 5)), angle_powers=1),
    "looking": LATE,
    "lobes": replace(LATE, lobes=3),
}


@pytest.fixture
def hopper(monkeypatch: pytest.MonkeyPatch) -> None:
    """A card of the generation that has all kernels."""
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda _device: (9, 0))


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cuda, "VIEWS_PER_BATCH", 16)


def network_of(name: str) -> NeuralBSSRDF:
    if name in ("shipped", "bands"):
        network = load_model(Path(shipped.__file__).parent / "spot.pt")
        return network if name == "shipped" else network_of("lobes").up_to(4)
    settings = SETTINGS[name]
    network = NeuralBSSRDF(settings, output_scale=0.7, interior=glass_ball(1.4) if settings.ray_samples else None)
    generator = torch.Generator().manual_seed(5)
    with torch.no_grad():
        for weight in network.parameters():
            weight += 0.05 * torch.randn(weight.shape, generator=generator)
    return network


def queries(network: NeuralBSSRDF) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A block: directions [R,D,3], which of them [N,B], positions [N,3] on the object, outgoing directions [N,B,3]."""
    incident = uniform(3 * 21, 1).reshape(3, 21, 3)
    rotation = np.random.default_rng(2).integers(0, 3, (2, 13))
    positions = network.box_min.cpu().numpy() + network.box_side * (0.5 + 0.45 * uniform(2, 7))
    if network.metadata.get("scene"):
        positions = MESH.positions[[100, 2000]]
    return incident, rotation, positions, uniform(26, 3).reshape(2, 13, 3)


def apart(found: np.ndarray, expected: np.ndarray) -> float:
    return float(np.linalg.norm(found.astype(float) - expected) / np.linalg.norm(expected))


@pytest.mark.parametrize("precision", [*OFF] if REAL else ["float32"])
@pytest.mark.parametrize("name", [*SETTINGS, "shipped", "bands"])
def test_kernels_answer_as_the_processor(name: str, precision: str) -> None:
    network = network_of(name)
    assert cuda.takes(network.settings)
    asked = queries(network)
    found = cuda.CudaNetwork(network, precision, DEVICE).evaluate_block(*asked)
    assert found.dtype == np.float32
    assert apart(found, network.prepared().evaluate_block(*asked)) < OFF[precision]


@pytest.mark.parametrize("name", ["paper", "lobes"])
def test_answers_depend_on_no_cut(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    network = cuda.CudaNetwork(network_of(name), "float32", DEVICE)
    incident, rotation, positions, outgoing = queries(network.network)
    whole = network.evaluate_block(incident, rotation, positions, outgoing)
    for n, b in ((0, slice(None)), (1, slice(5, 6))):
        part = network.evaluate_block(incident, rotation[n : n + 1, b], positions[n : n + 1], outgoing[n : n + 1, b])
        np.testing.assert_array_equal(part, whole[n : n + 1, b])
    monkeypatch.setattr(cuda, "ROWS_PER_BATCH", 70)
    np.testing.assert_array_equal(network.evaluate_block(incident, rotation, positions, outgoing), whole)
    monkeypatch.setattr(cuda, "TABLE_ROWS", 24)
    np.testing.assert_array_equal(network.evaluate_block(incident, rotation, positions, outgoing), whole)
    again = pickle.loads(pickle.dumps(network))
    assert isinstance(again, cuda.CudaNetwork)
    np.testing.assert_array_equal(again.evaluate_block(incident, rotation, positions, outgoing), whole)


def test_rays_turn_as_on_the_processor() -> None:
    """More of them than are followed in step, some of which never turn."""
    x, towards = trapped(24)
    x, towards = np.concatenate([x, x]), np.concatenate([towards, np.tile([0.0, 0.0, -1.0], (24, 1))])
    view = looking(cube(), replace(TURNING, ray_turns=4)).to(DEVICE)
    x, towards = x.astype(np.float32), towards.astype(np.float32)
    view.use_kernels = True
    at = torch.from_numpy(x).to(DEVICE), torch.from_numpy(-towards).to(DEVICE)
    found = view._ray(*at)
    expected = rays(looking(cube(), replace(TURNING, ray_turns=4)), x, towards)
    assert torch.isfinite(expected.begins[:24, 1]).float().mean() > 0.8
    assert not torch.isfinite(expected.begins[24:, 1:]).any()
    for kernel, processor in zip(
        (found.starts, found.towards, found.begins), (expected.starts, expected.towards, expected.begins), strict=True
    ):
        torch.testing.assert_close(kernel.cpu(), processor, atol=2e-4, rtol=1e-4)


@pytest.mark.parametrize("name", ["late", "lobes", "shipped", "bands"])
def test_what_is_recorded_waits_for_nothing(name: str) -> None:
    """A real card refuses to record steps that need numbers from the processor, or a look at its own."""
    there = simulated_gpu.install()
    network = cuda.CudaNetwork(network_of(name), "float32", there)
    _incident, _rotation, positions, outgoing = queries(network.network)
    with torch.inference_mode():
        asked = network._view_queries(positions, outgoing)
        simulated_gpu.waits.clear()
        network._seen(asked)
    assert not simulated_gpu.waits


@pytest.mark.parametrize(
    "settings",
    [
        replace(PAPER, width=48),
        replace(PAPER, width=8),
        replace(PAPER, features=40),
        replace(PAPER, skips=((1, 4),)),
        replace(PAPER, skips=((1, 3), (1, 3))),
        replace(PAPER, light_layers=3, skips=((3, 5),)),
    ],
    ids=["no power of two", "narrow", "features", "far skip", "same skip", "late skip"],
)
def test_what_the_kernels_cannot_do_is_left_to_others(settings: NetworkSettings, hopper: None) -> None:
    assert not cuda.takes(settings)
    assert type(cuda.cuda_network(NeuralBSSRDF(settings), "float32", DEVICE)) is FusedNetwork


def test_a_network_is_prepared_for_a_card_by_its_kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cuda, "cuda_network", lambda _network, precision, device: (precision, device))
    assert NeuralBSSRDF(PAPER).prepared("bfloat16", "cuda") == ("bfloat16", "cuda")
    assert type(NeuralBSSRDF(PAPER).prepared()) is FusedNetwork
    with pytest.raises(QueryError, match="precision must be one of"):
        NeuralBSSRDF(PAPER).prepared("float16", "cuda")


def test_kernels_are_taken_where_there_are_some(hopper: None, monkeypatch: pytest.MonkeyPatch) -> None:
    network = network_of("paper")
    assert type(cuda.cuda_network(network, "float32", DEVICE)) is cuda.CudaNetwork
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda _device: (7, 5))
    assert type(cuda.cuda_network(network, "float32", DEVICE)) is FusedNetwork


def test_kernels_that_cannot_be_made_are_done_without_and_it_is_said(
    hopper: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    def failing(network: object) -> None:
        raise RuntimeError("Failed to find C compiler")

    monkeypatch.setattr(cuda, "tried", failing)
    with pytest.warns(RuntimeWarning, match=r"cannot be used on .*RuntimeError: Failed to find C compiler"):
        network = cuda.cuda_network(network_of("paper"), "float32", DEVICE)
    assert type(network) is FusedNetwork


@pytest.mark.parametrize("name", ["paper", "lobes"])
def test_pictures_ask_for_pairs(name: str) -> None:
    network = network_of(name)
    incident, rotation, positions, outgoing = queries(network)
    asked = incident[rotation[:, 0]], positions, outgoing[:, 0]
    found = pair_transport(network, "float32", DEVICE).evaluate_pairs(*asked)
    assert apart(found, network.evaluate(*asked)) < 1e-5


class Stream:
    """What torch has for cards, as far as it is used."""

    def __init__(self, _device: object = None) -> None:
        self.waited = 0

    def wait_stream(self, other: "Stream") -> None:
        assert isinstance(other, Stream)

    def synchronize(self) -> None:
        self.waited += 1


class Graph:
    """Plays what was recorded over what it answered."""

    def __init__(self, recorded: RecordedGraph) -> None:
        self.recorded = recorded

    def replay(self) -> None:
        found, fresh = self.recorded._found, self.recorded._function(self.recorded._asked)
        for kept, new in zip((*found[:2], *found.lobes), (*fresh[:2], *fresh.lobes), strict=True):
            kept.copy_(new)


@pytest.fixture
def pretended(monkeypatch: pytest.MonkeyPatch) -> None:
    """Streams and graphs, without a card; what is recorded is not done."""
    monkeypatch.setattr(cuda, "stream", Stream)
    monkeypatch.setattr(cuda_views, "stream", Stream)
    for name, there in (("current_stream", Stream), ("stream", nullcontext)):
        monkeypatch.setattr(torch.cuda, name, there)
    monkeypatch.setattr(torch.cuda, "graph", lambda graph, capture_error_mode: nullcontext(graph))


def test_lots_that_are_played_back_leave_earlier_ones_as_they_were(
    pretended: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = torch.arange(33.0).view(11, 3)
    called = []

    def seen(views: torch.Tensor) -> ViewTerms:
        called.append(len(views))
        return ViewTerms((2.0 * views).repeat(2, 1, 1), views[:, None] + 1.0, (views**2,))

    recorded = RecordedGraph(seen, 4, cast(torch.device, SimpleNamespace(type="cuda")))
    monkeypatch.setattr(torch.cuda, "CUDAGraph", lambda: Graph(recorded), raising=False)
    first, found = recorded(asked[:3]), recorded(asked)
    assert called == [4] * 6  # once before it is recorded, once recorded, four times played
    torch.testing.assert_close(found.added, (2.0 * asked).repeat(2, 1, 1))
    torch.testing.assert_close(found.frame, asked[:, None] + 1.0)
    torch.testing.assert_close(found.lobes, (asked**2,))
    torch.testing.assert_close(first.frame, asked[:3, None] + 1.0)


def test_answers_are_fetched_as_they_come(pretended: None, monkeypatch: pytest.MonkeyPatch) -> None:
    network = cuda.CudaNetwork(network_of("paper"), "float32", "cpu")
    asked = queries(network.network)
    whole = network.evaluate_block(*asked)
    fetching = Stream()
    empty = torch.empty
    monkeypatch.setattr(network, "_copying", fetching)
    monkeypatch.setattr(cuda, "ROWS_PER_BATCH", 100)
    monkeypatch.setattr(torch, "empty", lambda *size, pin_memory=False, **how: empty(*size, **how))
    np.testing.assert_array_equal(network.evaluate_block(*asked), whole)
    assert fetching.waited == 1
