"""What networks are told of the way to the light: shares of the object at places along it, in grids ever coarser."""

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
from tests.network.test_bssrdf import rough_interior, trained, unit
from tests.network.test_interior import LOOKING as UNTOLD
from tests.network.test_interior import half_space

LOOKING = replace(UNTOLD, ray_samples=12, light_places=8, light_cosines=False)
OCCUPANCY_SCALE = 5.0
RNG = np.random.default_rng(12)


def ball(places: int, radius: float = 0.3) -> Interior:
    """A ball about (½, ½, ½) in a box of side 1."""
    spacing = 1.2 / (places - 1)
    axes = np.meshgrid(*[np.linspace(-0.6, 0.6, places)] * 3, indexing="ij")
    depth = radius - np.sqrt(sum(axis**2 for axis in axes))
    levels = np.rint(np.clip(depth / (REACH * spacing), -1.0, 1.0) * LEVELS)
    return Interior(levels[None].astype(np.int8), (-0.1, -0.1, -0.1), spacing, (4.0,), 1.0)


def looked(ray: LightRay, starts: Any, incident: Any) -> np.ndarray:
    """Shares [N,D,S,places]."""
    told = ray(torch.as_tensor(np.asarray(starts)), torch.as_tensor(np.asarray(incident))) / OCCUPANCY_SCALE
    return told.numpy().reshape(*told.shape[:2], -1, len(ray.distances))


def grids(ray: LightRay) -> list[tuple[np.ndarray, np.ndarray, float]]:
    """Each level's grid, the place of its first value, and its spacing."""
    return [(level.grid.numpy().astype(np.float64), level.corner, level.spacing) for level in ray.pyramid()]


def test_places_lie_ever_farther_away_and_are_told_more_coarsely() -> None:
    ray = LightRay(ball(81), 8)
    assert ray.distances[0] == FIRST_DISTANCE
    np.testing.assert_allclose(np.diff(np.log(ray.distances)), np.log(DISTANCE_RATIO))
    wanted = 0.2 * np.array(ray.distances)
    spacing = np.array([ray.pyramid()[level].spacing for level in ray.level_at])
    coarse = wanted > 0.015
    assert (np.abs(np.log2(spacing / wanted))[coarse] <= 0.5 + 1e-9).all()
    np.testing.assert_allclose(spacing[~coarse], 0.015)
    assert len(set(spacing.tolist())) >= 4


@pytest.mark.parametrize("places", [40, 41])
def test_every_grid_holds_as_much_of_the_object_and_at_the_same_place(places: int) -> None:
    """Volume and centre, for even and odd numbers of places, of a ball that lies off the middle of its grid."""
    whole = ball(places, 0.2)
    shifted = np.roll(whole.levels, (3, -2, 5), (1, 2, 3))
    found = []
    for grid, corner, spacing in grids(LightRay(replace(whole, levels=shifted), 8)):
        at = [corner[axis] + spacing * np.arange(n) for axis, n in enumerate(grid.shape)]
        centre = [np.tensordot(grid, at[axis], ((axis,), (0,))).sum() / grid.sum() for axis in range(3)]
        found.append([spacing**3 * grid.sum(), *centre])
        assert not any(np.take(grid, end, axis).any() for axis in range(3) for end in (0, -1))
        # Means of pairs lie half-way between the two, whichever of them holds more.
        np.testing.assert_allclose(found[-1][1:], found[0][1:], atol=0.03 * spacing)
    np.testing.assert_allclose([volume for volume, *_ in found], 4.0 / 3.0 * np.pi * 0.2**3, rtol=0.02)
    np.testing.assert_allclose([volume for volume, *_ in found], found[0][0], rtol=1e-6)


def test_above_a_wall_the_way_is_free_and_below_it_is_not() -> None:
    """Half of what lies around a place on the wall is inside; the wall ends with its grid."""
    ray = LightRay(half_space(), 5)
    on_wall = np.array([[[0.5, 0.5, 0.5]]])
    up, along, down = ([[[0.0, 0.0, 1.0]]], [[[0.6, 0.8, 0.0]]], [[[0.0, 0.0, -1.0]]])
    np.testing.assert_allclose(looked(ray, on_wall, up), 0.0, atol=0.02)
    np.testing.assert_allclose(looked(ray, on_wall, along), 0.5, atol=0.07)
    np.testing.assert_allclose(looked(ray, on_wall, down), 1.0, atol=0.02)
    assert not looked(LightRay(half_space(), 12), on_wall, down)[..., -1].any()


def test_a_ball_between_a_place_and_the_light_is_seen_from_there() -> None:
    ray = LightRay(ball(81, 0.1), 6)
    far = ray.distances[4]
    start = np.array([[[0.5, 0.5, 0.5 - far]]])
    towards, past = looked(ray, start, [[[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]]])[0]
    assert towards[0, 4] > 0.7
    assert max(towards[0, :3].max(), past.max()) == 0.0


def test_tensors_and_kernel_look_up_as_scipy_does() -> None:
    """Inside, outside, beyond the last places and where a way leaves the grid."""
    ray = LightRay(rough_interior(23), 8)
    starts = RNG.uniform(-0.4, 1.4, (200, 2, 3)).astype(np.float32)
    incident = unit(RNG, 200, 3).astype(np.float32)
    expected = np.empty((200, 3, 2, 8))
    for place, (distance, level) in enumerate(zip(ray.distances, ray.level_at, strict=True)):
        grid, corner, spacing = grids(ray)[level]
        points = starts[:, None].astype(np.float64) + distance * incident[:, :, None]
        at = ((points - corner) / spacing).reshape(-1, 3).T
        expected[..., place] = map_coordinates(grid, at, order=1, mode="constant").reshape(200, 3, 2)
    assert (expected > 0.0).mean() > 0.2
    np.testing.assert_allclose(looked(ray, starts, incident), expected, atol=2e-4)
    ray.torch_only = True
    np.testing.assert_allclose(looked(ray, starts, incident), expected, atol=2e-4)


def network(**differing: Any) -> NeuralBSSRDF:
    chosen = replace(LOOKING, **differing)
    return trained(NeuralBSSRDF(chosen, (-1.0, -2.0, 0.5), 3.0, 0.7, interior=rough_interior(30)))


def views(count: int) -> list[torch.Tensor]:
    """Directions of incidence [N,D,3], positions and outgoing directions [N,3]."""
    positions = np.array([-1.0, -2.0, 0.5]) + 3.0 * RNG.uniform(size=(count, 3))
    return [torch.from_numpy(part) for part in (unit(RNG, count, 7), positions, unit(RNG, count))]


def test_the_late_layers_are_told_of_the_way_from_x_and_from_within() -> None:
    looking = network()
    incident, positions, outgoing = views(20)
    told = looking.told(positions, outgoing)
    assert told is not None
    assert looking.view is not None
    assert looking.view.light is not None
    x = (positions - looking.box_min) / looking.box_side
    np.testing.assert_allclose(told.frame[:, 0], x, atol=1e-6)
    np.testing.assert_array_equal(told.frame[:, 1], told.points[:, 6])
    pairs = looking.pair_features(incident, outgoing, told.frame)
    assert pairs.shape == (20, 7, looking.settings.pair_inputs) == (20, 7, 10)
    cosine = (incident @ outgoing[..., None])[..., 0]
    np.testing.assert_allclose(pairs[..., 0], cosine, atol=1e-6)
    np.testing.assert_allclose(pairs[..., 1], cosine**2, atol=1e-6)
    np.testing.assert_array_equal(pairs[..., 2:], looking.view.light(told.frame[:, :2], incident))


@pytest.mark.parametrize("told", [{"angle_powers": 0}, {"angle_powers": 2}, {"light_cosines": True, "shape_places": 4}])
def test_every_path_through_a_network_is_told_the_same(told: dict[str, Any]) -> None:
    looking = network(**told)
    incident, positions, outgoing = views(70)
    with torch.no_grad():
        expected = looking.radiance(incident, positions, outgoing).numpy()
        assert looking.view is not None
        assert looking.view.light is not None
        looking.view.light.torch_only = True
        np.testing.assert_allclose(looking.radiance(incident, positions, outgoing), expected, atol=1e-4)
        looking.view.light.torch_only = False
    query = [part.numpy() for part in (incident, positions, outgoing)]
    close = {"rtol": 0.0, "atol": 2e-5 * np.abs(expected).max()}
    np.testing.assert_allclose(looking.evaluate(*query), expected, **close)
    np.testing.assert_allclose(PairNetwork(looking).evaluate_pairs(*query), expected, **close)
    block = looking.evaluate_block(query[0], np.arange(70)[:, None], query[1], query[2][:, None])
    np.testing.assert_allclose(block[:, 0], expected, **close)


@pytest.mark.parametrize(("tells_normal", "shape_places"), [(True, 0), (False, 4), (True, 4)])
def test_the_late_layers_are_told_cosines_to_the_normal_and_to_the_slopes_around_x(
    tells_normal: bool, shape_places: int
) -> None:
    looking = network(
        light_cosines=True, tells_normal=tells_normal, shape_places=shape_places, light_places=0, angle_powers=0
    )
    incident, positions, outgoing = views(30)
    told = looking.told(positions, outgoing)
    assert told is not None
    axes = []
    besides = 2 * looking.settings.features
    if tells_normal:
        axes.append(told.features[:, None, besides : besides + 3] / 3.0)
    if shape_places:
        shape = trilinear(shape_grid(rough_interior(30)), 1.2 / 29, told.x + 0.1)
        axes.append(shape.reshape(30, 4, 4)[..., 1:] / 2.8)
    expected = np.einsum("ndc,nac->nda", incident.numpy(), torch.cat(axes, dim=1).numpy())
    pairs = looking.pair_features(incident, outgoing, told.frame)
    assert pairs.shape[-1] == looking.settings.pair_inputs == int(tells_normal) + shape_places
    np.testing.assert_allclose(pairs, expected, atol=2e-3)
    blind = looking.radiance(incident, positions, outgoing).detach().numpy()
    with torch.no_grad():
        looking.hidden[-1].weight[:, -looking.settings.pair_inputs :] = 0.0
    assert np.abs(looking.radiance(incident, positions, outgoing).detach().numpy() - blind).max() > 0.01


def test_cosines_are_told_of_what_there_is() -> None:
    """Without a normal and a shape there are none, and the network is the same."""
    with_them, without = network(light_cosines=True, tells_normal=False), network(tells_normal=False)
    assert with_them.settings.light_axes == 0
    query = [part.numpy() for part in views(5)]
    np.testing.assert_array_equal(with_them.evaluate(*query), without.evaluate(*query))


def test_what_lies_on_the_way_changes_the_answer(tmp_path: Any) -> None:
    """And is no part of the file: it follows from the interior."""
    looking = network()
    incident, positions, outgoing = (part.numpy() for part in views(50))
    answers = looking.evaluate(incident, positions, outgoing)
    save_model(looking, tmp_path / "model.pt")
    np.testing.assert_array_equal(load_model(tmp_path / "model.pt").evaluate(incident, positions, outgoing), answers)
    assert not any("light.grid" in name for name in looking.state_dict())
    with torch.no_grad():
        for layer in looking.hidden[-2:]:
            layer.weight[:, -looking.settings.light_places :] = 0.0
    blind = looking.evaluate(incident, positions, outgoing)
    assert np.abs(blind - answers).max() > 0.1 * np.abs(answers).max()


@pytest.mark.parametrize("wrong", [{"light_places": -2}, {"light_places": 7}, {"ray_samples": 0}])
def test_places_that_make_no_pairs_and_rays_that_are_not_there_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ModelError, match="light_places must be even and not negative, and without ray_samples"):
        replace(LOOKING, tells_normal=False, **wrong)


def test_networks_that_are_not_told_keep_no_grid_of_it() -> None:
    assert NetworkSettings().light_places == 0
    looking = network(light_places=0)
    assert looking.view is not None
    assert looking.view.light is None
    assert looking.settings.pair_inputs == 2
