"""Tests of the channels of a scene's material: media, textures, opaque bodies, bytes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from formats.image import write_image
from formats.scene import Scene, read_scene
from prt_bake.network.bssrdf import PRESETS, load_model
from prt_bake.network.features.feature_grid import kept_places
from prt_bake.network.features.interior import LEVELS, Interior
from prt_bake.network.features.material import STEPS, Material
from prt_bake.network.features.view_features import interval_edges
from prt_bake.trainer import material as channels
from prt_bake.trainer.interior import interior_of
from prt_bake.trainer.training_data import box_of
from tests.shapes import ball
from tests.tracer.scenes import make_scene, with_uv
from tests.trainer import small_training

pytestmark = pytest.mark.usefixtures("coarse_interior")

GRAPE = Path(__file__).parents[2] / "scenes" / "grape" / "grape.toml"


def sampled(scene: Scene) -> tuple[Material, np.ndarray]:
    """The material of a scene, and its nodes [K,3] in the scene's units."""
    box = box_of(scene)
    interior = interior_of(scene, box, with_material=True)
    assert interior.material is not None
    return interior.material, box.corner + box.side * places(interior, interior.material)


def places(interior: Interior, material: Material) -> np.ndarray:
    reach = float(interval_edges(interior, False)[-1])
    return np.array(interior.corner) + np.argwhere(kept_places(interior, material.per_side, reach)) / material.per_side


def steps_of(values: np.ndarray) -> np.ndarray:
    """Values in steps between their lowest and their highest."""
    return (values - values.min()) * (STEPS / np.ptp(values))


def ramp(low: float, high: float) -> np.ndarray:
    """A grid [Z,Y,X] that changes along x alone."""
    return np.broadcast_to(np.linspace(low, high, 9), (3, 4, 9)).copy()


def along_x(at: np.ndarray, low: float, high: float) -> np.ndarray:
    """The values of `ramp` at x from −1 to 1, trilinear between the centres of its cells."""
    return np.asarray(np.interp((at + 1.0) / 2.0 * 9.0 - 0.5, np.arange(9), np.linspace(low, high, 9)))


def test_an_attenuation_is_sampled_as_its_logarithm(tmp_path: Path) -> None:
    """The box of the grid is the ball's, −1 to 1. The albedo does not vary, and is left out."""
    material, nodes = sampled(make_scene(tmp_path, ball(3), sigma_t=ramp(1.0, 9.0)))
    assert material.rows.shape[1] == 1
    expected = steps_of(np.log(along_x(nodes[:, 0], 1.0, 9.0)))
    assert np.abs(material.rows[:, 0] - expected).max() < 0.51


def test_an_albedo_is_sampled_as_the_logarithm_of_what_is_absorbed(tmp_path: Path) -> None:
    """Each colour that varies is a channel."""
    albedo = np.stack([ramp(0.5, 0.99), np.full((3, 4, 9), 0.7), ramp(0.9, 0.1)], axis=-1)
    material, nodes = sampled(make_scene(tmp_path, ball(3), albedo=albedo))
    assert material.rows.shape[1] == 2
    for channel, (low, high) in enumerate(((0.5, 0.99), (0.9, 0.1))):
        expected = steps_of(np.log(1.0 - along_x(nodes[:, 0], low, high)))
        assert np.abs(material.rows[:, channel] - expected).max() < 0.51


def test_an_alpha_is_that_of_the_nearest_point_of_the_surface(tmp_path: Path) -> None:
    """The texture is dark below and light above; nodes in the middle of the ball have its mean."""
    halves = np.repeat([0.2, 0.6], 8)[:, None, None] * np.ones((1, 8, 3))
    write_image(tmp_path / "alpha.png", halves.astype(np.float32))
    scene = make_scene(tmp_path, with_uv(ball(4)), eta=1.4, roughness="alpha.png", sigma_t=1.0)
    material, nodes = sampled(scene)
    assert material.rows.shape[1] == 1
    height, radius = nodes[:, 2], np.linalg.norm(nodes, axis=1)
    near, texture = radius > 0.85, np.asarray(scene.roughness)
    low, high = float(texture.min()), float(texture.max())
    found = low + (high - low) * material.rows[:, 0] / STEPS
    upper, lower = (near & (side * height > 0.2) & (side * height < 0.8) for side in (1.0, -1.0))
    assert np.abs(found[upper] - texture[0, 0]).max() < 0.02
    assert np.abs(found[lower] - texture[-1, 0]).max() < 0.02
    middle = found[radius < 0.7]
    assert np.ptp(middle) == 0.0
    assert abs(middle[0] - texture.mean()) < 0.05 * (high - low)


def test_channels_vary_within_bodies() -> None:
    """The grape has two diffuse seeds with a texture, and a texture of the roughness. Its medium does not vary."""
    scene = read_scene(GRAPE)
    material, nodes = sampled(scene)
    assert material.rows.shape[1] == 4
    seed = scene.parts[1].mesh
    inside = np.linalg.norm(nodes - seed.positions.mean(axis=0), axis=1) < 0.3 * np.ptp(seed.positions, axis=0).min()
    outside = np.linalg.norm(nodes, axis=1) > 0.8 * np.abs(scene.mesh.positions).max()
    assert inside.sum() > 10
    assert (np.ptp(material.rows[outside, :3], axis=0) == 0).all()
    assert (np.ptp(material.rows[inside, :3], axis=0) > STEPS / 4).any()
    assert np.ptp(material.rows[outside, 3]) == STEPS


def test_an_opaque_body_takes_no_steps_from_the_medium_around_it(tmp_path: Path) -> None:
    alone = make_scene(tmp_path, ball(3), sigma_t=ramp(10.0, 14.0))
    box, interior = box_of(alone), interior_of(alone, box_of(alone))
    inner = replace(alone.parts[0], mesh=ball(2, 0.4), medium=None, diffuse=np.array([0.2, 0.5, 0.8]), parent=0)
    core = (2 * interior.levels[0].astype(int) - LEVELS).clip(-LEVELS, LEVELS).astype(np.int8)
    both = replace(interior, levels=np.stack([interior.levels[0], core]), attenuation=(12.0, 1e3))
    material = channels.material_of([alone.parts[0], inner], box, both, 1.0)
    assert material is not None
    assert material.rows.shape[1] == 1
    assert len(np.unique(material.rows)) == STEPS + 1


@pytest.mark.parametrize("quantity", ["sigma_t", "albedo"])
def test_grids_may_be_grey_or_coloured(tmp_path: Path, quantity: str) -> None:
    """Of one grey grid all colours are alike; the attenuation is the mean over the colours."""
    found, shift = [], np.array([-0.15, 0.0, 0.15]) if quantity == "sigma_t" else np.zeros(3)
    for grid in (ramp(0.2, 0.9), ramp(0.2, 0.9)[..., None] + shift):
        scene = make_scene(tmp_path, ball(3), **{quantity: grid})
        found.append(sampled(scene)[0].rows.astype(int))
    assert np.abs(found[0] - found[1]).max() <= 1
    assert found[0].shape[1] == (1 if quantity == "sigma_t" else 3)


def test_scenes_without_grids_and_textures_have_no_material(tmp_path: Path) -> None:
    """A body in another one is no reason either: view rays show where one ends and the other begins."""
    scene = small_training.make_scene(tmp_path)
    interior = interior_of(scene, box_of(scene), with_material=True)
    assert interior.material is None
    drink = read_scene(GRAPE.parents[1] / "drink" / "drink.toml")
    assert len(drink.parts) > 1
    assert channels.material_of(list(drink.parts), box_of(drink), interior, 1.0) is None


def test_a_grid_that_does_not_vary_is_left_out(tmp_path: Path) -> None:
    scene = make_scene(tmp_path, ball(2), sigma_t=np.full((2, 2, 2), 3.0))
    assert interior_of(scene, box_of(scene), with_material=True).material is None


def test_noise_is_sampled_as_finely_as_its_bytes_allow(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    noise = np.random.default_rng(0).uniform(0.1, 9.0, (24, 24, 24))
    scene = make_scene(tmp_path, ball(3), sigma_t=noise)
    monkeypatch.setattr(channels, "_FINEST", 40)
    fine, _nodes = sampled(scene)
    with monkeypatch.context() as limited:
        limited.setattr(channels, "MOST_BYTES", 15_000)
        coarse, _nodes = sampled(scene)
    assert len(fine.packed()) > 15_000 >= len(coarse.packed()) > 6_000
    assert coarse.per_side < fine.per_side == 40
    monkeypatch.setattr(channels, "MOST_ROWS", 10_000)
    fewer, _nodes = sampled(scene)
    assert len(fine.rows) > 10_000 >= len(fewer.rows) > 5_000


def test_a_training_sees_the_material(tmp_path: Path) -> None:
    small = replace(PRESETS["measured"], features=16, width=16, light_features=4, layers=3)
    scene = make_scene(tmp_path, ball(2), sigma_t=ramp(1.0, 9.0))
    network = small_training.train_small(scene, 2, settings=small, output=tmp_path / "m.pt")
    assert network.settings.material_channels == 1
    assert load_model(tmp_path / "m.pt").settings == network.settings
    unseen = small_training.train_small(scene, 2, settings=replace(small, material_channels=0))
    assert unseen.settings.material_channels == 0


def test_the_grid_is_no_finer_than_the_interior_s(tmp_path: Path) -> None:
    """Its nodes are those around the nodes of the interior's grid, which would leave gaps."""
    scene = make_scene(tmp_path, ball(2), sigma_t=ramp(1.0, 9.0))
    box, interior = box_of(scene), interior_of(scene, box_of(scene))
    coarse = replace(interior, levels=interior.levels[:, ::4, ::4, ::4], spacing=4.0 * interior.spacing)
    material = channels.material_of(list(scene.parts), box, coarse, 1.0)
    assert material is not None
    assert material.per_side == int(1.0 / coarse.spacing) < 60
