"""Tests of the grid of learned features: its nodes, its sums and gradients, and its storage."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.ndimage import map_coordinates

from formats.errors import ModelError
from prt_bake.network.bssrdf import PRESETS, NeuralBSSRDF, load_model, save_model
from prt_bake.network.features.feature_grid import FeatureGrid, kept_places
from prt_bake.network.features.interior import LEVELS, Interior
from prt_bake.network.settings import NetworkSettings
from prt_bake.trainer.interior import MOST_LEARNED_BYTES, interior_of, with_fitting_grid
from prt_bake.trainer.train import train
from prt_bake.trainer.training_data import box_of
from tests.network import WITHOUT_MESH
from tests.network.test_interior import RAY_SETTINGS, features, full, half_space
from tests.network.test_lobes import glass_ball, unit
from tests.shapes import ball
from tests.tracer.scenes import make_scene
from tests.trainer import small_training

pytestmark = WITHOUT_MESH

RNG = np.random.default_rng(12)
GRIDDED = replace(RAY_SETTINGS, grid_places=16, grid_numbers=3)


def solid(nodes: int = 21) -> Interior:
    """Inside everywhere in the unit box and a margin of a tenth around it."""
    return Interior(np.full((1, *(nodes,) * 3), LEVELS, np.int8), (-0.1,) * 3, 1.2 / (nodes - 1), (3.0,), 1.0)


def randomised(grid: FeatureGrid) -> FeatureGrid:
    """The grid with random features, 0 for nodes that are not stored."""
    with torch.no_grad():
        grid.rows[1:] = torch.from_numpy(RNG.normal(size=(len(grid.rows) - 1, grid.rows.shape[1]))).float()
    return grid


def test_sums_match_scipys_trilinear_interpolation() -> None:
    """Inside, on the last nodes and outside, where values are clamped to the border."""
    grid = randomised(FeatureGrid(solid(), 10, 4, 3.0))
    shape = grid.row_index.shape
    assert tuple(shape) == (13, 13, 13)
    dense = grid.rows[grid.row_index].detach().double().numpy()
    points = RNG.uniform(-0.3, 1.3, (50, 6, 3))
    weights = RNG.uniform(0.0, 2.0, (50, 6))
    at = ((points + 0.1) * 10).reshape(-1, 3).T
    values = np.stack([map_coordinates(dense[..., c], at, order=1, mode="nearest") for c in range(4)], axis=-1)
    exact = (values.reshape(50, 6, 4) * weights[..., None]).sum(axis=1)
    for torch_only in (False, True):
        grid.torch_only = torch_only
        found = grid(torch.from_numpy(points).float(), torch.from_numpy(weights).float())
        np.testing.assert_allclose(found.detach().numpy(), exact, atol=2e-4)


def test_gradients_of_kernel_and_tensors_agree() -> None:
    """Under autocast, as in training."""
    grid = randomised(FeatureGrid(half_space(), 12, 5, 0.3))
    points, weights = torch.from_numpy(RNG.uniform(0, 1, (60, 7, 3))).float(), torch.from_numpy(RNG.random((60, 7)))
    towards = torch.from_numpy(RNG.normal(size=(60, 5))).float()
    found = []
    for torch_only in (False, True):
        grid.torch_only = torch_only
        grid.rows.grad = None
        with torch.autocast("cpu", torch.bfloat16):
            torch.autograd.backward((grid(points, weights.float()) * towards).sum())
        assert grid.rows.grad is not None
        found.append(grid.rows.grad.numpy())
    assert np.abs(found[0]).max() > 1.0
    assert not found[0][0].any()
    np.testing.assert_allclose(found[0], found[1], atol=1e-4)


def test_nodes_that_are_not_stored_stay_zero_in_training() -> None:
    """Half of the points are above the boundary, which is at ½."""
    grid = FeatureGrid(half_space(), 10, 2, 0.15)
    optimizer = torch.optim.Adam(grid.parameters(), lr=0.1)
    for _ in range(20):
        points = torch.from_numpy(RNG.uniform(0.0, 1.0, (200, 4, 3))).float()
        optimizer.zero_grad()
        torch.autograd.backward((grid(points, torch.ones(200, 4)) - 1.0).square().mean())
        optimizer.step()
    assert bool((grid.rows[0] == 0.0).all())
    assert float(grid.rows[1:].detach().abs().max()) > 0.1
    above = grid(torch.tensor([[[0.5, 0.5, 0.95]]]), torch.ones(1, 1))
    assert bool((above == 0.0).all())


@pytest.mark.parametrize("reach", [0.1, 0.3, 3.0])
def test_nodes_are_kept_where_view_rays_reach(reach: float) -> None:
    """A ball: its surface and everything less deep than `reach` is kept, and nothing two cells further."""
    interior = glass_ball(1.0)
    kept = kept_places(interior, 25, reach)
    grid = FeatureGrid(interior, 25, 1, reach)
    outward = unit(4000, 1).double().numpy()
    depth = RNG.uniform(0.0, min(reach, 0.45), (4000, 1))
    points = torch.from_numpy(0.5 + (0.45 - depth) * outward).float()[:, None]
    rows, shares = grid._neighbours(points)
    assert float((shares * (rows == 0)).sum() / shares.sum()) < 1e-3
    places = np.argwhere(kept) / 25 - 0.1
    depths = 0.45 - np.linalg.norm(places - 0.5, axis=1)
    assert depths.min() >= -2.0 * np.sqrt(3.0) / 25
    assert depths.max() <= reach + 3.0 * np.sqrt(3.0) / 25


@pytest.mark.parametrize("level", [3, -3])
def test_the_object_may_be_thinner_than_a_cell(level: int) -> None:
    """A plate of a fifth of a cell, between two planes of nodes; or so thin that no node of the interior is in it."""
    levels = np.full((1, 51, 51, 51), -LEVELS, np.int8)
    levels[0, :, :, 23] = level
    plate = Interior(levels, (0.0,) * 3, 0.02, (3.0,), 1.0)
    kept = kept_places(plate, 10, 0.2)
    assert kept[:, :, 4:6].all()
    assert not kept[:, :, :4].any()
    assert not kept[:, :, 6:].any()


def test_inputs_are_the_features_at_x_and_their_mean_along_the_ray() -> None:
    chosen = replace(GRIDDED, tells_normal=False)
    view, without = features(half_space(), chosen), features(half_space(), replace(chosen, grid_places=0))
    assert view.grid is not None
    randomised(view.grid)
    x, eye = torch.from_numpy(RNG.uniform(0.2, 0.49, (40, 3))).float(), unit(40, 2).float()
    found, rest = view(x, eye).detach(), without(x, eye)
    assert found.shape[1] == chosen.view_inputs == rest.shape[1] + 6
    np.testing.assert_array_equal(found[:, 6:].numpy(), rest.numpy())
    encoding = view.encode(x, eye)
    points, weight = encoding.points, encoding.weight
    one = torch.ones(40, 1)
    at_x = view.grid(x[:, None], one)
    mean = torch.stack([view.grid(points[:, [k]], one) for k in range(12)]).mean(dim=0) * weight[:, None]
    np.testing.assert_allclose(found[:, :6].numpy(), torch.cat((at_x, mean), dim=1).detach().numpy(), atol=1e-5)


def test_a_file_stores_the_learned_features(tmp_path: Path) -> None:
    network = NeuralBSSRDF(GRIDDED, interior=glass_ball(1.3))
    assert network.view is not None
    assert network.view.grid is not None
    randomised(network.view.grid)
    query = unit(6, 3).numpy().reshape(3, 2, 3), RNG.uniform(0.1, 0.9, (3, 3)), unit(3, 4).numpy()
    save_model(network, tmp_path / "model.pt")
    np.testing.assert_array_equal(load_model(tmp_path / "model.pt").evaluate(*query), network.evaluate(*query))
    with torch.no_grad():
        network.view.grid.rows.zero_()
    assert not np.array_equal(load_model(tmp_path / "model.pt").evaluate(*query), network.evaluate(*query))


@pytest.mark.statistics
def test_the_trainer_chooses_the_finest_grid_that_fits(tmp_path: Path) -> None:
    scene = make_scene(tmp_path, ball(4), sigma_t=0.5)
    interior = interior_of(scene, box_of(scene))
    fitting = with_fitting_grid(PRESETS["measured"], interior)
    bytes_at = {
        n: 16 * int(kept_places(interior, n, 3.0).sum()) for n in (fitting.grid_places, fitting.grid_places + 1)
    }
    first, second = bytes_at.values()
    assert first <= MOST_LEARNED_BYTES < second
    chosen = replace(RAY_SETTINGS, grid_places=40)
    options = {"stream": small_training.STREAM, "learning": small_training.LEARNING, "steps": 3, "synchronous": True}
    network = train(scene, settings=chosen, **options)
    fitting = replace(with_fitting_grid(chosen, interior), tells_normal=False, inner_bodies=False)
    assert network.settings == replace(fitting, low_width=0, low_axes=False)
    assert network.settings.grid_places < 40
    assert network.view is not None
    assert network.view.grid is not None
    assert bool(network.view.grid.rows.any())
    assert with_fitting_grid(replace(PRESETS["measured"], grid_places=5), interior).grid_places == 5
    assert with_fitting_grid(replace(PRESETS["measured"], grid_places=0), interior).grid_places == 0


def test_inconsistent_grid_settings_are_refused() -> None:
    for broken in ({"grid_places": -1}, {"grid_places": 129}, {"grid_numbers": 0}, {"grid_numbers": 65}):
        with pytest.raises(ModelError, match="grid_places must be from 0 to 128 and grid_numbers from 1 to 64, found"):
            replace(RAY_SETTINGS, **broken)
    with pytest.raises(ModelError, match="grid_places needs ray_samples"):
        NetworkSettings(grid_places=8)
    assert FeatureGrid(full(), 4, 2, 0.1).rows.shape[1] == 2
