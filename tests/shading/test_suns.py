"""Assets under suns: no ringing, linearity, rotation, error estimates."""

import math
from dataclasses import replace

import numpy as np
import pytest

import prt_bake as prt
from bakers.error_covariance import packed
from formats.asset import read_asset, write_asset
from formats.asset.error_covariance import ErrorCovariance
from formats.errors import QueryError
from formats.scene.lights import DirectionalLight
from prt_bake.lights.harmonics import project_lighting
from prt_bake.lights.lighting import Lighting, Sky
from prt_bake.lights.sun_detection import WIDEST
from prt_bake.mathematics import sh, sphere
from prt_bake.mathematics.view_frames import ViewFrames
from prt_bake.shading import vertices as vertex_shading
from prt_bake.shading.errors.radiance import radiance_error
from prt_bake.shading.picture import render_picture, shade, shade_vertices
from prt_bake.shading.sun_shading import interpolated_coefficients, sun_gradient, sun_radiance, suns_apart
from tests.lights.test_suns import SUNNY, TURN, clouds, disc
from tests.shading.test_picture import front, make_asset
from tests.shapes import ball

EYE = np.array([0.0, 0.5, 4.0])


def sun(towards=(0.48, 0.6, 0.64), irradiance=(3.0, 2.0, 1.0), diameter=0.53) -> DirectionalLight:
    return DirectionalLight(np.array(towards), np.array(irradiance), diameter)


def view_bins_of(asset, vertices):
    """The directions to the eye between the view bins."""
    return sphere.bin_coordinates(vertex_shading.eye_in_frames(asset, EYE, vertices), asset.rings, asset.sectors)


def lobed(seed=0, **others):
    """An asset with a narrow lobe about the normal at each vertex."""
    asset = make_asset(ball(2), seed=seed, **others)
    fine, weights = sh.quadrature(12)
    lobes = np.exp(3.0 * (asset.mesh.normals @ fine.T - 1.0))
    coefficients = (lobes * weights) @ sh.evaluate(fine, 2)
    asset.coefficients[...] = coefficients[:, None, :, None]
    return asset


def lit(asset, lighting: Lighting, treatment="split") -> np.ndarray:
    light = suns_apart(lighting, asset.degree, treatment)
    return shade_vertices(asset, light.harmonics, EYE, suns=light.suns).radiance


def test_vertices_away_from_the_sun_do_not_glow() -> None:
    asset, lights = lobed(), Lighting((), (sun(),))
    truth = np.exp(3.0 * (asset.mesh.normals @ sun().direction - 1.0))[:, None] * sun().irradiance
    errors = {name: np.abs(lit(asset, lights, name) - truth).max() for name in ("split", "window", "plain")}
    assert errors["split"] < 0.06
    assert errors["plain"] > 0.2
    behind = asset.mesh.normals @ sun().direction < -0.5
    assert lit(asset, lights)[behind].max() < 0.05
    assert lit(asset, lights, "plain")[behind].max() > 0.15


def test_shade_takes_harmonics_and_suns_of_a_divided_lighting() -> None:
    asset = lobed()
    lights = Lighting((Sky(clouds(64), "y", np.eye(3)),), (sun(),))
    light = prt.suns_apart(lights, asset.degree)
    shown = prt.shade(asset, light.harmonics, EYE, suns=light.suns)
    np.testing.assert_array_equal(shown, lit(asset, lights))
    assert np.abs(shown - prt.shade(asset, light.whole, EYE)).max() > 0.05
    fixed = make_asset(ball(2), degree=0, quantity="radiance")
    with pytest.raises(QueryError, match="made for one light"):
        prt.shade(fixed, None, EYE, suns=light.suns)


def test_a_picture_under_a_sun_alone_has_an_error_estimate() -> None:
    """No light is left in the harmonics."""
    asset, lights, view = lobed(), Lighting((), (sun(),)), front()
    split, plain = (render_picture(asset, lights, view, background=False, suns=name) for name in ("split", "plain"))
    inside = split.coverage > 0.99
    assert (split.error[inside] > 0.0).all()
    # By harmonics the error is uniform; for separate suns it grows with the transport of the sun.
    np.testing.assert_allclose(plain.error[inside], plain.error[inside][:1] * np.ones((inside.sum(), 1)), rtol=1e-5)
    assert split.error[inside].max() > 1.2 * plain.error[inside].max()
    assert np.corrcoef(split.error[inside][:, 0], split.image[inside][:, 0])[0, 1] > 0.9


@pytest.mark.statistics
@pytest.mark.parametrize("lights", [(), (Sky(0.03 * clouds(64), "y", np.eye(3)),)], ids=["sun", "sun and sky"])
def test_error_estimates_include_the_gradient_of_suns(lights: tuple[Sky, ...]) -> None:
    """Simulated errors along one line in the space of harmonics; estimates by harmonics alone are wrong."""
    rng = np.random.default_rng(2)
    exact, line = lobed(rings=1, sectors=1), np.array([1.0, 0.5, -1.0, 0.3, 0.0, 0.7, -0.8, 0.2, 0.4])
    line *= 3.0 / np.linalg.norm(line)
    shape = ErrorCovariance(packed(line[:, None] * line)[None], np.array([[1.5, 1.0, 0.5]]), np.ones((1, 2)))
    sigma = np.full((len(exact.valid), 1), 0.002, np.float32)
    asset = replace(
        exact, standard_error=sigma, error_covariance=shape, tangents=sphere.tangent_frame(exact.mesh.normals)
    )
    light, everywhere = suns_apart(Lighting(lights, (sun(),)), 2), np.arange(len(exact.valid))
    views = ViewFrames(asset.mesh.normals, asset.tangents)
    outgoing = sphere.to_world(asset.directions[0], asset.mesh.normals, asset.tangents)
    lines = views.matrices(everywhere, outgoing, 9).transpose(0, 2, 1) @ line
    squares = 0.0
    still = lit(exact, Lighting(lights, (sun(),)))
    for _draw in range(300):
        off = 0.002 * lines[:, :, None] * rng.normal(size=(len(lines), 1, 1)) * np.sqrt([1.5, 1.0, 0.5])
        drawn = replace(exact, coefficients=exact.coefficients + off[:, None].astype(np.float32))
        shown = shade(drawn, light.harmonics, EYE, suns=light.suns)
        squares = squares + (shown - still) ** 2 / 300
    simulated = np.sqrt(squares.mean(axis=0))
    predicted, plain = (
        radiance_error(asset, light.harmonics, EYE, suns=light.suns),
        radiance_error(asset, light.whole, EYE),
    )
    np.testing.assert_allclose(np.sqrt((predicted**2).mean(axis=0)), simulated, rtol=0.05)
    behind = asset.mesh.normals @ sun().direction < -0.3
    assert np.median(np.abs(np.log(predicted / np.sqrt(squares))[behind])) < 0.06
    assert np.median(np.abs(np.log(plain / np.sqrt(squares))[behind])) > 0.25


def test_the_gradient_of_equal_channels_is_that_of_one() -> None:
    """One fit for all channels agrees with three fits, for suns of different colours."""
    asset, suns, everything = lobed(), (sun(), sun((-0.6, 0.0, 0.8), (0.5, 1.0, 2.0))), np.arange(66)
    at = view_bins_of(asset, everything)
    found = sun_gradient(asset, suns, everything, at)
    asset.coefficients[:, :, 0, 1] *= 1.0 + 1e-6
    np.testing.assert_allclose(sun_gradient(asset, suns, everything, at), found, rtol=1e-3, atol=1e-4)
    assert not sun_gradient(asset, (), everything, at).any()


def test_radiance_is_additive_in_suns_and_scales() -> None:
    asset = make_asset(ball(2), valid=np.arange(66) % 5 != 2)
    one, other = sun(), sun((0.0, -1.0, 0.0), (1.0, 5.0, 0.0), 6.0)
    both, first, second = (lit(asset, Lighting((), suns)) for suns in ((one, other), (one,), (other,)))
    np.testing.assert_allclose(both, first + second, rtol=1e-9)
    brighter = lit(asset, Lighting((), (sun(irradiance=(3e6, 2e6, 1e6)),)))
    np.testing.assert_allclose(brighter, 1e6 * first, rtol=1e-9)
    assert not both[~asset.valid].any()


def test_a_sun_in_the_sky_equals_a_directional_light() -> None:
    """A radiance of 1e5 over about half a degree, in the picture and as a separate light."""
    asset = lobed()
    bright = disc(1024, (0.48, 0.6, 0.64), 0.7, (1e5, 9e4, 7e4))
    irradiance = project_lighting(Lighting((Sky(bright, "y", np.eye(3)),)), 0)[0] * math.sqrt(4.0 * math.pi)
    inside = lit(asset, Lighting((Sky(clouds(1024) + bright, "y", np.eye(3)),)))
    beside = lit(asset, Lighting((Sky(clouds(64), "y", np.eye(3)),), (sun(irradiance=irradiance),)))
    np.testing.assert_allclose(inside, beside, rtol=0.01)


def test_dividing_commutes_with_rotation() -> None:
    asset, turn = lobed(), TURN
    sky = Sky(SUNNY, "y", np.eye(3))
    still, turned = (
        suns_apart(Lighting((Sky(SUNNY, "y", t),), (sun(t @ sun().direction),)), 2) for t in (sky.turn, turn)
    )
    assert turned.found == still.found == 3
    np.testing.assert_allclose(turned.harmonics, sh.rotation(turn, 2) @ still.harmonics, atol=1e-9)
    np.testing.assert_allclose(turned.whole, sh.rotation(turn, 2) @ still.whole, atol=1e-9)
    whole = project_lighting(Lighting((sky,), (sun(),)), 2)
    np.testing.assert_allclose(still.whole, whole, rtol=0, atol=2e-3 * whole[0].max())
    np.testing.assert_allclose(still.whole[0], whole[0], rtol=1e-6)
    assert lit(asset, Lighting((sky,))).min() > 0.0


def test_suns_in_a_sky_are_an_unknown_error_of_every_treatment_without_lobes() -> None:
    asset, view = lobed(), front()
    sky = np.ones((64, 128, 3), np.float32)
    sky[20, 40] = 3e4
    for treatment in ("split", "window", "plain"):
        picture = render_picture(asset, sky, view, background=False, suns=treatment)
        assert picture.errors.suns is None


@pytest.mark.parametrize("treatment", ["split", "window", "plain"])
def test_treatments_agree_for_constant_transport(treatment: str) -> None:
    asset = make_asset(ball(2))
    asset.coefficients[:, :, 1:] = 0.0
    lights = Lighting((Sky(SUNNY, "y", np.eye(3)),), (sun(),))
    expected = shade(asset, project_lighting(lights, 2), EYE)
    np.testing.assert_allclose(lit(asset, lights, treatment), expected, rtol=1e-6)


def test_treatments_agree_without_suns() -> None:
    asset, view, calm = make_asset(ball(2)), front(), clouds(64)
    pictures = [render_picture(asset, calm, view, suns=name) for name in ("split", "window", "plain")]
    for picture in pictures:
        np.testing.assert_array_equal(picture.image, pictures[2].image)
        assert picture.suns == 0
    wide = Lighting((), (sun(diameter=WIDEST + 1.0),))
    assert suns_apart(wide, 2).suns == ()
    np.testing.assert_array_equal(suns_apart(wide, 2).harmonics, project_lighting(wide, 2))
    np.testing.assert_array_equal(
        suns_apart(Lighting((), (sun(),)), 0).harmonics, project_lighting(Lighting((), (sun(),)), 0)
    )


def test_a_picture_reports_the_number_of_suns_and_shows_the_same_background() -> None:
    asset, view = lobed(), front()
    pictures = {name: render_picture(asset, SUNNY, view, suns=name) for name in ("split", "window", "plain")}
    assert [picture.suns for picture in pictures.values()] == [2, 2, 0]
    open_sky = pictures["plain"].coverage == 0.0
    for picture in pictures.values():
        np.testing.assert_array_equal(picture.image[open_sky], pictures["plain"].image[open_sky])
    assert abs(pictures["split"].image - pictures["plain"].image).max() > 0.1
    with pytest.raises(QueryError, match="'split', 'window', 'plain', found 'none'"):
        render_picture(asset, SUNNY, view, suns="none")


def test_coefficients_are_interpolated_equally_from_memory_and_files(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("formats.asset.asset_file._CHUNK_BYTES", 8_000)
    asset = make_asset(ball(2), 4, 6)
    write_asset(asset, tmp_path / "a.h5")
    opened = read_asset(tmp_path / "a.h5", load=False)
    vertices = np.array([3, 4, 20, 65])
    at = view_bins_of(asset, vertices)
    inside = interpolated_coefficients(asset, vertices, at)
    monkeypatch.setattr("prt_bake.shading.reconstruction._BYTES_AT_ONCE", 20_000)
    np.testing.assert_array_equal(interpolated_coefficients(opened, vertices, at), inside)
    light = np.random.default_rng(1).random((9, 3))
    expected = shade(asset, light, EYE)[vertices]
    np.testing.assert_allclose(np.einsum("nkc,kc->nc", inside, light), expected, rtol=1e-9)


def test_negative_mean_transport_is_clamped_and_reported() -> None:
    asset = make_asset(ball(2))
    asset.coefficients[:3, :, 0] = -1.0
    shown = shade_vertices(asset, np.zeros((9, 3)), EYE, suns=(sun(),))
    assert shown.clamped > 0.01
    assert not shown.radiance[:3].any()
    everything = np.arange(66)
    assert not sun_radiance(asset, (), everything, view_bins_of(asset, everything)).any()
