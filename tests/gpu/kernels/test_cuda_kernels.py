"""Tests of the GPU kernels: on a GPU if there is one, else in Triton's interpreter, in float32 only."""

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
from tests.network import WITHOUT_MESH, simulated_gpu
from tests.network.test_lobes import LOBED, glass_ball
from tests.network.test_view_path import UNIT, cube, mesh_of

pytestmark = WITHOUT_MESH

REAL = torch.cuda.is_available()
DEVICE = "cuda" if REAL else "cpu"
MESH = read_mesh(Path(shipped.__file__).parent / "spot.obj")
TOLERANCE = {"float32": 5e-6, "bfloat16": 2e-2}
PAPER = replace(PRESETS["paper"], features=64, width=32)
LATE = replace(LOBED, width=16, lobes=0)
SETTINGS = {
    "paper": PAPER,
    "one layer": replace(PAPER, layers=1, skips=()),
    "other skips": replace(PAPER, activation="silu", skips=((1, 3), (3, 5))),
    "late": replace(PAPER, directions="cartesian", features=9, light_layers=2, skips=((1, 3),)),
    "one late layer": replace(PAPER, features=9, light_layers=1, angle_powers=3),
    "three late layers": replace(PAPER, features=9, light_layers=3, skips=((1, 4), (2, 5)), angle_powers=1),
    "interior": LATE,
    "lobes": replace(LATE, lobes=3),
    "low bands": replace(LATE, low_width=16),
    "correction": replace(LATE, low_width=16, correction_width=16),
    "correction, lobes": replace(LATE, low_width=16, correction_width=16, lobes=3),
    "paths": replace(LATE, interfaces=6, lobes=3),
}


@pytest.fixture
def hopper(monkeypatch: pytest.MonkeyPatch) -> None:
    """A GPU of the generation that runs all kernels."""
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda _device: (9, 0))


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cuda, "VIEWS_PER_BATCH", 16)


def network_of(name: str) -> NeuralBSSRDF:
    if name in ("shipped", "bands"):
        network = load_model(Path(shipped.__file__).parent / "spot.pt")
        return network if name == "shipped" else network_of("lobes").up_to(4)
    settings = SETTINGS[name]
    interior = cube(0.5) if name == "paths" else glass_ball(1.4) if settings.ray_samples else None
    network = NeuralBSSRDF(settings, output_scale=0.7, interior=interior)
    generator = torch.Generator().manual_seed(5)
    with torch.no_grad():
        for weight in network.parameters():
            weight += 0.05 * torch.randn(weight.shape, generator=generator)
    network = network.up_to(2) if name == "low bands" else network
    return network.on(mesh_of(UNIT)) if name == "paths" else network


def queries(network: NeuralBSSRDF) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A block: directions [R,D,3], rotations [N,B], positions [N,3] on the object, outgoing directions [N,B,3]."""
    incident = uniform(3 * 21, 1).reshape(3, 21, 3)
    rotation = np.random.default_rng(2).integers(0, 3, (2, 13))
    positions = network.box_min.cpu().numpy() + network.box_side * (0.5 + 0.45 * uniform(2, 7))
    if network.metadata.get("scene"):
        positions = MESH.positions[[100, 2000]]
    if network.path is not None:
        positions = np.array([[0.3, 0.4, 1.0], [1.0, 0.2, 0.6]])
    return incident, rotation, positions, uniform(26, 3).reshape(2, 13, 3)


def relative_error(found: np.ndarray, expected: np.ndarray) -> float:
    return float(np.linalg.norm(found.astype(float) - expected) / np.linalg.norm(expected))


@pytest.mark.parametrize("precision", [*TOLERANCE] if REAL else ["float32"])
@pytest.mark.parametrize("name", [*SETTINGS, "shipped", "bands"])
def test_kernels_agree_with_the_cpu(name: str, precision: str) -> None:
    network = network_of(name)
    assert cuda.supports(network.settings)
    block = queries(network)
    found = cuda.CudaNetwork(network, precision, DEVICE).evaluate_block(*block)
    assert found.dtype == np.float32
    assert relative_error(found, network.prepared().evaluate_block(*block)) < TOLERANCE[precision]


def assert_same(part: np.ndarray, complete: np.ndarray) -> None:
    """Results are equal on a GPU. On a CPU, a matrix product may round by the number of its rows."""
    if REAL:
        np.testing.assert_array_equal(part, complete)
    np.testing.assert_allclose(part, complete, rtol=0, atol=2e-6 * np.abs(complete).max())


@pytest.mark.parametrize("name", ["paper", "lobes", "correction"])
def test_results_do_not_depend_on_how_blocks_are_cut(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    network = cuda.CudaNetwork(network_of(name), "float32", DEVICE)
    incident, rotation, positions, outgoing = queries(network.network)
    complete = network.evaluate_block(incident, rotation, positions, outgoing)
    for n, b in ((0, slice(None)), (1, slice(5, 6))):
        part = network.evaluate_block(incident, rotation[n : n + 1, b], positions[n : n + 1], outgoing[n : n + 1, b])
        assert_same(part, complete[n : n + 1, b])
    monkeypatch.setattr(cuda, "ROWS_PER_BATCH", 70)
    assert_same(network.evaluate_block(incident, rotation, positions, outgoing), complete)
    monkeypatch.setattr(cuda, "TABLE_ROWS", 24)
    assert_same(network.evaluate_block(incident, rotation, positions, outgoing), complete)
    again = pickle.loads(pickle.dumps(network))
    assert isinstance(again, cuda.CudaNetwork)
    assert_same(again.evaluate_block(incident, rotation, positions, outgoing), complete)


@pytest.mark.parametrize("name", ["late", "lobes", "shipped", "bands", "paths", "correction"])
def test_recorded_operations_do_not_wait_for_the_cpu(name: str) -> None:
    """CUDA refuses to record transfers from and to the CPU."""
    device = simulated_gpu.install()
    network = cuda.CudaNetwork(network_of(name), "float32", device)
    _incident, _rotation, positions, outgoing = queries(network.network)
    with torch.inference_mode():
        block = network._view_queries(positions, outgoing)
        simulated_gpu.waits.clear()
        simulated_gpu.steps.clear()
        network._view_terms(block)
    assert simulated_gpu.steps
    assert not simulated_gpu.waits


@pytest.mark.parametrize("wait", ["x[x > 0]", "x.nonzero()", "x.sum().item()", "x.cpu()"])
def test_the_simulated_gpu_notices_what_waits(wait: str) -> None:
    x = torch.arange(3.0).to(simulated_gpu.install())
    simulated_gpu.waits.clear()
    eval(wait, {"x": x})
    assert simulated_gpu.waits


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
def test_unsupported_settings_use_fused_layers(settings: NetworkSettings, hopper: None) -> None:
    assert not cuda.supports(settings)
    assert type(cuda.cuda_network(NeuralBSSRDF(settings), "float32", DEVICE)) is FusedNetwork


def test_prepared_uses_the_kernels_on_cuda(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cuda, "cuda_network", lambda _network, precision, device: (precision, device))
    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    assert NeuralBSSRDF(PAPER).prepared("bfloat16", "cuda") == ("bfloat16", "cuda")
    assert type(NeuralBSSRDF(PAPER).prepared()) is FusedNetwork
    with pytest.raises(QueryError, match="precision must be one of"):
        NeuralBSSRDF(PAPER).prepared("float16", "cuda")


def test_kernels_are_used_on_supported_gpus(hopper: None, monkeypatch: pytest.MonkeyPatch) -> None:
    network = network_of("paper")
    assert type(cuda.cuda_network(network, "float32", DEVICE)) is cuda.CudaNetwork
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda _device: (7, 5))
    assert type(cuda.cuda_network(network, "float32", DEVICE)) is FusedNetwork


def test_failing_kernels_are_replaced_with_a_warning(hopper: None, monkeypatch: pytest.MonkeyPatch) -> None:
    def failing(network: object) -> None:
        raise RuntimeError("Failed to find C compiler")

    monkeypatch.setattr(cuda, "warmed_up", failing)
    with pytest.warns(RuntimeWarning, match=r"kernels failed on .*RuntimeError: Failed to find C compiler"):
        network = cuda.cuda_network(network_of("paper"), "float32", DEVICE)
    assert type(network) is FusedNetwork


@pytest.mark.parametrize("name", ["paper", "lobes"])
def test_pairs_agree_with_the_reference(name: str) -> None:
    network = network_of(name)
    incident, rotation, positions, outgoing = queries(network)
    block = incident[rotation[:, 0]], positions, outgoing[:, 0]
    found = pair_transport(network, "float32", DEVICE).evaluate_pairs(*block)
    assert relative_error(found, network.evaluate(*block)) < 1e-5


class Stream:
    """The part of torch.cuda.Stream that is used."""

    def __init__(self, _device: object = None) -> None:
        self.waited = 0

    def wait_stream(self, other: "Stream") -> None:
        assert isinstance(other, Stream)

    def synchronize(self) -> None:
        self.waited += 1


class Graph:
    """Replays the recorded function and overwrites its outputs."""

    def __init__(self, recorded: RecordedGraph) -> None:
        self.recorded = recorded

    def replay(self) -> None:
        outputs, fresh = self.recorded._outputs, self.recorded._function(self.recorded._inputs)
        for kept, new in zip(outputs, fresh, strict=True):
            for each, its in zip(kept, new, strict=True):  # layers, views, or the tensors of lobes
                each.copy_(its)


@pytest.fixture
def simulated_streams(monkeypatch: pytest.MonkeyPatch) -> None:
    """Streams and graphs without a GPU."""
    monkeypatch.setattr(cuda, "stream", Stream)
    monkeypatch.setattr(cuda_views, "stream", Stream)
    for name, replacement in (("current_stream", Stream), ("stream", nullcontext)):
        monkeypatch.setattr(torch.cuda, name, replacement)
    monkeypatch.setattr(torch.cuda, "graph", lambda graph, capture_error_mode: nullcontext(graph))


def test_replayed_batches_leave_earlier_results_unchanged(
    simulated_streams: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    block = torch.arange(33.0).view(11, 3)
    calls = []

    def terms(views: torch.Tensor) -> ViewTerms:
        calls.append(len(views))
        return ViewTerms((2.0 * views).repeat(2, 1, 1), views[:, None] + 1.0, (views**2,), views[:, None] - 1.0)

    recorded = RecordedGraph(terms, 4, cast(torch.device, SimpleNamespace(type="cuda")))
    monkeypatch.setattr(torch.cuda, "CUDAGraph", lambda: Graph(recorded), raising=False)
    first, found = recorded(block[:3]), recorded(block)
    assert calls == [4] * 6  # warm-up, recording, four replays
    torch.testing.assert_close(found.added, (2.0 * block).repeat(2, 1, 1))
    torch.testing.assert_close(found.frame, block[:, None] + 1.0)
    torch.testing.assert_close(found.lobes, (block**2,))
    torch.testing.assert_close(found.correction, block[:, None] - 1.0)
    torch.testing.assert_close(first.frame, block[:3, None] + 1.0)
    torch.testing.assert_close(first.correction, block[:3, None] - 1.0)


@pytest.mark.skipif(REAL, reason="on a GPU, blocks cut into batches use its streams")
def test_results_are_copied_while_later_ones_are_computed(
    simulated_streams: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    network = cuda.CudaNetwork(network_of("paper"), "float32", "cpu")
    block = queries(network.network)
    complete = network.evaluate_block(*block)
    copy_stream = Stream()
    empty = torch.empty
    monkeypatch.setattr(network, "_copy_stream", copy_stream)
    monkeypatch.setattr(cuda, "ROWS_PER_BATCH", 100)
    monkeypatch.setattr(torch, "empty", lambda *size, pin_memory=False, **options: empty(*size, **options))
    assert_same(network.evaluate_block(*block), complete)
    assert copy_stream.waited == 1
