"""Tests of the occupancy along light rays, in a pyramid of grids."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.ndimage import map_coordinates

from formats.errors import ModelError
from prt_bake.network.bssrdf import NetworkSettings, NeuralBSSRDF, load_model, save_model
from prt_bake.network.features.interior import LEVELS, REACH, Interior
from prt_bake.network.features.light_ray import DISTANCE_RATIO, FIRST_DISTANCE, LightRay
from prt_bake.network.features.shape import shape_grid, trilinear
from prt_bake.network.inference.pairs import PairNetwork
from tests.network import WITHOUT_MESH
from tests.network.test_bssrdf import rough_interior, trained, unit
from tests.network.test_interior import RAY_SETTINGS as BASE
from tests.network.test_interior import half_space

pytestmark = WITHOUT_MESH

SETTINGS = replace(BASE, ray_samples=12, light_places=8, light_cosines=False)
OCCUPANCY_SCALE = 5.0
RNG = np.random.default_rng(12)


def ball(nodes: int, radius: float = 0.3) -> Interior:
    """A ball about (½, ½, ½) in a box of side 1."""
    spacing = 1.2 / (nodes - 1)
    axes = np.meshgrid(*[np.linspace(-0.6, 0.6, nodes)] * 3, indexing="ij")
    depth = radius - np.sqrt(sum(axis**2 for axis in axes))
    levels = np.rint(np.clip(depth / (REACH * spacing), -1.0, 1.0) * LEVELS)
    return Interior(levels[None].astype(np.int8), (-0.1, -0.1, -0.1), spacing, (4.0,), 1.0)


def occupancy(ray: LightRay, origins: Any, incident: Any) -> np.ndarray:
    """Occupancies [N,D,S,samples]."""
    scaled = ray(torch.as_tensor(np.asarray(origins)), torch.as_tensor(np.asarray(incident)))
    return (scaled / OCCUPANCY_SCALE).numpy().reshape(*scaled.shape[:2], -1, len(ray.distances))


def grids(ray: LightRay) -> list[tuple[np.ndarray, np.ndarray, float]]:
    """Each level's grid, the position of its first node, and its spacing."""
    return [(level.grid.numpy().astype(np.float64), level.corner, level.spacing) for level in ray.pyramid()]


def test_samples_grow_farther_apart_and_coarser() -> None:
    ray = LightRay(ball(81), 8)
    assert ray.distances[0] == FIRST_DISTANCE
    np.testing.assert_allclose(np.diff(np.log(ray.distances)), np.log(DISTANCE_RATIO))
    wanted = 0.2 * np.array(ray.distances)
    spacing = np.array([ray.pyramid()[level].spacing for level in ray.level_at])
    coarse = wanted > 0.015
    assert (np.abs(np.log2(spacing / wanted))[coarse] <= 0.5 + 1e-9).all()
    np.testing.assert_allclose(spacing[~coarse], 0.015)
    assert len(set(spacing.tolist())) >= 4


@pytest.mark.parametrize("nodes", [40, 41])
def test_all_levels_have_the_same_volume_and_centre(nodes: int) -> None:
    """For even and odd numbers of nodes, and a ball off the centre of its grid."""
    centred = ball(nodes, 0.2)
    shifted = np.roll(centred.levels, (3, -2, 5), (1, 2, 3))
    found = []
    for grid, corner, spacing in grids(LightRay(replace(centred, levels=shifted), 8)):
        at = [corner[axis] + spacing * np.arange(n) for axis, n in enumerate(grid.shape)]
        centre = [np.tensordot(grid, at[axis], ((axis,), (0,))).sum() / grid.sum() for axis in range(3)]
        found.append([spacing**3 * grid.sum(), *centre])
        assert not any(np.take(grid, end, axis).any() for axis in range(3) for end in (0, -1))
        # The mean of two nodes is halfway between them, whichever has the larger value.
        np.testing.assert_allclose(found[-1][1:], found[0][1:], atol=0.03 * spacing)
    np.testing.assert_allclose([volume for volume, *_ in found], 4.0 / 3.0 * np.pi * 0.2**3, rtol=0.02)
    np.testing.assert_allclose([volume for volume, *_ in found], found[0][0], rtol=1e-6)


def test_occupancy_is_zero_above_a_wall_and_one_below() -> None:
    """It is ½ along the wall, and 0 outside the grid."""
    ray = LightRay(half_space(), 5)
    on_wall = np.array([[[0.5, 0.5, 0.5]]])
    up, along, down = ([[[0.0, 0.0, 1.0]]], [[[0.6, 0.8, 0.0]]], [[[0.0, 0.0, -1.0]]])
    np.testing.assert_allclose(occupancy(ray, on_wall, up), 0.0, atol=0.02)
    np.testing.assert_allclose(occupancy(ray, on_wall, along), 0.5, atol=0.07)
    np.testing.assert_allclose(occupancy(ray, on_wall, down), 1.0, atol=0.02)
    assert not occupancy(LightRay(half_space(), 12), on_wall, down)[..., -1].any()


def test_a_ball_between_a_point_and_the_light_is_seen() -> None:
    ray = LightRay(ball(81, 0.1), 6)
    far = ray.distances[4]
    origin = np.array([[[0.5, 0.5, 0.5 - far]]])
    towards, past = occupancy(ray, origin, [[[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]]])[0]
    assert towards[0, 4] > 0.7
    assert max(towards[0, :3].max(), past.max()) == 0.0


def test_torch_and_compiled_occupancy_match_scipy() -> None:
    """Inside, outside, beyond the last nodes and where a ray leaves the grid."""
    ray = LightRay(rough_interior(23), 8)
    origins = RNG.uniform(-0.4, 1.4, (200, 2, 3)).astype(np.float32)
    incident = unit(RNG, 200, 3).astype(np.float32)
    expected = np.empty((200, 3, 2, 8))
    for sample, (distance, level) in enumerate(zip(ray.distances, ray.level_at, strict=True)):
        grid, corner, spacing = grids(ray)[level]
        points = origins[:, None].astype(np.float64) + distance * incident[:, :, None]
        at = ((points - corner) / spacing).reshape(-1, 3).T
        expected[..., sample] = map_coordinates(grid, at, order=1, mode="constant").reshape(200, 3, 2)
    assert (expected > 0.0).mean() > 0.2
    np.testing.assert_allclose(occupancy(ray, origins, incident), expected, atol=2e-4)
    ray.torch_only = True
    np.testing.assert_allclose(occupancy(ray, origins, incident), expected, atol=2e-4)


def network(**changes: Any) -> NeuralBSSRDF:
    chosen = replace(SETTINGS, **changes)
    return trained(NeuralBSSRDF(chosen, (-1.0, -2.0, 0.5), 3.0, 0.7, interior=rough_interior(30)))


def views(count: int) -> list[torch.Tensor]:
    """Incident directions [N,D,3], positions and outgoing directions [N,3]."""
    positions = np.array([-1.0, -2.0, 0.5]) + 3.0 * RNG.uniform(size=(count, 3))
    return [torch.from_numpy(part) for part in (unit(RNG, count, 7), positions, unit(RNG, count))]


def test_late_layers_see_occupancy_from_x_and_from_within() -> None:
    model = network()
    incident, positions, outgoing = views(20)
    encoding = model.encode_views(positions, outgoing)
    assert encoding is not None
    assert model.view is not None
    assert model.view.light is not None
    x = (positions - model.box_min) / model.box_side
    np.testing.assert_allclose(encoding.frame[:, 0], x, atol=1e-6)
    np.testing.assert_array_equal(encoding.frame[:, 1], encoding.points[:, 6])
    pairs = model.pair_features(incident, outgoing, encoding.frame)
    assert pairs.shape == (20, 7, model.settings.pair_inputs) == (20, 7, 10)
    cosine = (incident @ outgoing[..., None])[..., 0]
    np.testing.assert_allclose(pairs[..., 0], cosine, atol=1e-6)
    np.testing.assert_allclose(pairs[..., 1], cosine**2, atol=1e-6)
    np.testing.assert_array_equal(pairs[..., 2:], model.view.light(encoding.frame[:, :2], incident))


@pytest.mark.parametrize(
    "changes",
    [
        {"angle_powers": 0},
        {"angle_powers": 2},
        {"light_cosines": True, "shape_places": 4, "inner_bodies": False},
        {"light_cosines": True, "shape_places": 4, "inner_bodies": True},
    ],
)
def test_all_evaluations_see_the_same_inputs(changes: dict[str, Any]) -> None:
    model = network(**changes)
    incident, positions, outgoing = views(70)
    with torch.no_grad():
        expected = model.radiance(incident, positions, outgoing).numpy()
        assert model.view is not None
        assert model.view.light is not None
        model.view.light.torch_only = True
        np.testing.assert_allclose(model.radiance(incident, positions, outgoing), expected, atol=1e-4)
        model.view.light.torch_only = False
    query = [part.numpy() for part in (incident, positions, outgoing)]
    close = {"rtol": 0.0, "atol": 2e-5 * np.abs(expected).max()}
    np.testing.assert_allclose(model.evaluate(*query), expected, **close)
    np.testing.assert_allclose(PairNetwork(model).evaluate_pairs(*query), expected, **close)
    block = model.evaluate_block(query[0], np.arange(70)[:, None], query[1], query[2][:, None])
    np.testing.assert_allclose(block[:, 0], expected, **close)


@pytest.mark.parametrize(
    ("tells_normal", "shape_places", "inner_bodies"),
    [(True, 0, False), (True, 0, True), (False, 4, False), (True, 4, False), (True, 4, True), (False, 1, True)],
)
def test_late_layers_see_cosines_to_the_normal_and_to_slopes(
    tells_normal: bool, shape_places: int, inner_bodies: bool
) -> None:
    """The slopes of the shape around x, and around the middle of the view ray if bodies are shown."""
    chosen = {"tells_normal": tells_normal, "shape_places": shape_places, "inner_bodies": inner_bodies}
    model = network(light_cosines=True, light_places=0, angle_powers=0, **chosen)
    incident, positions, outgoing = views(30)
    encoding = model.encode_views(positions, outgoing)
    assert encoding is not None
    axes = []
    first = 2 * model.settings.features
    if tells_normal:
        axes.append(encoding.features[:, None, first : first + 3] / 3.0)
    at = [encoding.x] if shape_places else []
    at += [encoding.points[:, 6]] if shape_places > 1 and inner_bodies else []
    for points in at:
        shape = trilinear(shape_grid(rough_interior(30)), 1.2 / 29, points + 0.1)
        axes.append(shape.reshape(30, 4, 4)[..., 1:] / 2.8)
    expected = np.einsum("ndc,nac->nda", incident.numpy(), torch.cat(axes, dim=1).numpy())
    pairs = model.pair_features(incident, outgoing, encoding.frame)
    assert pairs.shape[-1] == model.settings.pair_inputs == int(tells_normal) + 4 * len(at)
    np.testing.assert_allclose(pairs, expected, atol=2e-3)
    outputs = model.radiance(incident, positions, outgoing).detach().numpy()
    with torch.no_grad():
        model.hidden[-1].weight[:, -model.settings.pair_inputs :] = 0.0
    assert np.abs(model.radiance(incident, positions, outgoing).detach().numpy() - outputs).max() > 0.01


def test_light_cosines_need_a_normal_or_a_shape() -> None:
    """Without both there are no axes, and the network is the same."""
    with_them, without = network(light_cosines=True, tells_normal=False), network(tells_normal=False)
    assert with_them.settings.light_axes == 0
    query = [part.numpy() for part in views(5)]
    np.testing.assert_array_equal(with_them.evaluate(*query), without.evaluate(*query))


def test_occupancy_changes_the_output(tmp_path: Any) -> None:
    """It is not stored in the file, because it follows from the interior."""
    model = network()
    incident, positions, outgoing = (part.numpy() for part in views(50))
    outputs = model.evaluate(incident, positions, outgoing)
    save_model(model, tmp_path / "model.pt")
    np.testing.assert_array_equal(load_model(tmp_path / "model.pt").evaluate(incident, positions, outgoing), outputs)
    assert not any("light.grid" in name for name in model.state_dict())
    with torch.no_grad():
        for layer in model.hidden[-2:]:
            layer.weight[:, -model.settings.light_places :] = 0.0
    without = model.evaluate(incident, positions, outgoing)
    assert np.abs(without - outputs).max() > 0.1 * np.abs(outputs).max()


@pytest.mark.parametrize("changes", [{"light_places": -2}, {"light_places": 7}, {"ray_samples": 0}])
def test_light_places_must_be_even_and_need_a_ray(changes: dict[str, Any]) -> None:
    with pytest.raises(
        ModelError, match="light_places must be even and not negative, and must be 0 without ray_samples"
    ):
        replace(SETTINGS, tells_normal=False, low_axes=False, **changes)


def test_networks_without_light_places_have_no_pyramid() -> None:
    assert NetworkSettings().light_places == 0
    model = network(light_places=0)
    assert model.view is not None
    assert model.view.light is None
    assert model.settings.pair_inputs == 2
