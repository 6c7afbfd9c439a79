"""Bodies inside an object as the shape and the light rays of a network show them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from formats.scene import read_scene
from prt_bake.network.bssrdf import PRESETS, NetworkSettings
from prt_bake.network.features.interior import LEVELS, REACH, Interior
from prt_bake.network.features.light_ray import LightRay
from prt_bake.network.features.shape import shape_grid
from prt_bake.network.features.view_features import ViewFeatures
from prt_bake.trainer.fit import settings_for

NODES, SPACING, RADIUS = 61, 0.02, 0.2
CENTRE = NODES // 2


def cube_with_a_ball(outer: float, inner: float, third: float | None = None) -> Interior:
    """A unit cube around a ball, and in that a smaller ball; with the attenuation of each per box side."""
    at = -0.1 + SPACING * np.arange(NODES)
    x, y, z = np.meshgrid(at, at, at, indexing="ij")
    distance = np.sqrt((x - 0.5) ** 2 + (y - 0.5) ** 2 + (z - 0.5) ** 2)
    depths = [np.minimum.reduce([x, 1 - x, y, 1 - y, z, 1 - z]), RADIUS - distance, 0.5 * RADIUS - distance]
    media = [outer, inner] if third is None else [outer, inner, third]
    levels = np.clip(np.rint(np.stack(depths[: len(media)]) * (LEVELS / (REACH * SPACING))), -LEVELS, LEVELS)
    return Interior(levels.astype(np.int8), (-0.1, -0.1, -0.1), SPACING, tuple(media), 1.5)


def along_x(interior: Interior) -> dict[str, float]:
    """Occupancies with bodies: outside, in the cube, in the ball, and in its middle."""
    line = interior.occupancy(with_bodies=True)[:, CENTRE, CENTRE]
    nodes = {"outside": 0, "cube": 10, "ball": CENTRE - 8, "middle": CENTRE}
    return {name: float(line[node]) for name, node in nodes.items()}


def test_a_body_shows_by_its_opacity() -> None:
    found = along_x(cube_with_a_ball(0.0, 1e3))
    assert found == pytest.approx({"outside": 0.0, "cube": 0.4, "ball": 1.0, "middle": 1.0}, abs=1e-6)
    found = along_x(cube_with_a_ball(2.0, 5.0))
    cube, ball_ = 1.0 - 0.6 * np.exp(-0.2), 1.0 - 0.6 * np.exp(-0.5)
    assert found == pytest.approx({"outside": 0.0, "cube": cube, "ball": ball_, "middle": ball_}, abs=1e-6)


def test_the_last_body_counts() -> None:
    """A bubble in a dense ball, in a cube that is denser than the bubble."""
    found = along_x(cube_with_a_ball(2.0, 1e3, 0.0))
    assert found["ball"] == pytest.approx(1.0)
    assert found["middle"] == pytest.approx(0.4)
    assert found["middle"] < found["cube"]


def test_an_object_with_nothing_inside_is_shown_as_it_was() -> None:
    one = cube_with_a_ball(0.3, 1e3)
    one = replace(one, levels=one.levels[:1], attenuation=one.attenuation[:1])
    torch.testing.assert_close(one.occupancy(with_bodies=True), one.occupancy(), rtol=0, atol=0)


def test_bodies_are_not_shown_unless_asked_for() -> None:
    """Networks that were trained without them keep their inputs."""
    plain, alone = cube_with_a_ball(0.0, 1e3), cube_with_a_ball(0.0, 0.0)
    torch.testing.assert_close(shape_grid(plain), shape_grid(alone), rtol=0, atol=0)
    assert not torch.equal(shape_grid(plain, True), shape_grid(alone, True))
    older = PRESETS["measured"].as_json()
    del older["inner_bodies"], older["branches"]
    read = NetworkSettings.from_json(older)
    assert (read.inner_bodies, read.branches) == (False, 1)


@pytest.mark.parametrize("shown", [False, True])
def test_a_network_sees_bodies_if_its_settings_say_so(shown: bool) -> None:
    interior = cube_with_a_ball(0.0, 1e3)
    settings = replace(PRESETS["measured"], inner_bodies=shown, material_channels=0)
    view = ViewFeatures(settings, torch.zeros((settings.features, 6)), interior)
    assert view.light is not None
    torch.testing.assert_close(view.shape, shape_grid(interior, shown), rtol=0, atol=0)
    assert (float(view.light.pyramid()[0].grid[CENTRE, CENTRE, 10]) < 0.5) == shown


def test_a_ball_in_a_clear_cube_shadows_what_is_behind_it() -> None:
    interior = cube_with_a_ball(0.0, 1e3)
    origin, light = torch.tensor([[[0.5, 0.5, 0.1]]]), torch.tensor([[[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]])
    towards, past = LightRay(interior, 8, with_bodies=True)(origin, light)[0].amax(dim=1)
    assert float(towards - past) > 2.0
    towards, past = LightRay(interior, 8)(origin, light)[0].amax(dim=1)
    assert float(towards - past) < 0.5


def test_slopes_at_a_body_are_its_normals() -> None:
    interior = cube_with_a_ball(0.0, 1e3)
    node = CENTRE - round(RADIUS / SPACING)
    slopes = shape_grid(interior, True)[node, CENTRE, CENTRE].reshape(-1, 4)[:, 1:]
    assert float(slopes[0, 0]) > 1.0
    np.testing.assert_allclose(slopes[:, 1:], 0.0, atol=1e-4)


@pytest.mark.parametrize(("name", "shown"), [("paperweight/cow.toml", True), ("dragon/serpent.toml", False)])
def test_a_scene_with_nothing_inside_does_without(name: str, shown: bool) -> None:
    scene = read_scene(Path(__file__).parents[2] / "scenes" / name)
    assert settings_for(PRESETS["measured"], scene).inner_bodies == shown
