"""The light that lobes see, compared with sums over the sphere."""

import numpy as np
import pytest

from prt_bake.lights.lighting import Lighting, Sky, read_lighting
from prt_bake.lobes.light import lobe_light, lobe_radiance
from prt_bake.mathematics import sh
from prt_bake.mathematics.directions import fibonacci

AXES = fibonacci(50)


def sky(image: np.ndarray) -> Lighting:
    return Lighting((Sky(image.astype(np.float32), "y", np.eye(3)),))


def smooth_sky() -> Lighting:
    draw = np.random.default_rng(0)
    bumps = [(axis, draw.uniform(1.0, 3.0, 3)) for axis in fibonacci(5)]
    v, u = np.indices((128, 256)) + 0.5
    polar, turn = np.pi * v / 128, 2.0 * np.pi * (u / 256 - 0.5)
    from prt_bake.lights.environment import direction_of

    towards = direction_of(u / 256, v / 128, "y")
    assert polar.shape == turn.shape
    return sky(0.2 + sum(np.exp(20.0 * (towards @ axis - 1.0))[..., None] * colour for axis, colour in bumps))


def exact(light: Lighting, degree: int, sharpness: tuple[float, ...], axes: np.ndarray, count: int) -> np.ndarray:
    """[S,A,3] for each sharpness and axis, from sums over `count` directions."""
    towards = fibonacci(count)
    radiance = light.radiance(towards)
    basis = sh.evaluate(towards, degree)
    detail = radiance - basis @ (4.0 * np.pi / len(towards) * basis.T @ radiance)
    found = np.empty((len(sharpness), len(axes), 3))
    for number, axis in enumerate(axes):
        cosine = towards @ axis - 1.0
        for row, narrow in enumerate(sharpness):
            weight = np.exp(narrow * cosine)
            found[row, number] = weight @ detail / weight.sum()
    return found


@pytest.mark.parametrize("degree", [0, 2, 4])
def test_skies_are_averaged_with_the_gaussian(degree: int) -> None:
    light = smooth_sky()
    prepared = lobe_light(light, degree, 1.0, 60.0)
    ones = np.ones((len(AXES), 1))
    several = (1.0, 3.0, 20.0, 50.0)
    for sharpness, expected in zip(several, exact(light, degree, several, AXES, 20_000), strict=True):
        found = lobe_radiance(prepared, AXES[:, None], sharpness * ones, np.ones((len(AXES), 1, 3)))
        assert np.abs(found - expected).max() <= 0.02 * light.radiance(AXES).max(), sharpness


def test_a_constant_sky_adds_nothing() -> None:
    prepared = lobe_light(sky(np.full((16, 32, 3), 5.0)), 2, 0.3, 12.0)
    found = lobe_radiance(prepared, AXES[:, None], np.full((50, 1), 7.0), np.ones((50, 1, 3)))
    assert np.abs(found).max() <= 1e-5


@pytest.mark.parametrize("degrees", [5.0, 11.0, 30.0])
def test_suns_are_those_of_a_sky_with_a_disc(degrees: float) -> None:
    sun = read_lighting(f"sun:0.3,0.5,1:2,3,4:{degrees}")
    prepared = lobe_light(sun, 2, 0.3, 110.0)
    assert len(prepared.directions) == (degrees <= 12.0)
    towards = sun.suns[0].direction
    axes = np.stack([towards, *(towards + 0.2 * (AXES[:20] - towards))])
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    several = (20.0, 100.0)
    for sharpness, expected in zip(several, exact(sun, 2, several, axes, 200_000), strict=True):
        found = lobe_radiance(prepared, axes[:, None], np.full((len(axes), 1), sharpness), np.ones((len(axes), 1, 3)))
        assert np.abs(found - expected).max() <= 0.05 * np.abs(expected).max()


def test_radiance_is_linear_in_light_and_power() -> None:
    first, second = smooth_sky(), read_lighting("sun:0.3,0.5,1:2,3,4:0.5")
    both = Lighting(first.skies, second.suns)
    axes, sharpness = AXES[:, None], np.full((50, 1), 9.0)
    powers = np.random.default_rng(1).normal(size=(50, 1, 3))

    def under(light: Lighting, factor: float = 1.0) -> np.ndarray:
        return lobe_radiance(lobe_light(light, 2, 0.3, 12.0), axes, sharpness, factor * powers)

    assert np.allclose(under(both), under(first) + under(second), atol=1e-9)
    assert np.allclose(under(first, -3.0), -3.0 * under(first))
