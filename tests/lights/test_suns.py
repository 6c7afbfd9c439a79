"""Suns split from skies: energy, resolution, seams and poles, and skies without suns."""

import math

import numpy as np
import pytest

from formats.scene.lights import DirectionalLight
from prt_bake.lights import environment, sun_detection
from prt_bake.lights.lighting import Lighting, Sky
from prt_bake.lights.skies.bright_sources import find_bright_sources
from prt_bake.lights.sun_detection import MOST_SUNS, WIDEST, SplitSky, split_lighting, split_suns
from prt_bake.mathematics import sphere

TURN = sphere.random_rotations(1, 8)[0]


def directions(width: int) -> np.ndarray:
    """Of the pixels' centres [H,W,3]."""
    u, v = np.meshgrid((np.arange(width) + 0.5) / width, (np.arange(width // 2) + 0.5) / (width // 2))
    return environment.direction_of(u, v)


def clouds(width: int) -> np.ndarray:
    """A smooth coloured sky of a radiance around 1."""
    d = directions(width)
    return (1.0 + 0.5 * d @ np.array([[0.2, 0.5, 0.1], [0.6, 0.7, 0.9], [0.3, -0.1, 0.4]])).astype(np.float32)


def disc(width: int, towards, degrees: float, radiance) -> np.ndarray:
    inside = directions(width) @ (np.asarray(towards) / np.linalg.norm(towards)) >= math.cos(math.radians(degrees / 2))
    return (inside[..., None] * np.asarray(radiance)).astype(np.float32)


def energy(image: np.ndarray) -> np.ndarray:
    """∫ L dω [3], exactly."""
    return environment.project(image, 0)[0] * math.sqrt(4.0 * math.pi)


def split(image: np.ndarray, turn=None, up: str = "y") -> SplitSky:
    return split_suns(Sky(np.asarray(image, np.float32), up, np.eye(3) if turn is None else turn))


def reduced(image: np.ndarray, factor: int) -> np.ndarray:
    """Means over blocks of pixels, weighted by solid angle."""
    h, w = image.shape[0] // factor, image.shape[1] // factor
    rows = np.diff(-np.cos(np.pi * np.arange(len(image) + 1) / len(image)))
    weighted = (image * rows[:, None, None]).reshape(h, factor, w, factor, 3).sum(axis=(1, 3))
    return weighted / (factor * rows.reshape(h, factor).sum(axis=1))[:, None, None]


def angle(a, b) -> float:
    return math.degrees(2.0 * math.asin(min(1.0, 0.5 * float(np.linalg.norm(np.asarray(a) - np.asarray(b))))))


SUNNY = clouds(512) + disc(512, (0.3, 0.6, -0.5), 1.2, (9e4, 8e4, 6e4)) + disc(512, (-1, 0.2, 0.1), 5.0, (600, 300, 90))


def overlaps(fine: np.ndarray, coarse: np.ndarray) -> np.ndarray:
    """The share [C,F] of each coarse interval that each fine one covers; both are given by their edges."""
    common = np.minimum(fine[None, 1:], coarse[1:, None]) - np.maximum(fine[None, :-1], coarse[:-1, None])
    return np.maximum(common, 0.0) / np.diff(coarse)[:, None]


@pytest.mark.parametrize("shape", [(1, 1), (3, 700), (128, 256), (300, 31), (129, 257), (500, 999)])
def test_cells_are_means_over_solid_angle(shape: tuple[int, int]) -> None:
    """Compared with sums over all pixels at once, in more digits."""
    image = np.random.default_rng(5).random((*shape, 3), np.float32)
    height, width = (np.arange(size + 1).astype(np.longdouble) / size for size in shape)
    rows, columns = (np.arange(n + 1).astype(np.longdouble) / n for n in (min(shape[0], 128), min(shape[1], 256)))
    down = overlaps(np.sin(height * np.pi / 2) ** 2, np.sin(rows * np.pi / 2) ** 2)
    expected = down @ image.mean(axis=2, dtype=np.longdouble) @ overlaps(width, columns).T
    np.testing.assert_allclose(sun_detection._grid_of(image).grey, expected.astype(np.float64), rtol=1e-12)


@pytest.mark.parametrize("shape", [(512, 1024), (256, 512), (200, 300), (90, 777)])
def test_suns_and_rest_sum_to_the_energy_of_the_sky_in_every_channel(shape: tuple[int, int]) -> None:
    image = np.random.default_rng(1).random((*shape, 3)).astype(np.float32)
    for place in ((0.4, 0.3), (0.1, 0.8)):
        image[int(place[0] * shape[0]), int(place[1] * shape[1])] = (1e5, 5e4, 2e4)
    found = split(image)
    assert len(found.suns) == 2
    assert (found.rest.image >= 0.0).all()
    assert found.rest.image.max() < 10.0
    whole = sum(sun.irradiance for sun in found.suns) + energy(found.rest.image)
    np.testing.assert_allclose(whole, energy(image), rtol=1e-6)
    assert sum(found.shares) == pytest.approx(1.0 - energy(found.rest.image).mean() / energy(image).mean(), rel=1e-5)


def test_no_cell_belongs_to_two_sources() -> None:
    """A glow with texture, as of a sun through leaves: floods of neighbouring peaks meet."""
    rows, columns = 64, 128
    theta, phi = np.pi * (np.arange(rows)[:, None] + 0.5) / rows, 2.0 * np.pi * (np.arange(columns) + 0.5) / columns
    axes = np.stack(np.broadcast_arrays(np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)), -1)
    edges = np.cos(np.pi * np.arange(rows + 1) / rows)
    solid_angle = np.repeat((edges[:-1] - edges[1:])[:, None] * 2.0 * np.pi / columns, columns, axis=1)
    y, x = np.mgrid[0:rows, 0:columns]
    for seed, noise, spread in ((31, 0.3, 0.005), (31, 0.5, 0.005), (29, 0.8, 0.002), (44, 0.8, 0.005)):
        glow = np.exp(-((y - 0.4 * rows) ** 2 + (x - 0.5 * columns) ** 2) / (2 * (2 + seed % 4) ** 2))
        values = (0.5 + 1e3 * glow) * np.exp(noise * np.random.default_rng(seed).normal(size=(rows, columns)))
        sources = find_bright_sources(values, solid_angle, axes, spread, 1e-3 * (values * solid_angle).sum())
        cells = np.concatenate([source.cells for source in sources])
        assert len(sources) > 1
        assert len(np.unique(cells)) == len(cells)


def test_a_sun_of_a_colour_outside_the_gamut_keeps_the_energy_of_every_channel() -> None:
    image = clouds(256)
    image[40, 100] = (1e5, 3e4, -1e4)
    found = split(image)
    assert len(found.suns) == 1
    assert found.suns[0].irradiance[2] == 0.0
    whole = found.suns[0].irradiance + energy(found.rest.image)
    np.testing.assert_allclose(whole, energy(image), rtol=1e-5)


def test_the_input_sky_is_unchanged() -> None:
    before = SUNNY.copy()
    split(SUNNY)
    np.testing.assert_array_equal(SUNNY, before)
    calm = Sky(clouds(256), "y", np.eye(3))
    assert split_suns(calm).rest is calm


def test_a_reduced_picture_has_the_same_suns() -> None:
    """From 2048 columns to 256: irradiance within 1 %, direction within half a coarse pixel."""
    fine = (
        clouds(2048) + disc(2048, (0.3, 0.6, -0.5), 0.6, (1e5, 9e4, 7e4)) + disc(2048, (-1, 0.2, 0.1), 5, (250, 99, 9))
    )
    expected = split(fine).suns
    assert len(expected) == 2
    for factor in (2, 4, 8):
        found = split(reduced(fine, factor)).suns
        assert len(found) == 2
        for ours, theirs in zip(found, expected, strict=True):
            np.testing.assert_allclose(ours.irradiance, theirs.irradiance, rtol=1e-2)
            assert angle(ours.direction, theirs.direction) < 0.5 * 360.0 * factor / 2048


def test_direction_irradiance_and_diameter_of_a_sun_are_recovered() -> None:
    for degrees in (1.0, 5.0):
        towards = np.array([0.48, 0.6, 0.64])
        bright = disc(2048, towards, degrees, np.array([1000.0, 500.0, 250.0]) * (5.0 / degrees) ** 2)
        found = split(clouds(2048) + bright)
        (sun,) = found.suns
        # The surroundings continue where the sun was.
        assert np.abs((found.rest.image - clouds(2048)).mean(axis=2)).max() < 0.2
        assert angle(sun.direction, towards) < 0.02
        assert sun.angular_diameter == pytest.approx(degrees, rel=0.03)
        np.testing.assert_allclose(sun.irradiance, energy(bright), rtol=1e-2)


@pytest.mark.parametrize("up", ["y", "z"])
def test_a_rotated_sky_has_rotated_suns(up: str) -> None:
    still, turned = split(SUNNY, None, up), split(SUNNY, TURN, up)
    assert len(still.suns) == 2
    for ours, theirs in zip(turned.suns, still.suns, strict=True):
        np.testing.assert_allclose(ours.direction, TURN @ theirs.direction, atol=1e-12)
        np.testing.assert_array_equal(ours.irradiance, theirs.irradiance)


@pytest.mark.parametrize("columns", [64, 213])
def test_rolling_columns_rotates_the_suns(columns: int) -> None:
    still, rolled = split(SUNNY), split(np.roll(SUNNY, columns, axis=1))
    turn = environment.rotation(-360.0 * columns / 512, "y")
    for ours, theirs in zip(rolled.suns, still.suns, strict=True):
        # A roll by less than a cell changes the means over cells.
        assert angle(ours.direction, turn @ theirs.direction) < (1e-6 if columns % 2 == 0 else 0.05)
        np.testing.assert_allclose(ours.irradiance, theirs.irradiance, rtol=1e-6 if columns % 2 == 0 else 1e-2)


@pytest.mark.parametrize("factor", [1e-6, 0.25, 1024.0])
def test_suns_scale_with_the_sky(factor: float) -> None:
    still, scaled = split(SUNNY), split(SUNNY * np.float32(factor))
    for ours, theirs in zip(scaled.suns, still.suns, strict=True):
        np.testing.assert_allclose(ours.irradiance, factor * theirs.irradiance, rtol=1e-5)
        np.testing.assert_allclose(ours.direction, theirs.direction, atol=1e-6)
    np.testing.assert_allclose(scaled.rest.image, factor * still.rest.image, rtol=1e-5)


@pytest.mark.parametrize("towards", [(-1, 0.02, 0.0), (0, 1, 0), (0, -1, 0), (0.02, 1, 0.01), (1, 0, 0)])
@pytest.mark.parametrize("degrees", [1.0, 5.0])
def test_suns_at_the_seam_and_the_poles_are_found(towards, degrees: float) -> None:
    """The first is on the seam, the others at and near the poles."""
    bright = disc(1024, towards, degrees, np.array([2e3, 1e3, 1e3]) * (5.0 / degrees) ** 2)
    (sun,) = split(clouds(1024) + bright).suns
    assert angle(sun.direction, towards / np.linalg.norm(towards)) < 0.1
    np.testing.assert_allclose(sun.irradiance, energy(bright), rtol=2e-2)


def test_cells_across_a_pole_are_neighbours() -> None:
    values, solid_angle, direction = np.zeros((64, 128)), np.full((64, 128), 1e-3), np.zeros((64, 128, 3))
    values[-1, [0, 64]] = 5.0
    direction[-1] = [0.0, 0.0, -1.0]
    (source,) = find_bright_sources(values, solid_angle, direction, 0.1, 1e-3)
    assert source.cells.tolist() == [63 * 128, 63 * 128 + 64]
    assert source.excess == pytest.approx(1e-2)


def test_opposite_suns_and_close_suns_are_separated() -> None:
    towards = np.array([0.48, 0.6, 0.64])
    found = split(clouds(512) + disc(512, towards, 2, [3e3] * 3) + disc(512, -towards, 2, [2e3] * 3)).suns
    assert [angle(sun.direction, sign * towards) < 0.3 for sun, sign in zip(found, (1, -1), strict=True)] == [
        True,
        True,
    ]
    near = split(clouds(512) + disc(512, (1, 0, 0), 2, [3e3] * 3) + disc(512, (1, 0, 0.4), 2, [3e3] * 3)).suns
    assert len(near) == 2


def test_one_bright_texel_on_black_is_a_sun_with_all_energy() -> None:
    image = np.zeros((64, 128, 3), np.float32)
    image[20, 127] = (3e4, 2e4, 1e4)
    found = split(image)
    (sun,) = found.suns
    np.testing.assert_allclose(sun.irradiance, energy(image), rtol=1e-6)
    assert not found.rest.image.any()
    assert found.shares == pytest.approx((1.0,))
    assert 1.0 < sun.angular_diameter < 360.0 / 128 * 1.5


def test_only_the_strongest_suns_are_taken_strongest_first() -> None:
    image = clouds(512)
    for i in range(12):
        image = image + disc(512, (math.cos(i / 2), 0.4, math.sin(i / 2)), 2.0, [3e3 + 100 * i] * 3)
    found = split(image).suns
    powers = [float(sun.irradiance.mean()) for sun in found]
    assert len(found) == MOST_SUNS
    assert powers == sorted(powers, reverse=True)
    assert found[0].direction @ np.array([math.cos(5.5), 0.4, math.sin(5.5)]) > 1.0


NO_SUNS = {
    "black": np.zeros((64, 128, 3)),
    "one pixel": np.full((1, 1, 3), 7.0),
    "two pixels": np.array([[[1.0, 1.0, 1.0], [9e4, 9e4, 9e4]]]),
    "constant": np.full((256, 512, 3), 3.0),
    "smooth": clouds(512),
    "noise": np.random.default_rng(2).random((256, 512, 3)),
    "a bright half": disc(512, (0, 1, 0), 180.0, (9, 9, 9)),
    "a window": disc(512, (1, 0.2, 0.3), 25.0, (500, 500, 500)) + 0.1,
    "a noisy window": disc(512, (1, 0.2, 0.3), 25.0, (500, 500, 500))
    * (0.9 + 0.2 * np.random.default_rng(2).random((256, 512, 1))),
    "a bright horizon": np.repeat(np.where(abs(np.arange(256) - 128) < 3, 100.0, 0.1)[:, None, None], 512, 1)
    * np.ones(3),
    "pixels wider than suns": np.where(np.arange(16 * 8).reshape(8, 16, 1) == 40, 1e5, 1.0) * np.ones(3),
}


@pytest.mark.parametrize("name", NO_SUNS)
def test_wide_and_uniform_sources_are_not_suns(name: str) -> None:
    assert split(NO_SUNS[name]).suns == ()


def test_a_split_lighting_keeps_its_own_suns() -> None:
    own = DirectionalLight(np.array([0.0, 1.0, 0.0]), np.ones(3), 0.5)
    found = split_lighting(Lighting((Sky(SUNNY, "y", TURN), Sky(clouds(64), "z", TURN)), (own,)))
    assert found.suns[0] is own
    assert len(found.suns) == 3
    calm = Lighting((Sky(clouds(64), "z", TURN),), (own,))
    assert split_lighting(calm) is calm
    assert all(sun.angular_diameter < WIDEST for sun in found.suns)
