"""The plotter draws the same pixels as `prtbake shade`."""

import dataclasses
import math

import numpy as np
import pytest

from formats.asset import Asset
from formats.mesh import Mesh, build_mesh
from prt_bake.geometry import camera
from prt_bake.geometry.camera import Visibility
from prt_bake.lights import environment
from prt_bake.lights.lighting import as_lighting
from prt_bake.shading.picture import render_picture
from tests.preview.windows import bare_picture, encoded, open_window, press, write_sky
from tests.shading.test_picture import constant, make_asset, painted_sky
from tests.shapes import ball, ring

SIZE = (120, 90)


@pytest.fixture(autouse=True)
def _own_folder(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)


def both(asset: Asset, sky: np.ndarray, path, eye=None, rotation=0.0, exposure=0.0):
    """Return the window's picture, that of `prtbake shade`, both encoded, and the object's coverage."""
    window = open_window(asset, [write_sky(path, sky)], SIZE, eye, rotation=rotation, exposure=exposure)
    view = camera.fit(asset.mesh, *SIZE, eye=eye, up=asset.up)
    picture = render_picture(asset, as_lighting(sky, asset.up, rotation), view, samples=4)
    found = bare_picture(window)
    window.plotter.close()
    return found, encoded(picture.image, exposure), picture.coverage


def agree(found: np.ndarray, expected: np.ndarray, coverage: np.ndarray) -> None:
    """Assert equality within about one level, except at edges, which both average over different samples."""
    off = np.abs(found - expected).max(axis=2)
    for part in (coverage == 1.0, coverage == 0.0):
        if part.any():
            assert np.quantile(off[part], 0.98) <= 1.0
            assert off[part].mean() < 0.4
    assert off.mean() < 3.0


@pytest.mark.parametrize("up", ["y", "z"])
@pytest.mark.parametrize(("rotation", "exposure"), [(0.0, 0.0), (65.0, -1.5), (-120.0, 0.7)])
def test_the_first_picture(tmp_path, up, rotation, exposure) -> None:
    asset = make_asset(ring(), up=up)
    agree(*both(asset, 0.2 * painted_sky(), tmp_path / "sky.exr", None, rotation, exposure))


def test_invalid_vertices_do_not_darken_their_faces(tmp_path) -> None:
    valid = np.random.default_rng(0).random(258) > 0.4
    found, expected, coverage = both(make_asset(ball(3), valid=valid), 0.2 * constant(), tmp_path / "sky.exr")
    inside = coverage == 1.0
    off = np.abs(found - expected).max(axis=2)[inside]
    assert np.quantile(off, 0.8) <= 1.0  # edges of black faces differ
    assert off.mean() < 8.0
    assert (expected[inside] == 0.0).any()  # some faces have no valid vertex


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("away", [0.0, 1e4])
def test_objects_of_any_size_and_position(tmp_path, scale, away) -> None:
    mesh = ring()
    mesh = build_mesh(scale * (mesh.positions + np.array([away, 0.0, -away])), mesh.faces)
    agree(*both(make_asset(mesh), 0.2 * painted_sky(), tmp_path / "sky.exr"))


def test_a_sun_in_the_background_does_not_bleed(tmp_path) -> None:
    """A pixel of 1e5 leaves the rest of a dark sky unchanged."""
    sky = 0.02 * painted_sky()
    sky[9, 22] = 1e5
    agree(*both(make_asset(ball(2), degree=0), sky, tmp_path / "sky.exr", (-8.0, 1.0, -0.5), exposure=-3.0))


def test_the_sky_at_its_poles_and_seam(tmp_path) -> None:
    for eye in ((0.05, 5.0, 0.1), (0.1, -5.0, 0.02), (5.0, 0.2, 0.0)):
        agree(*both(make_asset(ball(1)), 0.2 * painted_sky(), tmp_path / "sky.exr", eye))


def moved(mesh: Mesh, path, nearer=1.0) -> tuple[bool, np.ndarray, np.ndarray]:
    """Return whether backfaces of a moving object are culled, its picture, and that with the opposite setting."""
    window = open_window(make_asset(mesh), [write_sky(path, 0.2 * painted_sky())], SIZE, np.array([0.0, 0.5, 4.0]))
    view = window.view
    view.smooth(False)
    view.plotter.camera.Azimuth(20.0)
    view.plotter.camera.position = nearer * np.array(view.plotter.camera.position)
    found, prop = view.picture(), view._object.actor.prop
    hidden = prop.culling == "back"
    prop.culling = "none" if hidden else "back"
    other = view.picture()
    view.plotter.close()
    return hidden, found, other


def test_hidden_backfaces_of_a_moving_object_are_culled(tmp_path) -> None:
    hidden, found, other = moved(ring(), tmp_path / "sky.exr")
    assert hidden
    np.testing.assert_array_equal(found, other)


@pytest.mark.parametrize("nearer", [1.0, 0.05])
def test_backfaces_of_open_objects_and_from_inside_are_drawn(tmp_path, nearer) -> None:
    mesh = ball(3)
    half = build_mesh(mesh.positions, mesh.faces[mesh.positions[mesh.faces].mean(axis=1)[:, 2] < 0.3])
    hidden, found, other = moved(half if nearer == 1.0 else mesh, tmp_path / "sky.exr", nearer)
    assert not hidden
    assert (found != other).mean() > 0.1


def test_a_very_distant_eye_sees_only_the_sky(tmp_path) -> None:
    window = open_window(make_asset(ball(2)), [write_sky(tmp_path / "sky.exr", 0.2 * constant())], SIZE, (1e6, 0, 0))
    found = bare_picture(window)
    assert np.abs(found - encoded(np.full(3, 0.2))).max(axis=2).mean() < 0.5


def mirror(mesh: Mesh, alpha: float = 0.0) -> Asset:
    """Return an asset of glass without subsurface light."""
    asset = make_asset(mesh, provenance={"eta": 1.5, "roughness": alpha})
    return dataclasses.replace(asset, coefficients=0.0 * asset.coefficients)


def fresnel(cosine: np.ndarray, eta: float) -> np.ndarray:
    inner = np.sqrt(1.0 - (1.0 - cosine**2) / eta**2)
    one = (cosine - eta * inner) / (cosine + eta * inner)
    other = (eta * cosine - inner) / (eta * cosine + inner)
    return 0.5 * (one**2 + other**2)


@pytest.mark.parametrize(("up", "rotation"), [("y", 0.0), ("y", 100.0), ("z", -30.0)])
def test_the_surface_reflects_the_sky_by_fresnel(tmp_path, up, rotation) -> None:
    asset = dataclasses.replace(mirror(ball(3)), up=up)
    sky = 3.0 * painted_sky()
    window = open_window(asset, [write_sky(tmp_path / "sky.exr", sky)], SIZE, rotation=rotation)
    press(window, "r")
    found = bare_picture(window)
    view = camera.fit(asset.mesh, *SIZE, up=up)
    lines = camera.rays(view, slice(None), np.array([[0.5, 0.5]]))
    towards = -np.broadcast_to(lines.directions, (SIZE[1], SIZE[0], 1, 3)).reshape(-1, 3)
    hits = Visibility(asset.mesh).first_hits(view.eye, -towards)
    met = np.flatnonzero(hits.faces >= 0)
    shares = np.concatenate([1.0 - hits.barycentric.sum(axis=1, keepdims=True), hits.barycentric], axis=1)[met]
    normals = np.einsum("nk,nki->ni", shares, asset.mesh.normals[asset.mesh.faces[hits.faces[met]]])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    cosine = np.einsum("ni,ni->n", normals, towards[met])
    mirrored = 2.0 * cosine[:, None] * normals - towards[met]
    light = as_lighting(sky, up, rotation).radiance(mirrored)
    facing = cosine > 0.2  # silhouette pixels also contain sky
    expected = encoded(fresnel(cosine, 1.5)[:, None] * light)[facing]
    off = np.abs(found.reshape(-1, 3)[met][facing] - expected)
    assert np.median(off) <= 1.0
    assert off.mean() < 2.0
    press(window, "r")
    assert bare_picture(window).reshape(-1, 3)[met][facing].max() == 0.0


def test_a_rough_surface_blurs_its_reflection(tmp_path) -> None:
    sky = 0.02 * constant()
    sky[2, 6] = 200.0
    seen = []
    for alpha in (0.0, 0.4):
        window = open_window(mirror(ball(3), alpha), [write_sky(tmp_path / "sky.exr", sky)], SIZE)
        press(window, "r", "b")
        seen.append(bare_picture(window).max(axis=2))
        window.plotter.close()
    assert (seen[1] > 100).sum() > 2 * (seen[0] > 100).sum()
    assert (seen[0] > 200).any()


def test_a_rough_surface_reflects_as_much_as_in_a_written_picture(tmp_path) -> None:
    """Up to the silhouette, where a smooth surface would reflect all."""
    asset, sky = mirror(ball(3), 0.3), constant()
    window = open_window(asset, [write_sky(tmp_path / "sky.exr", sky)], SIZE)
    press(window, "r")
    picture = render_picture(asset, as_lighting(sky, "y", 0.0), camera.fit(asset.mesh, *SIZE), reflection=True)
    off = np.abs(bare_picture(window) - encoded(picture.image)).max(axis=2)[picture.coverage == 1.0]
    assert np.quantile(off, 0.95) <= 3.0


def test_the_sky_follows_the_lat_long_convention(tmp_path) -> None:
    """The view along +x shows the middle of the sky, with +z to the right."""
    sky = np.zeros((32, 64, 3), np.float32)
    sky[:16, :32], sky[:16, 32:], sky[16:, :32], sky[16:, 32:] = [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]
    window = open_window(make_asset(ball(1)), [write_sky(tmp_path / "sky.exr", sky)], SIZE, (-30.0, 0.0, 0.0))
    found = bare_picture(window)
    corners = found[5, 5], found[5, -5], found[-5, 5], found[-5, -5]
    np.testing.assert_array_equal(corners, 255 * np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]]))
    assert environment.direction_of(0.5, 0.5) == pytest.approx([1.0, 0.0, 0.0], abs=1e-12)
    assert math.isclose(environment.direction_of(0.75, 0.5)[2], 1.0)
