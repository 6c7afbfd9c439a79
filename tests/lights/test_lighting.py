"""Lightings without an object: reading, look-up, importance sampling and its densities."""

import math
from pathlib import Path

import numpy as np
import pytest

from formats.errors import LightError, QueryError, StorageError
from formats.image import write_image
from formats.scene.lights import DirectionalLight
from prt_bake.lights import environment
from prt_bake.lights.emitters import BrightSky, Connections, Disc, LightSampler, plan_light, split_sky
from prt_bake.lights.lighting import Lighting, Sky, in_disc, radiance, read_lighting, solid_angle
from prt_bake.mathematics.random import uniforms
from tests.mathematics.sampling import SphereCells, assert_counts_follow, assert_mean_is

WORTH = Connections(variance=0.8, cost=1.5)


def sun(direction=(0.0, 0.6, 0.8), irradiance=(3.0, 2.0, 1.0), diameter=0.0) -> DirectionalLight:
    return DirectionalLight(np.array(direction), np.array(irradiance), diameter)


def sky(height: int, width: int, up: str = "y", degrees: float = 30.0, seed: int = 1) -> Sky:
    image = np.random.default_rng(seed).random((height, width, 3)).astype(np.float32) ** 4
    image[::2, 1::3] = 0.0
    return Sky(image, up, environment.rotation(degrees, up))


def fine_grid(light: Sky) -> tuple[np.ndarray, np.ndarray]:
    """The midpoints of a fine grid over the sphere: directions [N,3], and radiance times solid angle [N,3]."""
    v, u = np.meshgrid((np.arange(300) + 0.5) / 300, (np.arange(600) + 0.5) / 600, indexing="ij")
    directions = environment.direction_of(u.ravel(), v.ravel(), light.up) @ light.turn.T
    measure = 2 * math.pi**2 * np.sin(math.pi * v.ravel()) / v.size
    return directions, light.radiance(directions) * measure[:, None]


@pytest.mark.parametrize("shape", [(1, 1), (1, 5), (4, 1), (2, 3), (7, 6)])
@pytest.mark.parametrize("up", ["y", "z"])
def test_sky_samples_estimate_integrals_of_its_radiance(shape: tuple[int, int], up: str) -> None:
    light = sky(*shape, up)
    light.image[0, 0] = [1.0, 3.0, 0.5]
    directions, weights = BrightSky(light).draw(uniforms((7, np.arange(100_000)), 3))
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0, rtol=1e-12)
    grid, energy = fine_grid(light)
    bump = np.array([0.48, -0.6, 0.64])
    for value in (lambda d: 1.0 + d[:, 0], lambda d: d[:, 1] * d[:, 2], lambda d: np.exp(6 * (d @ bump - 1))):
        for channel in range(3):
            assert_mean_is(weights[:, channel] * value(directions), (energy[:, channel] * value(grid)).sum())


@pytest.mark.parametrize(("shape", "up"), [((1, 1), "y"), ((4, 1), "y"), ((7, 6), "z")])
def test_sky_samples_follow_the_bilinear_density(shape: tuple[int, int], up: str) -> None:
    """Over (u, v): the look-up of mean radiance times the sine of the row's zenith angle."""
    light = sky(*shape, up)
    light.image[0, 0] = [1.0, 3.0, 0.5]
    directions, _weights = BrightSky(light).draw(uniforms((10, np.arange(100_000)), 3))
    u, v = environment.pixel_of(directions @ light.turn, up)
    sines = np.sin(np.pi * (np.arange(shape[0]) + 0.5) / shape[0])
    pixels = light.image.mean(axis=2, dtype=np.float64) * sines[:, None]
    rows, columns, fine = 28, 24, 16
    fine_v, fine_u = np.meshgrid(
        (np.arange(rows * fine) + 0.5) / (rows * fine),
        (np.arange(columns * fine) + 0.5) / (columns * fine),
        indexing="ij",
    )
    density = environment.radiance_at(pixels[..., None], fine_u.ravel(), fine_v.ravel())
    expected = density.reshape(rows, fine, columns, fine).sum(axis=(1, 3))
    counts = np.histogram2d(v, u, bins=(rows, columns), range=[[0, 1], [0, 1]])[0]
    assert_counts_follow(counts.ravel(), expected.ravel() / expected.sum())


@pytest.mark.parametrize(("shape", "up"), [((1, 1), "y"), ((4, 1), "y"), ((5, 9), "z")])
def test_the_density_of_a_sky_is_that_of_its_samples(shape: tuple[int, int], up: str) -> None:
    """It integrates to 1, samples follow it, and their weight is radiance over density."""
    light = BrightSky(sky(*shape, up))
    grid, energy = fine_grid(sky(*shape, up))
    radiance, density = light.look_up(grid)
    measure = np.repeat(2 * math.pi**2 * np.sin(math.pi * (np.arange(300) + 0.5) / 300), 600) / len(grid)
    np.testing.assert_allclose(radiance * measure[:, None], energy, rtol=1e-6, atol=1e-12)
    probabilities = (density * measure).reshape(12, 25, 24, 25).sum(axis=(1, 3))
    assert probabilities.sum() == pytest.approx(1.0, abs=1e-4)
    directions, weights = light.draw(uniforms((11, np.arange(100_000)), 3))
    u, v = environment.pixel_of(directions @ sky(*shape, up).turn, up)
    counts = np.histogram2d(v, u, bins=(12, 24), range=[[0, 1], [0, 1]])[0]
    assert_counts_follow(counts.ravel(), probabilities.ravel() / probabilities.sum())
    drawn = light.look_up(directions)
    np.testing.assert_allclose(weights * drawn[1][:, None], drawn[0], rtol=1e-9, atol=1e-12)


def test_a_light_sampler_covers_all_lights_with_a_size() -> None:
    """Two skies and two discs, one wide, one narrow; a light without size is left out."""
    lights = Lighting(
        (sky(8, 16), sky(5, 4, "z", seed=2)), (sun(diameter=60.0), sun((0.0, -0.6, 0.8)), sun(diameter=9.0))
    )
    sampler = LightSampler(lights)
    directions = sampler.draw(uniforms((12, np.arange(100_000)), 3)[None])
    assert directions.shape == (1, 100_000, 3)
    radiance, density = sampler.look_up(directions)
    np.testing.assert_allclose(radiance[0], lights.radiance(directions[0]), rtol=1e-6)
    np.testing.assert_array_equal(sampler.density(directions), density)
    for value in (lambda d: 1.0 + d[:, 0], lambda d: d[:, 1] * d[:, 2]):
        whole = sum((energy * value(grid)[:, None]).sum(axis=0) for grid, energy in map(fine_grid, lights.skies))
        for one in (lights.suns[0], lights.suns[2]):
            on_disc, weight = Disc(one).draw(uniforms((13, np.arange(400_000)), 3))
            whole = whole + (weight * value(on_disc)[:, None]).mean(axis=0)
        seen = radiance[0] / density[0][:, None] * value(directions[0])[:, None]
        for channel in range(3):
            assert_mean_is(seen[:, channel], whole[channel])
    grid, _energy = fine_grid(lights.skies[0])
    measure = np.repeat(2 * math.pi**2 * np.sin(math.pi * (np.arange(300) + 0.5) / 300), 600) / len(grid)
    assert (sampler.density(grid) * measure).sum() == pytest.approx(1.0, abs=5e-3)  # edges of discs cross the grid


def test_samples_of_black_lights_are_uniform() -> None:
    dark = Sky(np.zeros((2, 3, 3), np.float32), "y", np.eye(3))
    sampler = LightSampler(Lighting((dark,), (sun(),)))
    directions = sampler.draw(uniforms((14, np.arange(50_000)), 3))
    np.testing.assert_array_equal(sampler.density(directions), 0.25 / math.pi)
    cells = SphereCells(8, 16)
    assert_counts_follow(cells.count(directions), np.full(128, 1 / 128))


def test_a_sun_in_a_sky_makes_no_large_weights() -> None:
    light = sky(64, 128)
    light.image[20, 40] = 1e5
    sampler = LightSampler(Lighting((light,)))
    directions = sampler.draw(uniforms((15, np.arange(50_000)), 3))
    radiance, density = sampler.look_up(directions)
    weights = radiance.mean(axis=1) / density
    assert weights.std() < 0.05 * weights.mean()
    assert weights.max() < 3 * weights.mean()


def test_weights_of_a_single_bright_pixel_hardly_vary() -> None:
    light = Sky(np.zeros((64, 128, 3), np.float32), "y", np.eye(3))
    light.image[20, 0] = 1e5
    directions, weights = BrightSky(light).draw(uniforms((8, np.arange(20_000)), 3))
    assert weights.std() < 0.03 * weights.mean()
    assert (light.radiance(directions) > 0).all()
    columns = environment.pixel_of(directions)[0] * 128
    assert ((columns < 1.5) | (columns > 127.5)).all()


@pytest.mark.parametrize("radiance", [1.0, 0.1, 7e-5])
def test_a_constant_sky_has_no_bright_part(radiance: float) -> None:
    """Its mean differs from its radiance by a rounding error, which must not count as a bright part."""
    for height in (1, 4, 5, 8, 33):
        light = Sky(np.full((height, 2 * height, 3), radiance, np.float32), "y", np.eye(3))
        bright, rest = split_sky(light, Connections(variance=0.8, cost=0.0))
        assert bright is None
        np.testing.assert_array_equal(rest.image, light.image)


def test_the_parts_of_a_split_sky_sum_to_it() -> None:
    light = sky(16, 32)
    light.image[5, 7] = 1e5
    bright, rest = split_sky(light, WORTH)
    assert bright is not None
    directions = np.random.default_rng(2).normal(size=(5000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    whole = light.radiance(directions)
    np.testing.assert_allclose(bright.radiance(directions) + rest.radiance(directions), whole, rtol=1e-6, atol=1e-12)
    assert min(bright.image.min(), rest.image.min()) >= 0
    assert rest.image.mean(axis=2).max() < light.image.mean(axis=2).max() / 100
    np.testing.assert_allclose(rest.image[5, 7], rest.image[5, 7, 0], rtol=1e-6)


def test_skies_without_bright_parts_are_not_split() -> None:
    for image in (np.ones((8, 16, 3)), np.zeros((8, 16, 3)), 1.0 + sky(8, 16).image):
        light = Sky(image.astype(np.float32), "y", np.eye(3))
        bright, rest = split_sky(light, Connections(variance=2.0, cost=4.0))
        assert bright is None
        assert rest is light


def test_without_connections_walks_meet_all_lights() -> None:
    light = sky(16, 32)
    light.image[5, 7] = 1e5
    lighting = Lighting((light,), (sun(diameter=1.0),))
    plan = plan_light(lighting, None)
    assert (plan.emitters, plan.skies, plan.suns) == ((), lighting.skies, lighting.suns)
    plan = plan_light(lighting, WORTH)
    assert [type(emitter) for emitter in plan.emitters] == [Disc, BrightSky]
    assert plan.suns == ()


@pytest.mark.parametrize("diameter", [0.0, 1e-5, 0.53, 40.0, 180.0])
def test_a_disc_is_sampled_uniformly_to_its_edge(diameter: float) -> None:
    light = sun(diameter=diameter)
    directions, weights = Disc(light).draw(uniforms((9, np.arange(50_000)), 3))
    np.testing.assert_array_equal(weights, np.broadcast_to([3.0, 2.0, 1.0], weights.shape))
    distance = np.linalg.norm(directions - light.direction, axis=1)  # the chord, 2 sin(angle / 2)
    chord = 2 * math.sin(math.radians(diameter) / 4)
    assert distance.max() <= chord * (1 + 1e-9) + 1e-15
    if diameter > 0:
        # The solid angle within a chord c is π c²: uniform if c² is.
        assert_mean_is((distance / chord) ** 2, 0.5)
        across = np.cross(light.direction, [1.0, 0.0, 0.0])
        turn = np.arctan2(directions @ np.cross(light.direction, across), directions @ across) / (2 * math.pi) % 1.0
        counts = np.histogram2d((distance / chord) ** 2, turn, bins=16, range=[[0, 1], [0, 1]])[0]
        assert_counts_follow(counts.ravel(), np.full(256, 1 / 256))
        assert in_disc(light, directions[distance < chord * (1 - 1e-9)]).all()
        assert_mean_is(directions @ across / chord, 0.0)
    else:
        assert not in_disc(light, directions).any()


def test_the_radiance_of_a_disc_is_irradiance_over_solid_angle() -> None:
    light = sun(diameter=60.0)
    d = np.random.default_rng(3).normal(size=(200_000, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    assert solid_angle(light) == pytest.approx(2 * math.pi * (1 - math.cos(math.radians(30))))
    assert_mean_is(radiance((), (light,), d)[:, 0] * 4 * math.pi, 3.0)
    inside = d @ light.direction > math.cos(math.radians(30))
    np.testing.assert_array_equal(radiance((), (light,), d).any(axis=1), inside)


def test_all_kinds_of_lights_are_read_and_rotated_together(tmp_path: Path) -> None:
    image = sky(8, 16).image
    write_image(tmp_path / "sky.exr", image)
    (tmp_path / "lights.toml").write_text(
        '[[sky]]\nfile = "sky.exr"\nrotate = 90\nexposure = 1\ntint = [1, 2, 0.5]\n'
        "[[directional]]\ndirection = [1, 0, 0]\n"
    )
    given = [tmp_path / "sky.exr", tmp_path / "lights.toml", "sun:0,0,1:2,2,2:3"]
    lighting = read_lighting([str(light) for light in given], up="y", rotate=90.0)
    assert (len(lighting.skies), len(lighting.suns)) == (2, 2)
    np.testing.assert_allclose([light.direction for light in lighting.suns], [[0, 0, -1], [1, 0, 0]], atol=1e-15)
    d = environment.direction_of([0.3, 0.55, 0.8], [0.2, 0.5, 0.9])
    first = environment.lookup(image, d @ environment.rotation(90.0))
    second = 2 * environment.lookup(image, d @ environment.rotation(180.0)) * [1.0, 2.0, 0.5]
    np.testing.assert_allclose(lighting.radiance(d), first + second, rtol=1e-6)


def test_content_hashes_of_lightings_differ(tmp_path: Path) -> None:
    light = sky(8, 16)
    base = Lighting((light,), (sun(),))
    others = [
        Lighting((light,)),
        Lighting((light,), (sun(diameter=1.0),)),
        Lighting((light,), (sun(irradiance=(3.0, 2.0, 1.5)),)),
        Lighting((light,), (sun(direction=(0.0, 0.8, 0.6)),)),
        Lighting((sky(8, 16, seed=2),), (sun(),)),
        base.turned(1.0, "y"),
        Lighting((sky(8, 16, "z"),), (sun(),)),
    ]
    assert len({lighting.content_hash() for lighting in [base, *others]}) == 8
    assert Lighting((sky(8, 16),), (sun(),)).content_hash() == base.content_hash()


def test_invalid_lights_are_refused(tmp_path: Path) -> None:
    with pytest.raises(QueryError, match="light: there is none"):
        read_lighting([])
    with pytest.raises(LightError, match="sun:0,0,0"):
        read_lighting(["sun:0,0,0"])
    write_image(tmp_path / "sky.exr", np.full((4, 8, 3), 1e30, np.float32))
    (tmp_path / "a.toml").write_text('[[sky]]\nfile = "sky.exr"\nexposure = 60\n')
    with pytest.raises(LightError, match=r"a\.toml: sky\.file: .*sky\.exr: its exposure and tint make it brighter"):
        read_lighting([tmp_path / "a.toml"])
    (tmp_path / "a.toml").write_text('[[sky]]\nfile = "sky.exr"\nexposure = -64\ntint = [0, 0, 1e-30]\n')
    write_image(tmp_path / "sky.exr", np.full((4, 8, 3), 1e-4, np.float32))
    said = list[str]()
    read_lighting([tmp_path / "a.toml"], say=said.append)
    assert [text for text in said if "make it black" in text]
    (tmp_path / "b.toml").write_text('[[sky]]\nfile = "none.hdr"\n')
    with pytest.raises(StorageError, match=r"b\.toml: sky\.file: .*none\.hdr: there is no such file"):
        read_lighting([tmp_path / "b.toml"])
