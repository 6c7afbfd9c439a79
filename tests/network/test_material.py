"""Tests of what a network sees of the material: its storage, its grid, and the inputs along view rays."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from formats.errors import ModelError
from prt_bake.inspection.model import describe
from prt_bake.network.bssrdf import NeuralBSSRDF, load_model, save_model
from prt_bake.network.features.feature_grid import kept_places
from prt_bake.network.features.interior import Interior
from prt_bake.network.features.material import STEPS, Material, material_grid
from prt_bake.network.features.view_features import ViewFeatures
from prt_bake.network.settings import INPUTS_PER_CHANNEL, MATERIAL_BLURS, MOST_CHANNELS
from tests.network.test_interior import RAY_SETTINGS, half_space, unit

PER_SIDE = 8
PARTS = 3
SETTINGS = replace(RAY_SETTINGS, tells_normal=False, material_channels=MOST_CHANNELS, material_parts=PARTS)
PER_CHANNEL = INPUTS_PER_CHANNEL + PARTS
RNG = np.random.default_rng(17)


def reach_of(interior: Interior) -> float:
    return float(ViewFeatures(SETTINGS, torch.zeros(SETTINGS.features, 6), interior).edges[-1])


def with_material(value: Any, attenuation: float = 3.0) -> Interior:
    """A half-space whose channels at a place [K,3] are value(place) [K,C], in steps."""
    interior = half_space(attenuation)
    nodes = np.argwhere(kept_places(interior, PER_SIDE, reach_of(interior)))
    rows = value(np.array(interior.corner) + nodes / PER_SIDE)
    return replace(interior, material=Material(PER_SIDE, np.rint(rows).astype(np.uint8)))


def ramps(places: np.ndarray) -> np.ndarray:
    """Two channels that are linear in x and in y."""
    return np.stack([8.0 * (places[:, 0] + 0.5), 8.0 * (places[:, 1] + 0.5) + 4.0], axis=1)


def random_steps(places: np.ndarray) -> np.ndarray:
    return np.random.default_rng(3).integers(0, STEPS + 1, (len(places), 3))


def features_of(interior: Interior) -> ViewFeatures:
    frequencies = torch.from_numpy(np.random.default_rng(5).normal(size=(SETTINGS.features, 6)))
    return ViewFeatures(SETTINGS, frequencies, interior)


def inputs(view: ViewFeatures, x: torch.Tensor, eye: torch.Tensor) -> np.ndarray:
    """The inputs that come from the material, which are the last ones of these networks."""
    return view.encode(x, eye).features[:, -PER_CHANNEL * view.interior.channels :].numpy()


def test_inputs_are_the_values_at_x_and_their_means_along_the_ray_and_its_parts() -> None:
    """Of linear channels, without blur, up to one factor and one constant for each channel."""
    view = features_of(with_material(ramps))
    x = torch.from_numpy(RNG.uniform(0.1, 0.4, (50, 3))).float()
    eye = torch.nn.functional.normalize(unit(50).float() + torch.tensor([0.0, 0.0, 2.0]), dim=1)
    found, blurs = inputs(view, x, eye), len(MATERIAL_BLURS)
    points = view.encode(x, eye).points
    thirds = points.reshape(50, PARTS, -1, 3).mean(dim=2)
    for channel in range(2):
        at_x, along, in_parts = found[:, channel], found[:, 2 * blurs + channel], found[:, 4 * blurs + channel :: 2]
        factor, constant = np.polyfit(x[:, channel].numpy(), at_x, 1)
        assert factor > 1.0
        np.testing.assert_allclose(at_x, factor * x[:, channel].numpy() + constant, atol=1e-4)
        np.testing.assert_allclose(along, factor * points.mean(dim=1)[:, channel].numpy() + constant, atol=1e-4)
        np.testing.assert_allclose(in_parts, factor * thirds[..., channel].numpy() + constant, atol=1e-4)


def test_channels_have_mean_0_and_the_same_variance() -> None:
    interior = with_material(random_steps)
    assert interior.material is not None
    kept = kept_places(interior, PER_SIDE, reach_of(interior))
    values = material_grid(interior.material, kept).numpy()[kept]
    np.testing.assert_allclose(values[:, :3].mean(axis=0), 0.0, atol=1e-4)
    np.testing.assert_allclose(values[:, :3].std(axis=0), 2.0, rtol=1e-4)


def test_blurs_are_means_over_the_stored_nodes() -> None:
    """By sums over all nodes, also beside the boundary, where nodes are missing."""
    interior = with_material(random_steps)
    assert interior.material is not None
    kept = kept_places(interior, PER_SIDE, reach_of(interior))
    grid = material_grid(interior.material, kept).numpy()
    nodes = np.argwhere(kept)
    for number, blur in enumerate(MATERIAL_BLURS[1:], start=1):
        for node in nodes[RNG.choice(len(nodes), 20)]:
            distance = np.abs(nodes - node)
            sigma = blur * PER_SIDE
            weights = np.exp(-0.5 * (distance**2).sum(axis=1) / sigma**2)
            weights[(distance > int(4.0 * sigma + 0.5)).any(axis=1)] = 0.0
            expected = weights @ grid[tuple(nodes.T)][:, :3] / weights.sum()
            np.testing.assert_allclose(grid[tuple(node)][3 * number : 3 * number + 3], expected, atol=1e-4)


def test_the_compiled_values_are_torch_s() -> None:
    view = features_of(with_material(random_steps))
    x, eye = torch.from_numpy(RNG.uniform(-0.2, 1.1, (200, 3))).float(), unit(200).float()
    compiled = inputs(view, x, eye)
    view.torch_only = True
    np.testing.assert_allclose(compiled, inputs(view, x, eye), atol=2e-4)


def test_a_network_without_a_material_has_no_such_inputs() -> None:
    network = NeuralBSSRDF(SETTINGS, interior=half_space())
    assert network.settings.material_channels == 0
    assert network.settings.view_inputs == SETTINGS.view_inputs - PER_CHANNEL * MOST_CHANNELS


def test_more_channels_than_the_settings_allow_are_refused() -> None:
    with pytest.raises(ModelError, match=r"3 channels of a material, more than material_channels in the settings, 2"):
        NeuralBSSRDF(replace(SETTINGS, material_channels=2), interior=with_material(random_steps))
    with pytest.raises(ModelError, match=r"material_channels must be from 0 to 8, found 9"):
        replace(SETTINGS, material_channels=9)


@pytest.mark.parametrize("parts", [-1, 5])
def test_parts_divide_the_samples_of_the_ray(parts: int) -> None:
    with pytest.raises(ModelError, match=rf"material_parts must divide ray_samples \(12\) or be 0, found {parts}"):
        replace(SETTINGS, material_parts=parts)


@pytest.mark.parametrize("suffix", [".pt", ".safetensors"])
def test_a_file_restores_a_network_with_a_material(tmp_path: Path, suffix: str) -> None:
    network = NeuralBSSRDF(SETTINGS, (-1.0, 0.0, 2.0), 3.0, 0.2, interior=with_material(random_steps))
    path = tmp_path / f"model{suffix}"
    save_model(network, path)
    again = load_model(path)
    assert again.settings == network.settings
    assert again.settings.material_channels == 3
    query = unit(6).numpy()[None].repeat(4, 0), RNG.uniform(-1, 3, (4, 3)), unit(4).numpy()
    np.testing.assert_array_equal(again.evaluate(*query), network.evaluate(*query))
    assert describe(path)["interior: material"]["channels"] == 3


def test_the_material_is_part_of_a_bake_s_identity() -> None:
    """Another step at one node is another bake."""
    interior = with_material(random_steps)
    assert interior.material is not None
    rows = interior.material.rows.copy()
    rows[7, 1] = (rows[7, 1] + 1) % STEPS
    other = replace(interior, material=Material(PER_SIDE, rows))
    assert other.content_hash != interior.content_hash


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"per_side": 0}, "per_side of the material: expected 1 to 128, found 0"),
        ({"nodes": 2.0}, "nodes of the material"),
        ({"channels": 9}, "channels of the material: expected 1 to 8, found 9"),
        ({"channels": 2}, "its material hold"),
    ],
)
def test_an_inconsistent_material_is_refused(change: dict[str, Any], message: str) -> None:
    material = with_material(random_steps).material
    assert material is not None
    with pytest.raises(ModelError, match=message):
        Material.unpacked(material.as_json() | change, material.packed())


def test_a_step_out_of_range_is_refused() -> None:
    material = Material(4, np.full((5, 1), STEPS + 1, np.uint8))
    with pytest.raises(ModelError, match="steps up to 31, found 32"):
        Material.unpacked(material.as_json(), material.packed())


def test_a_material_of_other_nodes_is_refused() -> None:
    interior = with_material(random_steps)
    assert interior.material is not None
    fewer = replace(interior, material=Material(PER_SIDE, interior.material.rows[1:]))
    with pytest.raises(ModelError, match=r"its material has \d+ nodes, but view rays pass \d+"):
        NeuralBSSRDF(SETTINGS, interior=fewer)


def test_a_file_without_half_of_its_material_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "model.pt"
    save_model(NeuralBSSRDF(SETTINGS, interior=with_material(random_steps)), path)
    content = torch.load(path, weights_only=True)
    without = {name: tensor for name, tensor in content["tensors"].items() if name != "material"}
    torch.save({**content, "tensors": without}, path)
    with pytest.raises(ModelError, match=r"model\.pt: interior: its material is missing in part"):
        load_model(path)


def test_a_material_of_too_many_nodes_is_refused_before_memory_is_reserved() -> None:
    interior = half_space()
    with pytest.raises(ModelError, match=r"128 nodes per box side has about 1\.\d+e\+07 nodes"):
        replace(interior, material=Material(128, np.zeros((8, 1), np.uint8)))
