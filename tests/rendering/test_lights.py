"""Pictures under suns: directional lights, and skies with one very bright pixel."""

import math
from pathlib import Path

import numpy as np
import pytest

from formats.errors import QueryError
from formats.scene import Scene
from formats.scene.lights import DirectionalLight
from prt_bake.lights.lighting import Lighting, Sky, as_lighting
from prt_bake.rendering.scene import SHOWS, SHOWS_ROUGH, Rendering, render_scene
from prt_bake.tracer.estimate import estimate_transport
from prt_bake.tracer.kernels import sum_transport
from prt_bake.tracer.light_samples import sample_transport
from prt_bake.tracer.prepared import prepare
from tests.mathematics.significance import assert_agree
from tests.rendering.pictures import WHITE, front, make_scene, mean_z, uneven_sky, z_score
from tests.tracer.nested_scenes import nested_scene
from tests.tracer.scenes import lumpy, moved, queries, sphere, unit_directions
from tests.tracer.scenes import make_scene as scene_of

pytestmark = pytest.mark.statistics

ROUGH = {"eta": 1.4, "roughness": 0.3}
MATCHED: dict[str, float] = {}
SMOOTH = {"eta": 1.4}


def sun(direction=(-0.36, 0.48, 0.8), irradiance=(3.0, 2.0, 1.0), diameter=0.0) -> DirectionalLight:
    return DirectionalLight(np.array(direction), np.array(irradiance), diameter)


def render(scene: Scene, light, spp: int = 64, seed: int = 1, size: int = 16, **options) -> Rendering:
    return render_scene(scene, light, front(size=size), spp=spp, seed=seed, **options)


def without_connections(monkeypatch: pytest.MonkeyPatch, *arguments, **options) -> Rendering:
    with monkeypatch.context() as patch:
        patch.setattr("prt_bake.rendering.walks.connections", lambda scene: None)
        return render(*arguments, **options)


@pytest.mark.parametrize("interface", [MATCHED, ROUGH, SMOOTH])
def test_scattered_and_unscattered_light_sum_to_all_light(tmp_path: Path, interface: dict[str, float]) -> None:
    """All three use the same walks. Behind a rough interface all light is part of Ŝ, and none counts as unscattered."""
    scene = make_scene(tmp_path, "[0.9, 0.7, 0.5]", sigma_t=1.0, **interface)
    lighting = Lighting((Sky(uneven_sky(), "y", np.eye(3)),), (sun(diameter=40.0),))
    both, scattered, unscattered = (
        render(scene, lighting, shown=shown, background=False) for shown in ("all", "scattered", "unscattered")
    )
    np.testing.assert_allclose(scattered.image + unscattered.image, both.image, rtol=1e-5, atol=1e-6)
    assert (scattered.image[4:12, 4:12] > 0.0).all()
    assert unscattered.black == (interface is ROUGH)
    assert (unscattered.walks == 0) == (interface is ROUGH)
    shows = {**SHOWS, "all": SHOWS_ROUGH} if interface is ROUGH else SHOWS
    assert [picture.shows for picture in (both, scattered, unscattered)] == list(shows.values())


def test_another_value_of_shown_is_refused_before_any_work(tmp_path: Path) -> None:
    with pytest.raises(QueryError, match="shown: expected 'all', 'scattered', 'unscattered', found 'reflected'"):
        render(make_scene(tmp_path), as_lighting(WHITE, "y", 0.0), shown="reflected")


def test_clear_glass_shows_unscattered_light_only(tmp_path: Path) -> None:
    """In a white furnace the radiance is 1, except for reflected light."""
    scene = make_scene(tmp_path, sigma_t=1e-6, eta=1.4)
    assert render(scene, as_lighting(WHITE, "y", 0.0), shown="scattered", background=False).image.max() < 1e-3
    unscattered = render(scene, as_lighting(WHITE, "y", 0.0), shown="unscattered", background=False)
    assert 0.9 < unscattered.image[6:10, 6:10].mean() < 1.0


@pytest.mark.parametrize("interface", [MATCHED, ROUGH])
def test_connected_walks_estimate_the_transport_function(tmp_path: Path, interface: dict[str, float]) -> None:
    scene = scene_of(tmp_path, lumpy(2), **interface)
    positions, outgoing, _normals = queries(scene.mesh, 6, 1)
    incident = unit_directions(18, 2).reshape(6, 3, 3)
    at = prepare(scene).surface.locate(positions, outgoing)
    keys = np.arange(6, dtype=np.uint64)
    mean = sample_transport(scene, at.faces, at.barycentric, outgoing, keys, incident, 2048, 5)
    expected = estimate_transport(scene, positions, outgoing, incident, 2048, 6, connections=3)
    assert_agree(mean, expected.standard_error, expected.mean, expected.standard_error)
    shared = sample_transport(scene, at.faces, at.barycentric, outgoing, keys, incident[0], 2048, 5)
    np.testing.assert_array_equal(shared[0], mean[0])
    # A second signature would cost every user a minute of compilation.
    assert len(sum_transport.signatures) == 1


@pytest.mark.parametrize("interface", [MATCHED, ROUGH])
def test_a_wide_disc_looks_the_same_with_and_without_connections(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, interface: dict[str, float]
) -> None:
    scene = make_scene(tmp_path, "[0.9, 0.7, 0.5]", **interface)
    lighting = Lighting((), (sun(diameter=50.0), sun((0.8, 0.0, -0.6), (1.0, 1.0, 4.0), 30.0)))
    connected = render(scene, lighting, 256)
    unconnected = without_connections(monkeypatch, scene, lighting, 256, 2)
    assert np.abs(mean_z(connected, unconnected)).max() < 4
    assert abs(z_score(connected, unconnected)) < 4
    inside = connected.coverage == 1
    assert np.mean(unconnected.standard_error[inside] ** 2) > 2 * np.mean(connected.standard_error[inside] ** 2)


@pytest.mark.parametrize("interface", [MATCHED, ROUGH])
def test_connections_reduce_the_noise_of_a_sky_with_a_sun_tenfold(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, interface: dict[str, float]
) -> None:
    scene = make_scene(tmp_path, "[0.9, 0.7, 0.5]", **interface)
    sky = uneven_sky()
    sky[5, 20] = 1e5 * np.array([1.0, 0.9, 0.7])
    connected = render(scene, sky, 64)
    unconnected = without_connections(monkeypatch, scene, sky, 2048, 2)
    assert np.abs(mean_z(connected, unconnected)).max() < 4
    inside = connected.coverage == 1
    a_walk = [64 * connected.standard_error[inside] ** 2, 2048 * unconnected.standard_error[inside] ** 2]
    assert np.mean(a_walk[1]) > 10 * np.mean(a_walk[0])


def test_two_hemispheres_of_light_are_a_white_furnace(tmp_path: Path) -> None:
    """Index-matched: connected and unscattered light sum to a radiance of 1 everywhere."""
    up, down = (sun((0.0, y, 0.0), [2 * math.pi] * 3, 180.0) for y in (1.0, -1.0))
    picture = render(make_scene(tmp_path, "1.0", sigma_t=1.0), Lighting((), (up, down)), 256)
    inside = picture.coverage == 1
    # All channels share their walks.
    excess = picture.image[inside].astype(np.float64).mean(axis=1) - 1.0
    assert abs(excess.sum()) < 4 * np.sqrt((picture.standard_error[inside][:, 0].astype(np.float64) ** 2).sum())
    np.testing.assert_allclose(picture.image[picture.coverage == 0], 1.0, rtol=1e-6)


@pytest.mark.parametrize("sky", [False, True])
def test_a_disc_is_visible_through_an_empty_object(tmp_path: Path, sky: bool) -> None:
    """An index-matched object without a medium is invisible."""
    light = sun((0.0, 0.0, -1.0), (3.0, 2.0, 1.0), 12.0)
    skies = as_lighting(uneven_sky(), "y", 0.0).skies if sky else ()
    scene = make_scene(tmp_path, sigma_t=0.0)
    picture = render(scene, Lighting(skies, (light,)), 32, size=24)
    beside = render_scene(scene, Lighting(skies, (light,)), front((0.0, 0.0, -4.0), 24), spp=32)
    radiance = np.array([3.0, 2.0, 1.0]) / (2 * math.pi * (1 - math.cos(math.radians(6))))
    middle = picture.image[11:13, 11:13]
    background = uneven_sky().max() if sky else 0.0
    assert (np.abs(middle - radiance) <= background * 1.01 + 1e-4).all()
    assert picture.image[2:4, 11:13].max() <= background
    assert beside.image.max() <= background
    seen = picture.image.astype(np.float64).sum(axis=(0, 1))
    if not sky:
        assert seen[0] / seen[2] == pytest.approx(3.0)


def test_light_scales_and_rotates(tmp_path: Path) -> None:
    scene = make_scene(tmp_path, "0.8", **ROUGH)
    one = render(scene, Lighting((), (sun(irradiance=(1.0, 2.0, 0.5)),)))
    twice = render(scene, Lighting((), (sun(irradiance=(2.0, 4.0, 1.0)),)))
    np.testing.assert_allclose(twice.image, 2 * one.image, rtol=1e-5)
    assert one.image[one.coverage == 0].max() == 0
    turned = render_scene(
        scene, Lighting((), (sun(irradiance=(1.0, 2.0, 0.5)),)), front((4.0, 0.0, 0.0)), spp=64, seed=2, rotate=90.0
    )
    assert abs(z_score(one, turned)) < 4
    assert np.abs(mean_z(one, turned)).max() < 4
    unturned = render_scene(scene, Lighting((), (sun(irradiance=(1.0, 2.0, 0.5)),)), front((4.0, 0.0, 0.0)))
    assert np.abs(mean_z(one, unturned)).min() > 6


def test_behind_a_smooth_interface_walks_hit_the_disc_when_they_leave(tmp_path: Path) -> None:
    scene = make_scene(tmp_path, "0.8", **SMOOTH)
    up, down = (sun((0.0, y, 0.0), [2 * math.pi] * 3, 180.0) for y in (1.0, -1.0))
    hemispheres = render(scene, Lighting((), (up, down)))
    furnace = render(scene, np.ones((4, 8, 3), np.float32))
    np.testing.assert_allclose(hemispheres.image, furnace.image, rtol=1e-5)
    with pytest.raises(QueryError, match=r"ball\.toml: the interface of 'object' is smooth; .* angular diameter"):
        render(scene, Lighting((), (sun(diameter=2.0), sun())))


def test_a_sun_in_the_sky_and_a_directional_light_agree(tmp_path: Path) -> None:
    """One bright pixel of a black sky, and a light of equal irradiance from its middle."""
    scene = make_scene(tmp_path, "[0.9, 0.7, 0.5]")
    sky = np.zeros((128, 256, 3), np.float32)
    sky[40, 70] = 1e5
    zenith, azimuth = math.pi * 40.5 / 128, 2 * math.pi * (70.5 / 256 - 0.5)
    direction = (math.cos(azimuth) * math.sin(zenith), math.cos(zenith), math.sin(azimuth) * math.sin(zenith))
    irradiance = 1e5 * (math.pi / 128) * (2 * math.pi / 256) * math.sin(zenith)
    pixel = render(scene, Lighting((Sky(sky, "y", np.eye(3)),)), 256, background=False)
    light = render(scene, Lighting((), (sun(direction, [irradiance] * 3),)), 256, 2)
    assert np.abs(mean_z(pixel, light)).max() < 4
    assert abs(z_score(pixel, light)) < 4


INSIDE = {
    "diffuse": {"surface": "diffuse", "reflectance": [0.8, 0.5, 0.2]},
    "smooth": {"interface": {"eta": 1.6}, "medium": {"sigma_t": 2.0, "albedo": 0.9}},
    "rough": {"interface": {"eta": 1.6, "roughness": 0.3}, "medium": {"sigma_t": 2.0, "albedo": 0.9}},
}


@pytest.mark.parametrize(
    ("interface", "part"), [(MATCHED, "diffuse"), (MATCHED, "rough"), (ROUGH, "diffuse"), (ROUGH, "smooth")]
)
def test_nested_objects_look_the_same_with_and_without_connections(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, interface: dict[str, float], part: str
) -> None:
    within = {"mesh": moved(sphere(2), 0.5), "name": "within", **INSIDE[part]}
    scene = nested_scene(tmp_path, sphere(2), {"sigma_t": 1.0, "albedo": 0.8}, (within,), **interface)
    sky = uneven_sky()
    sky[5, 20] = 300.0
    lighting = Lighting(as_lighting(sky, "y", 0.0).skies, (sun(diameter=60.0),))
    connected = render(scene, lighting, 256)
    unconnected = without_connections(monkeypatch, scene, lighting, 512, 2)
    assert np.abs(mean_z(connected, unconnected)).max() < 4


def test_a_smooth_nested_part_hides_a_light_without_size(tmp_path: Path) -> None:
    within = {"mesh": moved(sphere(2), 0.5), "name": "within", **INSIDE["smooth"]}
    scene = nested_scene(tmp_path, sphere(2), {"sigma_t": 1.0, "albedo": 0.8}, (within,))
    with pytest.raises(QueryError, match="the interface of 'within' is smooth"):
        render(scene, Lighting((), (sun(),)))
    assert render(scene, Lighting((), (sun(diameter=60.0),))).image.max() > 0
