"""The coarse light of a NeRFactor: its energy, and where it shines from."""

import numpy as np
import pytest

from formats.scene.lights import DirectionalLight
from prt_bake.baselines.coarse_light import coarse_light
from prt_bake.baselines.nerfactor_views import light_pixels
from prt_bake.lights.environment import lookup, project, rotation
from prt_bake.lights.lighting import Lighting, Sky

SUN = np.array([0.48, -0.6, 0.64])
COLOUR = np.array([3.0, 2.0, 1.0])


def irradiance_and_axis(picture, up):
    """The sum of radiance times solid angle [3], and the unit mean direction of the light."""
    pixels = light_pixels(picture.shape[:2], up)
    energy = picture.reshape(-1, 3) * pixels.solid_angles
    axis = energy.sum(axis=1) @ pixels.directions
    return energy.sum(axis=0), axis / np.linalg.norm(axis)


@pytest.mark.parametrize("shape", [(4, 8), (60, 120), (33, 40), (600, 1200)])
def test_skies_of_any_size_keep_their_energy(shape):
    sky = np.random.default_rng(0).uniform(0.5, 1.5, (*shape, 3))
    # Interpolation between rows of a coarse picture moves light to zones of other sizes, for 4 rows by 1 %.
    np.testing.assert_allclose(project(coarse_light(sky), 0), project(sky, 0), rtol=1.5e-2)
    np.testing.assert_allclose(coarse_light(np.ones((*shape, 3))), 1.0, rtol=1e-6)


@pytest.mark.parametrize("up", ["y", "z"])
@pytest.mark.parametrize("diameter", [0.0, 0.5, 30.0])
def test_a_sun_keeps_its_irradiance_and_direction(up, diameter):
    found, axis = irradiance_and_axis(coarse_light(Lighting((), (DirectionalLight(SUN, COLOUR, diameter),)), up), up)
    np.testing.assert_allclose(found, COLOUR, rtol=1e-5)
    assert axis @ SUN > np.cos(np.radians(8.0))  # half the diagonal of a pixel


@pytest.mark.parametrize("up", ["y", "z"])
def test_a_turned_sky_shines_from_where_it_was_turned_to(up):
    picture = np.zeros((64, 128, 3), np.float32)
    picture[20, 30] = COLOUR
    sky = Sky(picture, up, rotation(70.0, up))
    found, axis = irradiance_and_axis(coarse_light(Lighting((sky,)), up), up)
    expected, unturned = irradiance_and_axis(picture, up)
    np.testing.assert_allclose(found, expected, rtol=0.02)
    assert axis @ rotation(70.0, up) @ unturned > np.cos(np.radians(8.0))


def test_enlarged_pixels_are_shown_as_steps():
    sky = np.random.default_rng(1).uniform(size=(16, 32, 3)).astype(np.float32)
    coarse, steps = coarse_light(sky), coarse_light(sky, enlarged=16)
    assert steps.shape == (256, 512, 3)
    centres = light_pixels((16, 32), "y").directions
    off = centres + 0.05 * np.random.default_rng(2).normal(size=centres.shape)  # within a pixel, in most cases
    shown = lookup(steps, off)
    same = np.isclose(shown, coarse.reshape(-1, 3), atol=1e-6).all(axis=1)
    assert same.mean() > 0.5
    np.testing.assert_allclose(lookup(steps, centres), coarse.reshape(-1, 3), atol=1e-6)
