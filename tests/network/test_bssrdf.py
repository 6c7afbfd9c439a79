"""Tests of the neural BSSRDF: its size, features, evaluation and files."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from formats.errors import ModelError, QueryError
from prt_bake.network.bssrdf import PRESETS, NetworkSettings, NeuralBSSRDF, load_model, save_model
from prt_bake.network.features.fourier import fourier_features
from prt_bake.network.features.interior import LEVELS, Interior
from tests.network import WITHOUT_MESH

pytestmark = WITHOUT_MESH

SMALL = {"features": 12, "width": 16}


def unit(rng: np.random.Generator, *shape: int) -> NDArray[np.float64]:
    vectors = rng.normal(size=(*shape, 3))
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def trained(network: NeuralBSSRDF) -> NeuralBSSRDF:
    """The network with random biases instead of 0, so that code which ignores them fails."""
    generator = torch.Generator().manual_seed(11)
    with torch.no_grad():
        for name, weights in network.named_parameters():
            if name.endswith("bias"):
                weights.normal_(0.0, 0.3, generator=generator)
    return network


@pytest.fixture(params=["paper", "measured"])
def network(request: pytest.FixtureRequest) -> NeuralBSSRDF:
    settings = PRESETS[request.param]
    # As fine as the trainer chooses it for an object that fills its box.
    settings = replace(settings, grid_places=20) if settings.grid_places else settings
    interior = rough_interior(40) if settings.ray_samples else None
    return trained(NeuralBSSRDF(settings, (-1.0, -2.0, 0.5), 3.0, output_scale=0.7, interior=interior))


def rough_interior(nodes: int) -> Interior:
    """Random levels; 40 nodes per axis take about as much space as the interior of an object."""
    levels = np.random.default_rng(7).integers(-LEVELS, LEVELS + 1, (1, *(nodes,) * 3))
    return Interior(levels.astype(np.int8), (-0.1, -0.1, -0.1), 1.2 / (nodes - 1), (4.0,), 1.4)


def test_default_network_has_the_papers_number_of_weights() -> None:
    assert sum(weights.numel() for weights in NeuralBSSRDF().parameters()) == 164_867


@pytest.mark.parametrize("suffix", [".pt", ".safetensors"])
def test_a_file_has_the_papers_size_and_restores_the_network(
    network: NeuralBSSRDF, suffix: str, tmp_path: Path
) -> None:
    network.metadata = {"up": "z", "eta": 1.3, "training": {"steps": 5}}
    path = tmp_path / f"model{suffix}"
    if network.view is not None:
        network = network.rounded()  # as the trainer writes it
    save_model(network, path)
    least, most = (640, 660) if network.view is None else (780, 960)
    assert least * 1024 <= path.stat().st_size <= most * 1024
    again = load_model(path)
    assert again.settings == network.settings
    assert again.metadata == network.metadata
    rng = np.random.default_rng(1)
    query = unit(rng, 5, 2), rng.uniform(-1, 1, (5, 3)), unit(rng, 5)
    np.testing.assert_array_equal(again.evaluate(*query), network.evaluate(*query))


def test_a_rounded_network_takes_half_the_size_and_changes_little(network: NeuralBSSRDF, tmp_path: Path) -> None:
    rounded = network.rounded()
    save_model(rounded, tmp_path / "model.pt")
    assert (tmp_path / "model.pt").stat().st_size <= (372 if network.view is None else 960) * 1024
    again = load_model(tmp_path / "model.pt")
    rng = np.random.default_rng(1)
    query = unit(rng, 64, 2), rng.uniform(-1, 1, (64, 3)), unit(rng, 64)
    np.testing.assert_array_equal(again.evaluate(*query), rounded.evaluate(*query))
    plain = network.evaluate(*query)
    assert 0.0 < np.linalg.norm(rounded.evaluate(*query) - plain) < 1e-3 * np.linalg.norm(plain)


@pytest.mark.filterwarnings("error")
def test_weights_beyond_the_range_of_float16_keep_their_value(tmp_path: Path) -> None:
    network = NeuralBSSRDF(NetworkSettings(**SMALL))
    with torch.no_grad():
        network.output.weight[0, 0], network.output.weight[0, 1] = 1e6, 1.0 / 3.0
    save_model(network.rounded(), tmp_path / "model.pt")
    kept = load_model(tmp_path / "model.pt").output.weight[0, :2].tolist()
    assert kept == [1e6, float(np.float16(1.0 / 3.0))]


def first_features(network: NeuralBSSRDF, query: list[torch.Tensor]) -> torch.Tensor:
    return fourier_features(network.inputs(*query), network.frequencies, network.settings.feature_mean)


def test_features_match_their_definition_far_from_the_origin() -> None:
    """cos 2πGu and sin 2πGu in float64, with mean 18 and an object a million units away."""
    box_min = np.array([1e6, -2e6, 3e6])
    network = NeuralBSSRDF(box_min=box_min, box_side=2.0)
    rng = np.random.default_rng(2)
    wi, wo, relative = unit(rng, 50), unit(rng, 50), rng.uniform(0, 1, (50, 3))
    angles = [
        np.stack([np.arccos(w[:, 2]) / np.pi, np.arctan2(w[:, 1], w[:, 0]) % (2 * np.pi) / (2 * np.pi)], axis=1)
        for w in (wi, wo)
    ]
    u = np.concatenate([angles[0], relative, angles[1]], axis=1)
    phase = 2 * np.pi * u @ network.frequencies.double().numpy().T
    query = [torch.as_tensor(array) for array in (wi, box_min + 2.0 * relative, wo)]
    features = first_features(network, query).numpy()
    np.testing.assert_allclose(features, np.concatenate([np.cos(phase), np.sin(phase)], axis=1), atol=2e-5)


def test_forward_is_the_architecture_of_the_paper() -> None:
    """Five hidden layers, layer 1 concatenated to layer 3's input and layer 2 to layer 4's, written out."""
    network = trained(NeuralBSSRDF(NetworkSettings(**SMALL), output_scale=2.0))
    rng = np.random.default_rng(3)
    query = [torch.as_tensor(array) for array in (unit(rng, 7), rng.uniform(0, 1, (7, 3)), unit(rng, 7))]
    w = {name: weights.detach().double().numpy() for name, weights in network.named_parameters()}
    x = first_features(network, query).double().numpy()

    def layer(number: int, h: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.maximum(h @ w[f"hidden.{number - 1}.weight"].T + w[f"hidden.{number - 1}.bias"], 0.0)

    h1 = layer(1, x)
    h2 = layer(2, h1)
    h3 = layer(3, np.concatenate([h2, h1], axis=1))
    h4 = layer(4, np.concatenate([h3, h2], axis=1))
    expected = 2.0 * (layer(5, h4) @ w["output.weight"].T + w["output.bias"])
    np.testing.assert_allclose(network(*query).detach().numpy(), expected, atol=1e-5)


def test_late_layers_see_the_incident_direction() -> None:
    """Two of four layers see ωi and powers of ωi·ωo, written out; skips lead from 1 to 3 and from 2 to 4."""
    late: dict[str, Any] = {"light_layers": 2, "light_features": 5, "light_spread": 0.4, "angle_powers": 3}
    settings = NetworkSettings(6, 0.0, 0.5, 8, 4, ((1, 3), (2, 4)), "silu", "cartesian", **late)
    network = trained(NeuralBSSRDF(settings, output_scale=2.0))
    rng = np.random.default_rng(8)
    wi, x, wo = unit(rng, 7, 3), rng.uniform(0, 1, (7, 3)), unit(rng, 7)
    w = {name: weights.detach().double().numpy() for name, weights in network.named_parameters()}

    def features(vectors: NDArray[np.float64], frequencies: torch.Tensor) -> NDArray[np.float64]:
        phase = 2 * np.pi * vectors @ frequencies.double().numpy().T
        return np.concatenate([np.cos(phase), np.sin(phase)], axis=-1)

    def layer(number: int, *parts: NDArray[np.float64]) -> NDArray[np.float64]:
        h = np.concatenate(parts, axis=-1) @ w[f"hidden.{number - 1}.weight"].T + w[f"hidden.{number - 1}.bias"]
        return h / (1.0 + np.exp(-h))

    cosine = np.einsum("ndk,nk->nd", wi, wo)[..., None]
    light = np.concatenate([features(wi, network.light_frequencies), cosine, cosine**2, cosine**3], axis=-1)
    h1 = layer(1, np.repeat(features(np.concatenate([x, wo], axis=1), network.frequencies)[:, None], 3, axis=1))
    h2 = layer(2, h1)
    h3 = layer(3, h2, h1, light)
    h4 = layer(4, h3, h2, light)
    expected = 2.0 * (h4 @ w["output.weight"].T + w["output.bias"])
    query = [torch.as_tensor(array) for array in (wi, x, wo)]
    np.testing.assert_allclose(network.radiance(*query).detach().numpy(), expected, atol=1e-5)
    np.testing.assert_allclose(network.evaluate(wi, x, wo), expected, atol=1e-5)


@pytest.mark.parametrize(("precision", "tolerance"), [("float32", 2e-5), ("bfloat16", 3e-2)])
def test_a_fused_block_agrees_with_the_reference(network: NeuralBSSRDF, precision: str, tolerance: float) -> None:
    rng = np.random.default_rng(4)
    incident, rotation = unit(rng, 4, 10), rng.integers(0, 4, (3, 70))
    positions, outgoing = rng.uniform(-1, 2, (3, 3)), unit(rng, 3, 70)
    block = network.prepared(precision).evaluate_block(incident, rotation, positions, outgoing)
    plain = network.evaluate(
        incident[rotation].reshape(-1, 10, 3), np.repeat(positions, 70, axis=0), outgoing.reshape(-1, 3)
    )
    assert block.shape == (3, 70, 10, 3)
    np.testing.assert_allclose(block.reshape(plain.shape), plain, atol=tolerance * np.abs(plain).max())


@pytest.mark.parametrize("late", [0, 1, 2, 3])
@pytest.mark.parametrize("activation", ["relu", "silu"])
def test_a_fused_block_supports_all_settings(activation: str, late: int) -> None:
    """Odd widths, other skips and activations; more directions than a tile or a table holds."""
    skips = ((1, 3), (1, 4), (2, 4))
    options: dict[str, Any] = {"activation": activation, "light_layers": late, "angle_powers": max(0, late - 1)}
    settings = NetworkSettings(5, 0.5, 1.0, 7, 4, skips, directions="cartesian", **options)
    network = trained(NeuralBSSRDF(settings))
    rng = np.random.default_rng(5)
    incident, positions, outgoing = unit(rng, 20, 900), rng.uniform(0, 1, (1, 3)), unit(rng, 1, 3)
    rotation = np.array([[19, 0, 7]])
    block = network.evaluate_block(incident, rotation, positions, outgoing)
    plain = network.evaluate(incident[rotation[0]], np.repeat(positions, 3, axis=0), outgoing[0])
    np.testing.assert_allclose(block[0], plain, atol=2e-5 * np.abs(plain).max())


def test_powers_of_the_cosine_need_late_layers() -> None:
    with pytest.raises(ModelError, match="angle_powers must not be negative, and must be 0 without light_layers"):
        NetworkSettings(angle_powers=2)
    with pytest.raises(ModelError, match="found -1"):
        NetworkSettings(light_layers=1, angle_powers=-1)


LATE = NetworkSettings(features=9, directions="cartesian", light_layers=2, angle_powers=2)


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_a_block_does_not_depend_on_how_it_is_cut(network: NeuralBSSRDF, precision: str) -> None:
    assert_cuts_agree(network, precision)


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_a_block_with_late_layers_does_not_depend_on_how_it_is_cut(precision: str) -> None:
    assert_cuts_agree(trained(NeuralBSSRDF(LATE)), precision)


def assert_cuts_agree(network: NeuralBSSRDF, precision: str) -> None:
    """156 bins of 13 directions fill a tile; 2,100 are more than a batch of views."""
    rng = np.random.default_rng(6)
    incident, rotation = unit(rng, 8, 13), rng.integers(0, 8, (3, 700))
    positions, outgoing = rng.uniform(0, 1, (3, 3)), unit(rng, 3, 700)
    fused = network.prepared(precision)
    complete = fused.evaluate_block(incident, rotation, positions, outgoing)
    part = fused.evaluate_block(incident, rotation[1:2, 3:], positions[1:2], outgoing[1:2, 3:])
    np.testing.assert_array_equal(part, complete[1:2, 3:])


def test_shared_directions_equal_separate_ones(network: NeuralBSSRDF) -> None:
    rng = np.random.default_rng(7)
    incident, positions, outgoing = unit(rng, 6), rng.uniform(0, 1, (4, 3)), unit(rng, 4)
    separate = np.broadcast_to(incident, (4, 6, 3))
    np.testing.assert_array_equal(
        network.evaluate(incident, positions, outgoing), network.evaluate(separate, positions, outgoing)
    )


def test_preparing_leaves_the_network_unchanged(network: NeuralBSSRDF) -> None:
    network.train()
    network.prepared("bfloat16")
    assert network.training
    assert network.output.weight.dtype is torch.float32


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("colour", 1, "unknown key 'colour'"),
        ("width", "wide", "width must be of type int"),
        ("skips", [[3, 1]], r"skip \(3, 1\)"),
        ("skips", 4, "pairs"),
        ("layers", 0, "layers must be at least 1"),
        ("activation", "sine", "activation must be relu or silu"),
    ],
)
def test_inconsistent_settings_are_refused(key: str, value: object, message: str) -> None:
    with pytest.raises(ModelError, match=message):
        NetworkSettings.from_json(NetworkSettings().as_json() | {key: value})


def test_settings_survive_json() -> None:
    for settings in PRESETS.values():
        assert NetworkSettings.from_json(json.loads(json.dumps(settings.as_json()))) == settings


def test_an_unsound_network_does_not_replace_a_good_file(tmp_path: Path) -> None:
    path = tmp_path / "model.pt"
    network = NeuralBSSRDF(NetworkSettings(**SMALL))
    save_model(network, path)
    before = path.read_bytes()
    with torch.no_grad():
        network.output.bias[1] = torch.inf
    with pytest.raises(ModelError, match=r"output\.bias holds 1 value"):
        save_model(network, path)
    assert path.read_bytes() == before


def test_an_unknown_precision_is_refused(network: NeuralBSSRDF) -> None:
    with pytest.raises(QueryError, match="float32, bfloat16"):
        network.prepared("float16")
