"""The preview without its window."""

import dataclasses
import math

import numpy as np
import pytest

from bakers.error_covariance import packed
from formats.asset import Asset
from formats.asset.error_covariance import ErrorCovariance
from formats.errors import QueryError
from formats.image import write_image
from formats.image.png import to_linear
from prt_bake.lights import environment
from prt_bake.mathematics import sh
from prt_bake.preview import colours, legend, reasons
from prt_bake.preview.lights import LightSource
from prt_bake.preview.state import Mode, Preview
from prt_bake.shading.errors.radiance import radiance_error
from prt_bake.shading.picture import shade
from tests.shading import reference
from tests.shading.test_picture import constant, make_asset, painted_sky
from tests.shapes import ball

EYE = np.array([0.3, 1.2, 3.5])
VALID = np.arange(66) % 5 != 2


@pytest.fixture
def sky(tmp_path):
    write_image(tmp_path / "sky.exr", painted_sky())
    return str(tmp_path / "sky.exr")


def made(sky: str, up: str = "y", rotation: float = 0.0, **others) -> Preview:
    asset = make_asset(ball(2), valid=VALID, up=up, **others)
    return Preview(asset, [LightSource(sky, up, asset.degree)], rotation=rotation)


@pytest.mark.parametrize("up", ["y", "z"])
@pytest.mark.parametrize("rotation", [0.0, 75.0, 435.0, -285.0])
def test_radiance_equals_shade_under_the_rotated_sky(sky, up, rotation) -> None:
    preview = made(sky, up, rotation)
    turned = environment.rotate_light(environment.project(painted_sky(), 2, up), rotation, up)
    shown = preview.colours(EYE)
    np.testing.assert_allclose(shown[:, :3], shade(preview.asset, turned, EYE), atol=2e-6)
    np.testing.assert_array_equal(shown[:, 3], VALID)
    assert -180.0 <= preview.rotation <= 180.0


@pytest.mark.parametrize("up", ["y", "z"])
def test_the_background_rotates_with_the_light(sky, up) -> None:
    preview = made(sky, up, 40.0)
    directions = np.random.default_rng(2).normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    expected = preview.light.lighting.turned(40.0, up).radiance(directions)
    polar = directions @ preview.to_sky.T
    u = np.arctan2(polar[:, 1], polar[:, 0]) / (2 * math.pi) + 0.5
    v = np.arctan2(np.hypot(polar[:, 0], polar[:, 1]), polar[:, 2]) / math.pi
    np.testing.assert_allclose(environment.radiance_at(preview.sky, u, v), expected, atol=1e-9)


def test_colours_depend_on_the_eye(sky) -> None:
    preview = made(sky)
    first = preview.colours(EYE).copy()
    assert np.abs(preview.colours(-EYE) - first).max() > 1e-3
    np.testing.assert_array_equal(preview.colours(EYE), first)


def test_coefficients_are_signed_and_in_order(sky) -> None:
    preview = made(sky)
    preview.show(Mode.COEFFICIENT)
    seen = []
    for index in range(9):
        one = np.zeros((9, 3))
        one[index] = 1.0
        expected = reference.reconstruct(preview.asset, one, EYE).mean(axis=1)
        shown = preview.colours(EYE)
        top = preview.scale.high
        assert top == pytest.approx(np.quantile(np.abs(expected[VALID]), 0.98), rel=1e-4)
        ramp = to_linear(colours.about_zero(expected / top)) * VALID[:, None]
        np.testing.assert_allclose(shown[:, :3], ramp, atol=1e-4)
        seen.append(preview.degree_and_order)
        preview.step_harmonic(1)
    assert seen == [(l, m) for l in range(3) for m in range(-l, l + 1)]
    assert preview.harmonic == 0
    preview.step_harmonic(-1)
    assert preview.degree_and_order == (2, 2)
    preview.show(Mode.COEFFICIENT)
    assert preview.mode is Mode.RADIANCE
    np.testing.assert_array_equal(preview.colours(EYE), made(sky).colours(EYE))


@pytest.mark.parametrize("up", ["y", "z"])
def test_errors_are_those_under_the_rotated_light(sky: str, up: str) -> None:
    rng = np.random.default_rng(1)
    preview = made(sky, up, 30.0)
    sigma = rng.uniform(0.01, 0.1, preview.asset.standard_error.shape).astype(np.float32)
    # With equal errors of all harmonics, no rotation would change the error.
    unequal = ErrorCovariance(packed(np.diag(np.arange(9) / 4))[None], np.ones((1, 3)), np.zeros((1, 2)))
    asset = dataclasses.replace(preview.asset, standard_error=sigma, error_covariance=unequal)
    preview = Preview(asset, preview.lights, rotation=30.0)
    preview.show(Mode.ERROR)
    shown = preview.colours(EYE)
    light = environment.rotate_light(preview.light.harmonics, 30.0, up)
    rms = math.sqrt((shade(asset, light, EYE)[VALID] ** 2).mean())
    relative = np.sqrt((radiance_error(asset, light, EYE) ** 2).mean(axis=1)) / rms
    assert preview.scale.high == pytest.approx(np.quantile(relative[VALID], 0.98), rel=1e-5)
    expected = to_linear(colours.from_zero(relative / preview.scale.high)) * VALID[:, None]
    np.testing.assert_allclose(shown[:, :3], expected, atol=1e-5)
    assert preview.shown_exposure == 0.0
    assert preview.sky is None


def test_the_valid_mask_shows_all_vertices(sky) -> None:
    preview = made(sky)
    preview.show(Mode.VALID)
    shown = preview.colours(EYE)
    assert (shown[:, 3] == 1.0).all()
    assert len(np.unique(shown[VALID], axis=0)) == len(np.unique(shown[~VALID], axis=0)) == 1
    assert (shown[VALID][0] != shown[~VALID][0]).any()
    assert "13 of 66" in legend.status(preview, "ball.h5", EYE)


def test_colour_ramps_vary_everywhere_and_clamp() -> None:
    for ramp, low in ((colours.from_zero, 0.0), (colours.about_zero, -1.0)):
        values = ramp(np.linspace(low, 1.0, 101))
        assert values.min() >= 0.0
        assert values.max() <= 1.0
        assert (np.abs(np.diff(values, axis=0)).max(axis=1) > 0.0).all()
        np.testing.assert_array_equal(ramp([low - 5.0, 7.0]), values[[0, -1]])


def test_an_index_of_1_reflects_nothing(sky) -> None:
    matched, glass = made(sky), made(sky, provenance={"eta": 1.5, "roughness": 0.3})
    matched.toggle_reflection()
    assert matched.reflected_sky is None
    assert "index of refraction is 1" in reasons.of_reflection(matched)
    assert "r" not in dict(legend.keys(matched, None))
    assert glass.reflected_sky is None
    glass.toggle_reflection()
    assert glass.reflected_sky is glass.reflected_sky
    assert "r" in dict(legend.keys(glass, None))
    assert reasons.of_reflection(glass) == ""
    assert (glass.interface.eta, glass.interface.alpha) == (1.5, 0.3)
    glass.show(Mode.ERROR)
    assert glass.reflected_sky is None


def one_light() -> Asset:
    asset = make_asset(ball(2), degree=0, quantity="radiance")
    return dataclasses.replace(asset, degree=2)


def test_an_asset_made_for_one_light_is_shown_without_lights() -> None:
    asset = one_light()
    preview = Preview(asset, [])
    np.testing.assert_allclose(preview.colours(EYE)[:, :3], shade(asset, None, EYE), atol=1e-5)
    assert preview.sky is None
    preview.rotate_to(90.0)
    preview.show(Mode.COEFFICIENT)
    preview.step_harmonic(1)
    assert preview.degree_and_order == (0, 0)
    assert np.isfinite(preview.colours(EYE)).all()
    preview.show(Mode.ERROR)
    preview.show(Mode.ERROR)
    np.testing.assert_allclose(preview.colours(EYE)[:, :3], shade(asset, None, EYE), atol=1e-5)
    assert "left right" not in dict(legend.keys(preview, None))


def test_a_preview_without_anything_to_show_is_refused(sky) -> None:
    asset = make_asset(ball(2))
    with pytest.raises(QueryError, match="no vertex was baked"):
        Preview(dataclasses.replace(asset, valid=np.zeros(66, np.bool_)), [])
    with pytest.raises(QueryError, match="at least one"):
        Preview(asset, [])
    with pytest.raises(QueryError, match="inside the object"):
        made(sky).colours(np.array([0.0, 0.1, 0.0]))


def test_stepping_through_lights(sky, tmp_path) -> None:
    write_image(tmp_path / "white.hdr", constant())
    asset = make_asset(ball(2))
    sources = [LightSource(text, "y", 2) for text in (sky, str(tmp_path / "white.hdr"), "sun:0,1,0:2,2,2:10")]
    preview = Preview(asset, sources)
    seen = []
    for _ in range(4):
        seen.append(preview.colours(EYE).copy())
        assert preview.sky is preview.light.picture
        preview.step_light()
    np.testing.assert_array_equal(seen[0], seen[3])
    assert np.abs(seen[1] - seen[0]).max() > 1e-2
    assert np.abs(seen[2] - seen[1]).max() > 1e-2
    preview.current = 0
    preview.step_light(-1)
    assert preview.lights[preview.current].name == "sun:0,1,0:2,2,2:10"
    assert sh.count(2) == len(preview.light.harmonics)
