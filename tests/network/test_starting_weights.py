"""Tests of the weights of an earlier network as a start: what is copied, interpolated, begun at 0, and refused."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from formats.errors import ModelError
from prt_bake.network.bssrdf import PRESETS, NeuralBSSRDF
from prt_bake.network.features.feature_grid import FeatureGrid
from prt_bake.network.features.interior import Interior
from prt_bake.network.settings import MOST_CHANNELS, NetworkSettings
from prt_bake.network.starting_weights import start_from
from tests.network import WITHOUT_MESH
from tests.network.test_interior import RAY_SETTINGS, half_space
from tests.network.test_lobes import unit
from tests.network.test_material import ramps, random_steps, with_material

pytestmark = WITHOUT_MESH

RNG = np.random.default_rng(23)
SETTINGS = replace(RAY_SETTINGS, grid_places=8, grid_numbers=3, material_channels=MOST_CHANNELS)
LOBED = replace(SETTINGS, tells_normal=True, lobes=2)


def network(settings: NetworkSettings, interior: Interior, scale: float = 1.0) -> NeuralBSSRDF:
    return NeuralBSSRDF(settings, (0.0, 0.0, 0.0), 1.0, scale, interior=interior)


def grid_of(network: NeuralBSSRDF) -> FeatureGrid:
    assert network.view is not None
    assert network.view.grid is not None
    return network.view.grid


def trained(settings: NetworkSettings, interior: Interior) -> NeuralBSSRDF:
    """A network whose weights and learned features are all random."""
    earlier = network(settings, interior, 0.7)
    generator = torch.Generator().manual_seed(7)
    with torch.no_grad():
        for weight in earlier.parameters():
            weight.normal_(0.0, 0.2, generator=generator)
        grid_of(earlier).rows[0] = 0.0
    return earlier


def values(network: NeuralBSSRDF) -> np.ndarray:
    random = np.random.default_rng(1)
    x = random.uniform(0.1, 0.4, (20, 3))
    return network.evaluate(unit(6, 2).numpy(), x, unit(20, 3).numpy())


def start(settings: NetworkSettings, interior: Interior, earlier: NeuralBSSRDF) -> NeuralBSSRDF:
    begun = network(settings, interior)
    start_from(begun, earlier)
    return begun


@pytest.mark.parametrize("settings", [SETTINGS, LOBED])
def test_the_same_inputs_give_the_same_values(settings: NetworkSettings) -> None:
    earlier = trained(settings, with_material(ramps))
    np.testing.assert_allclose(values(start(settings, with_material(ramps), earlier)), values(earlier), atol=1e-5)


def test_inputs_that_only_one_of_them_has_change_no_value() -> None:
    """Channels of the material: none before and two now; or three now, of which none is any of the two before."""
    earlier = trained(SETTINGS, half_space(3.0))
    np.testing.assert_allclose(values(start(SETTINGS, with_material(ramps), earlier)), values(earlier), atol=1e-5)
    in_parts = replace(SETTINGS, material_parts=2)
    for interior in half_space(3.0), with_material(ramps):
        earlier = trained(replace(SETTINGS, material_parts=0), interior)
        np.testing.assert_allclose(values(start(in_parts, interior, earlier)), values(earlier), atol=1e-5)
    begun = start(SETTINGS, with_material(random_steps), trained(SETTINGS, with_material(ramps)))
    without = start(SETTINGS, half_space(3.0), trained(SETTINGS, with_material(ramps)))
    np.testing.assert_allclose(values(begun), values(without), atol=1e-5)


@pytest.mark.parametrize("before", [False, True])
def test_cosines_that_only_one_of_them_has_change_no_value(before: bool) -> None:
    """Late layers of an earlier network do not see the slopes along the view ray, or those of the new one do not."""
    narrow = replace(LOBED, shape_places=4, light_places=4, inner_bodies=False)
    wide = replace(narrow, inner_bodies=True)
    assert wide.light_axes == narrow.light_axes + 4
    earlier = trained(wide if before else narrow, half_space(3.0))
    if before:
        with torch.no_grad():
            for layer in range(narrow.trunk, narrow.layers):
                earlier.get_parameter(f"hidden.{layer}.weight")[:, -4:] = 0.0
    begun = start(narrow if before else wide, half_space(3.0), earlier)
    np.testing.assert_allclose(values(begun), values(earlier), atol=1e-5)


def test_lobes_that_only_the_new_network_has_keep_their_own_weights() -> None:
    fresh = network(LOBED, half_space(3.0))
    begun = start(LOBED, half_space(3.0), trained(replace(LOBED, lobes=0), half_space(3.0)))
    assert begun.lobes is not None
    assert fresh.lobes is not None
    torch.testing.assert_close(begun.lobes.weight, fresh.lobes.weight)
    assert start(replace(LOBED, lobes=0), half_space(3.0), trained(LOBED, half_space(3.0))).lobes is None


def test_learned_features_are_interpolated_at_the_nodes_of_another_grid() -> None:
    """Features that are linear in the position stay so on a finer grid."""
    earlier, factors = trained(SETTINGS, half_space(3.0)), RNG.normal(size=(3, 3))
    grid = grid_of(earlier)
    nodes = grid.corner + torch.nonzero(grid.row_index) / grid.per_side
    with torch.no_grad():
        grid.rows[1:] = nodes @ torch.from_numpy(factors).float()
    begun = start(replace(SETTINGS, grid_places=13), half_space(3.0), earlier)
    points = RNG.uniform(0.2, 0.4, (50, 1, 3))
    found = grid_of(begun)(torch.from_numpy(points).float(), torch.ones((50, 1)))
    np.testing.assert_allclose(found.detach().numpy(), points[:, 0] @ factors, atol=1e-4)


@pytest.mark.parametrize(
    ("other", "fault"),
    [
        (replace(SETTINGS, width=24), "width 24, that of this scene 16"),
        (replace(SETTINGS, seed=1), "seed 1, that of this scene 0"),
        (replace(SETTINGS, grid_places=0), "grid_places 0, that of this scene 8"),
    ],
)
def test_other_layers_are_refused(other: NetworkSettings, fault: str) -> None:
    begun = network(SETTINGS, half_space(3.0))
    with pytest.raises(ModelError, match=f"the network to start from has {fault}; train without the earlier one"):
        start_from(begun, network(other, half_space(3.0)))
    with pytest.raises(ModelError, match="the network to start from has features 256"):
        start_from(begun, NeuralBSSRDF(PRESETS["paper"]))
