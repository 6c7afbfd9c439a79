"""Tests of the shape features: occupancies and slopes in closed form, and points along view rays."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.ndimage import map_coordinates
from scipy.stats import norm

from formats.errors import ModelError
from prt_bake.network.bssrdf import NeuralBSSRDF
from prt_bake.network.features.shape import SHAPE_SCALES, shape_grid, trilinear
from prt_bake.network.features.view_kernel import shape_rows
from prt_bake.network.settings import SHAPE_INPUTS, NetworkSettings
from tests.network.test_interior import RAY_SETTINGS as BASE
from tests.network.test_interior import features, half_space
from tests.network.test_lobes import glass_ball, unit

SETTINGS = replace(BASE, shape_places=4)
RNG = np.random.default_rng(8)
OCCUPANCY_SCALE, SLOPE_SCALE = 5.0, 7.0


def by_scale(features_of_shape: torch.Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Occupancies [N,S] and slopes per standard deviation [N,S,3] of features [N,SHAPE_INPUTS]."""
    numbers = features_of_shape.double().numpy().reshape(len(features_of_shape), len(SHAPE_SCALES), 4)
    return numbers[..., 0] / OCCUPANCY_SCALE + 0.5, numbers[..., 1:] / SLOPE_SCALE


def test_occupancy_behind_a_flat_wall_is_a_gaussian_integral() -> None:
    wall = half_space()
    heights = np.linspace(0.3, 0.7, 41)
    at = np.stack([np.full(41, 0.5), np.full(41, 0.47), heights], axis=1)
    share, slope = by_scale(trilinear(shape_grid(wall), wall.spacing, torch.from_numpy(at + 0.5).float()))
    depth = (0.5 - heights)[:, None] / SHAPE_SCALES
    for scale, sigma in enumerate(SHAPE_SCALES):
        # The narrowest Gaussian is narrower than the spacing of the grid.
        tolerance = 0.15 * (wall.spacing / sigma) ** 2 + 1e-3
        np.testing.assert_allclose(share[:, scale], norm.cdf(depth[:, scale]), atol=0.5 * tolerance)
        np.testing.assert_allclose(-slope[:, scale, 2], norm.pdf(depth[:, scale]), atol=tolerance)
        np.testing.assert_allclose(slope[:, scale, :2], 0.0, atol=1e-5)


def test_occupancy_in_a_ball_matches_random_points() -> None:
    """Half a million samples per point, within 4.5 standard errors and the rounding of the grid."""
    ball = glass_ball(1.0)
    at = np.array([[0.5, 0.5, 0.5], [0.95, 0.5, 0.5], [0.5, 0.1, 0.5], [0.76, 0.76, 0.76], [0.5, 0.5, 1.0]])
    share, _ = by_scale(trilinear(shape_grid(ball), ball.spacing, torch.from_numpy(at + 0.1).float()))
    offsets = RNG.normal(size=(500_000, 3))
    for scale, sigma in enumerate(SHAPE_SCALES):
        for place, found in zip(at, share[:, scale], strict=True):
            inside = (np.linalg.norm(place + sigma * offsets - 0.5, axis=1) < 0.45).mean()
            tolerance = 4.5 * np.sqrt(inside * (1.0 - inside) / len(offsets)) + 0.05 * (0.015 / sigma) ** 2
            assert abs(found - inside) <= tolerance + 0.002


def test_slopes_are_the_differences_of_occupancies() -> None:
    """Also at the border of the grid, where the object does not end."""
    ball = glass_ball(1.0)
    values = shape_grid(ball).double().numpy().reshape(*ball.levels.shape[1:], len(SHAPE_SCALES), 4)
    share = values[..., 0] / OCCUPANCY_SCALE
    for axis in range(3):
        for scale, sigma in enumerate(SHAPE_SCALES):
            expected = np.gradient(share[..., scale], ball.spacing, axis=axis) * sigma
            inner = tuple(slice(1, -1) for _ in range(3))
            found = values[..., scale, 1 + axis] / SLOPE_SCALE
            np.testing.assert_allclose(found[inner], expected[inner], atol=1e-5)
            assert np.abs(found).max() <= 0.45


def test_torch_and_compiled_interpolation_match_scipy() -> None:
    """Inside the grid, on its last nodes and far outside."""
    grid = torch.from_numpy(RNG.normal(size=(7, 8, 9, SHAPE_INPUTS)).astype(np.float32))
    at = np.concatenate([RNG.uniform(-0.5, 1.5, (300, 3)), [[0.0, 0.0, 0.0], [0.6, 0.7, 0.8], [1e6, -1e6, 0.3]]])
    at = at.astype(np.float32)
    places = at.astype(np.float64).T / 0.1
    exact = np.stack(
        [map_coordinates(grid[..., c].numpy(), places, order=1, mode="nearest") for c in range(SHAPE_INPUTS)], 1
    )
    rows = np.empty_like(exact, dtype=np.float32)
    shape_rows(grid.numpy(), np.float32(1.0 / 0.1), at, rows)
    np.testing.assert_allclose(rows, exact, atol=2e-4)
    np.testing.assert_allclose(trilinear(grid, 0.1, torch.from_numpy(at)).numpy(), exact, atol=2e-4)


@pytest.mark.parametrize(("places", "samples"), [(1, []), (2, [6]), (4, [2, 6, 10]), (5, [1, 4, 7, 10])])
def test_shape_points_are_x_and_samples_of_the_ray(places: int, samples: list[int]) -> None:
    wall, chosen = half_space(5.0), replace(SETTINGS, tells_normal=False, low_axes=False, shape_places=places)
    view = features(wall, chosen)
    x = torch.from_numpy(RNG.uniform(0.3, 0.49, (30, 3))).float()
    eye = unit(30, 1).float()
    found = view(x, eye)
    begins = 2 * chosen.features + chosen.ray_samples + 1
    assert found.shape[1] == chosen.view_inputs == begins + SHAPE_INPUTS * places
    # The lengths are inputs, too, over half of the maximum.
    lengths = found[:, 2 * chosen.features : begins - 1] * 0.5 * float(view.edges[-1])
    along = torch.cat((torch.zeros(30, 1), lengths[:, samples]), dim=1)
    at = (x[:, None] - along[..., None] * eye[:, None] - view.corner).reshape(-1, 3)
    expected = trilinear(view.shape, wall.spacing, at).reshape(30, -1)
    np.testing.assert_allclose(found[:, begins:].numpy(), expected.numpy(), atol=2e-3)


def test_networks_without_shape_places_have_no_shape_grid() -> None:
    view = features(half_space(), replace(SETTINGS, shape_places=0))
    assert view.shape.numel() == 0
    assert view(torch.full((1, 3), 0.4), torch.tensor([[0.0, 0.0, 1.0]])).shape[1] == view_inputs(0)
    network = NeuralBSSRDF(SETTINGS, interior=half_space())
    assert not any("shape" in name for name in network.state_dict())


def view_inputs(places: int) -> int:
    return replace(SETTINGS, shape_places=places).view_inputs


@pytest.mark.parametrize("places", [-1, 13])
def test_more_shape_points_than_ray_samples_are_refused(places: int) -> None:
    with pytest.raises(ModelError, match=r"shape_places must be from 0 to ray_samples \(12\), found"):
        replace(SETTINGS, shape_places=places)
    with pytest.raises(ModelError, match="shape_places"):
        NetworkSettings(shape_places=1)
