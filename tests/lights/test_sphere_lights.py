"""Sphere lights: exact as seen from the object's middle, with a report of what is neglected."""

import math
from pathlib import Path

import numpy as np
import pytest

from formats.errors import LightError, QueryError
from formats.mesh import Mesh, build_mesh
from formats.scene.lights import DirectionalLight, SphereLight, parse_sphere, read_lights
from prt_bake.lights import environment
from prt_bake.lights.harmonics import project_lighting
from prt_bake.lights.lighting import Lighting, radiance, read_lighting
from prt_bake.lights.sphere_lights import as_disc
from prt_bake.mathematics import sh, sphere
from tests.shapes import ball

MIDDLE = np.array([1.0, -2.0, 0.5])


def quiet(sentence: str) -> None:
    pass


def shifted_ball(size: float = 0.5) -> Mesh:
    """A ball off the origin."""
    mesh = ball(2)
    return build_mesh(size * mesh.positions + MIDDLE, mesh.faces)


def light(distance: float, radius: float, radiance: float = 2.0, towards: tuple = (0.48, 0.6, 0.64)) -> SphereLight:
    return SphereLight(MIDDLE + distance * np.array(towards), radius, radiance * np.array([3.0, 2.0, 1.0]))


def test_rays_from_the_middle_see_the_sphere() -> None:
    """A ray that meets the sphere sees its radiance; other rays see black."""
    lamp = light(3.0, 1.4)
    disc = as_disc(lamp, shifted_ball(), "lamp", quiet)
    d = sphere.uniform(20_000, 3)
    to_lamp = lamp.position - MIDDLE
    along = d @ to_lamp
    meets = (along > 0) & (to_lamp @ to_lamp - along**2 <= lamp.radius**2)
    seen = radiance((), (disc,), d)
    assert 1000 < meets.sum() < 4000
    np.testing.assert_array_equal(seen.any(axis=1), meets)
    np.testing.assert_allclose(seen[meets], np.tile(lamp.radiance, (meets.sum(), 1)), rtol=1e-9)


@pytest.mark.parametrize(("distance", "radius"), [(1.5, 0.7), (10.0, 3.0), (1e6, 1.0), (1e12, 1e-3)])
def test_irradiance_is_power_over_the_area_at_that_distance(distance: float, radius: float) -> None:
    """∫ L cos dω over the disc is power / 4π d² for every size."""
    lamp = light(distance, radius)
    disc = as_disc(lamp, shifted_ball(), "lamp", quiet)
    power = 4 * math.pi**2 * radius**2 * lamp.radiance
    # The mean cosine over the disc's cap is (1 + cos of its rim) / 2.
    mean = 0.5 * (1.0 + math.cos(math.radians(disc.angular_diameter) / 2.0))
    np.testing.assert_allclose(disc.irradiance * mean, power / (4 * math.pi * distance**2), rtol=1e-9)
    first = project_lighting(Lighting((), (disc,)), 1)[1:] @ [1.0, 0.0, 0.0]
    axis = sh.evaluate(disc.direction, 1)[1:]
    np.testing.assert_allclose(first, axis * disc.irradiance[0] * mean, rtol=1e-9, atol=1e-30)


def test_a_distant_sphere_is_a_directional_light_without_size() -> None:
    far = as_disc(light(1e9, 1e-2), shifted_ball(), "lamp", quiet)
    point = DirectionalLight(np.array([0.48, 0.6, 0.64]), math.pi * 1e-22 * np.array([6.0, 4.0, 2.0]), 0.0)
    found, expected = (project_lighting(Lighting((), (one,)), 3) for one in (far, point))
    np.testing.assert_allclose(found, expected, rtol=1e-6)


@pytest.mark.parametrize("up", ["y", "z"])
def test_rotating_the_light_moves_the_sphere_around_the_middle(up: str) -> None:
    mesh, lamp = shifted_ball(), light(3.0, 1.0)
    word = "sphere:" + ",".join(map(str, lamp.position)) + ":1.0:6,4,2"
    turned = read_lighting([word], up, 75.0, say=quiet, mesh=mesh)
    moved = SphereLight(MIDDLE + environment.rotation(75.0, up) @ (lamp.position - MIDDLE), 1.0, lamp.radiance)
    expected = project_lighting(Lighting((), (as_disc(moved, mesh, "lamp", quiet),)), 4)
    np.testing.assert_allclose(project_lighting(turned, 4), expected, rtol=0, atol=1e-12)
    still = project_lighting(read_lighting([word], up, say=quiet, mesh=mesh), 4)
    np.testing.assert_allclose(environment.rotate_light(still, 75.0, up), expected, rtol=0, atol=1e-12)


def test_neglected_parallax_and_falloff_are_reported() -> None:
    messages: list[str] = []
    as_disc(light(5.0, 0.1), shifted_ball(0.5), "lamp", messages.append)
    (sentence,) = messages
    # A ball of radius 0.5 at distance 5: asin 0.1, and 1/1.1² and 1/0.9².
    for words in ("lamp: ", "up to 5.7 degrees", "from -17.4% to +23.5%"):
        assert words in sentence


def test_a_sphere_that_reaches_the_object_is_refused() -> None:
    mesh = shifted_ball(0.5)
    as_disc(light(1.5, 0.99), mesh, "lamp", quiet)
    for distance, radius in ((1.5, 1.01), (0.0, 0.1), (0.3, 1e-3), (2.0, 1e300)):
        with pytest.raises(LightError, match=r"lamp: the sphere at .* reaches into the ball of radius 0\.5"):
            as_disc(light(distance, radius), mesh, "lamp", quiet)
    with pytest.raises(QueryError, match="pass its mesh"):
        read_lighting(["sphere:0,9,0:1"])


def test_a_lights_file_and_an_argument_are_equivalent(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text(
        "[[sphere]]\nposition = [0, 3, 1]\nradius = 0.25\nradiance = [4, 3, 2]\n"
        "[[sphere]]\nposition = [1, 2, 3]\nradius = 1\n"
    )
    filed, plain = read_lights(tmp_path / "a.toml")
    word = parse_sphere("sphere:0,3,1:0.25:4,3,2")
    for one in (filed, word):
        assert isinstance(one, SphereLight)
        assert (one.position.tolist(), one.radius, one.radiance.tolist()) == ([0, 3, 1], 0.25, [4, 3, 2])
    assert isinstance(plain, SphereLight)
    assert plain.radiance.tolist() == parse_sphere("sphere:1,2,3:1").radiance.tolist() == [1, 1, 1]
    both = read_lighting([tmp_path / "a.toml", "sphere:0,3,1:0.25:4,3,2"], say=quiet, mesh=ball(1))
    assert len(both.suns) == 3
    np.testing.assert_array_equal(both.suns[0].irradiance, both.suns[2].irradiance)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("sphere:", "expected sphere:x,y,z:radius"),
        ("sphere:1,2,3", "expected sphere:x,y,z:radius"),
        ("sphere:1,2:3", "expected sphere:x,y,z:radius"),
        ("sphere:1,2,3:x", "expected sphere:x,y,z:radius"),
        ("sphere:1,2,3:1:1", "expected sphere:x,y,z:radius"),
        ("sphere:1,nan,3:1", "position: expected three numbers"),
        ("sphere:1,2e30,3:1", r"position: expected three numbers \[x, y, z\] within ±1e30"),
        ("sphere:1,2,3:0", "radius: expected a number above 0"),
        ("sphere:1,2,3:inf", "radius: expected a number above 0"),
        ("sphere:1,2,3:2e30", "radius: expected a number above 0 and up to 1e30"),
        ("sphere:1,2,3:1:1,-1,1", "radiance: expected three"),
    ],
)
def test_an_invalid_sphere_argument_is_refused_in_one_sentence(text: str, sentence: str) -> None:
    with pytest.raises(LightError, match=sentence) as caught:
        parse_sphere(text)
    assert text in str(caught.value)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("radius = 1", "sphere.0.position: is missing"),
        ("position = [0, 1, 0]", "sphere.0.radius: is missing; expected a number above 0"),
        (
            "position = [0, 1, 0]\nradius = 0",
            "radius: expected a number above 0 and up to 1e30, in scene units, found 0",
        ),
        ("position = [0, 1, 0]\nradius = 2e30", "sphere.0.radius: expected a number above 0 and up to 1e30"),
        ("position = [0, 1]\nradius = 1", "sphere.0.position: expected three numbers"),
        ("position = [0, 1, -2e30]\nradius = 1", "sphere.0.position: expected three numbers"),
        ("position = [0, 1, 0]\nradius = 1\npower = 3", "sphere.0.power: unknown key; expected position"),
        ("position = [0, 1, 0]\nradius = 1\nradiance = [1, -1, 1]", "radiance: expected three numbers"),
    ],
)
def test_an_invalid_sphere_table_is_refused_in_one_sentence(tmp_path: Path, text: str, sentence: str) -> None:
    (tmp_path / "a.toml").write_text(f"[[sphere]]\n{text}\n")
    with pytest.raises(LightError, match=sentence):
        read_lights(tmp_path / "a.toml")
