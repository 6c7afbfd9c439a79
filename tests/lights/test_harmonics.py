"""Harmonics of lightings, and pictures of assets under them."""

import math

import numpy as np
import pytest

from formats.scene.lights import DirectionalLight
from prt_bake.lights import environment
from prt_bake.lights.harmonics import project_lighting
from prt_bake.lights.lighting import Lighting, Sky
from prt_bake.mathematics import sh, sphere
from prt_bake.shading.picture import render_picture
from tests.mathematics.sampling import assert_mean_is
from tests.shading.test_picture import ball, constant, front, make_asset

TURN = sphere.random_rotations(1, 4)[0]


def sun(direction=(0.48, 0.6, 0.64), irradiance=(3.0, 2.0, 1.0), diameter=0.0) -> DirectionalLight:
    return DirectionalLight(np.array(direction), np.array(irradiance), diameter)


def sky(up: str = "y", turn: np.ndarray = TURN) -> Sky:
    image = np.random.default_rng(3).random((9, 14, 3)).astype(np.float32)
    return Sky(image, up, turn)


@pytest.mark.parametrize("degree", [0, 2, 7])
@pytest.mark.parametrize("diameter", [0.5, 40.0, 179.0])
def test_a_disc_has_the_harmonics_of_its_radiance(degree: int, diameter: float) -> None:
    light = sun(diameter=diameter)
    # Uniform over the cap: height and azimuth are uniform.
    u, v = np.random.default_rng(1).random((2, 200_000))
    cosine = 1.0 - u * (1.0 - math.cos(math.radians(diameter / 2.0)))
    local = np.stack(
        [np.sqrt(1 - cosine**2) * np.cos(2 * math.pi * v), np.sqrt(1 - cosine**2) * np.sin(2 * math.pi * v), cosine], 1
    )
    normal = light.direction[None]
    d = sphere.to_world(local, np.repeat(normal, len(u), 0), np.repeat(sphere.tangent_frame(normal), len(u), 0))
    expected = sh.evaluate(d, degree)
    found = project_lighting(Lighting((), (light,)), degree)
    assert found[0, 0] == pytest.approx(3.0 / math.sqrt(4.0 * math.pi), rel=1e-12)
    for place in range(1, sh.count(degree)):
        assert_mean_is(3.0 * expected[:, place], found[place, 0])
    np.testing.assert_allclose(found, found[:, :1] * [1.0, 2 / 3, 1 / 3], rtol=1e-12)


@pytest.mark.parametrize("diameter", [0.0, 1e-7, 1e-3])
def test_a_tiny_disc_equals_a_light_without_size(diameter: float) -> None:
    expected = sh.evaluate(sun().direction, 5)[:, None] * sun().irradiance
    np.testing.assert_allclose(project_lighting(Lighting((), (sun(diameter=diameter),)), 5), expected, rtol=1e-9)


def test_a_disc_of_a_hemisphere_keeps_its_energy() -> None:
    found = project_lighting(Lighting((), (sun(diameter=180.0),)), 2)
    np.testing.assert_allclose(found[0], sun().irradiance / math.sqrt(4.0 * math.pi), rtol=1e-12)


@pytest.mark.parametrize("up", ["y", "z"])
def test_projection_is_additive_and_commutes_with_rotation(up: str) -> None:
    one, other = Lighting((sky(up),)), Lighting((sky(up, np.eye(3)),), (sun(), sun((-1.0, 0.0, 0.0), diameter=20.0)))
    both = Lighting(one.skies + other.skies, other.suns)
    apart = project_lighting(one, 4) + project_lighting(other, 4)
    np.testing.assert_allclose(project_lighting(both, 4), apart, atol=1e-12)
    turned = environment.rotate_light(project_lighting(both, 4), 75.0, up)
    np.testing.assert_allclose(project_lighting(both.turned(75.0, up), 4), turned, atol=1e-12)


def test_a_picture_under_two_lights_is_the_sum_of_the_pictures_under_each() -> None:
    asset, view = make_asset(ball(3)), front()
    first, second = Lighting((sky(),)), Lighting((sky(turn=np.eye(3)),), (sun(diameter=30.0),))
    both = Lighting(first.skies + second.skies, second.suns)
    pictures = [render_picture(asset, light, view, background=False) for light in (first, second, both)]
    assert all(picture.clamped == 0.0 for picture in pictures)
    np.testing.assert_allclose(pictures[2].image, pictures[0].image + pictures[1].image, rtol=2e-5)


def test_a_lighting_of_one_sky_renders_like_its_picture() -> None:
    asset, view = make_asset(ball(2)), front()
    image = sky().image
    as_lights = Lighting((Sky(image, "y", environment.rotation(30.0, "y")),))
    ours, theirs = render_picture(asset, as_lights, view).image, render_picture(asset, image, view, rotate=30.0).image
    np.testing.assert_array_equal(ours, theirs)


def test_a_disc_is_visible_behind_the_object() -> None:
    behind = sun((0.0, -0.6, -0.8), (1.0, 1.0, 1.0), 12.0)
    shown = render_picture(make_asset(ball(2)), Lighting((), (behind,)), front(160, 120, (0.0, 3.0, 4.0)), samples=4)
    bare = render_picture(
        make_asset(ball(2)), Lighting((), (behind,)), front(160, 120, (0.0, 3.0, 4.0)), samples=4, background=False
    )
    disc = shown.image - bare.image
    assert disc.max() <= 1.0001 / (2 * math.pi * (1 - math.cos(math.radians(6))))
    assert (disc >= 0).all()
    dark = render_picture(make_asset(ball(2)), constant((0.0, 0.0, 0.0)), front())
    assert not dark.image.any()
