"""The error of a picture: its parts, their sum, and what is unknown."""

import dataclasses

import numpy as np
import pytest

from formats.asset.error_covariance import ErrorCovariance
from formats.asset.total_error import ErrorInterval
from prt_bake.mathematics import sphere
from prt_bake.shading.errors.picture import PictureError, view_error
from prt_bake.shading.errors.radiance import radiance_error
from prt_bake.shading.picture import render_picture, shade
from tests.shading.assets import asset_of
from tests.shading.test_picture import constant, front, make_asset
from tests.shading.test_surface_reflection import glossy
from tests.shapes import ball

LIGHT = np.eye(9)[:, :1] * np.ones(3)


def lobed(local: np.ndarray) -> np.ndarray:
    """A smooth radiance by the direction to the eye in the local frame."""
    return np.asarray(1.0 + 0.8 * local[..., 2] ** 2 + 0.5 * local[..., 0] * local[..., 1] + 0.3 * local[..., 0])


@pytest.mark.parametrize(("rings", "sectors"), [(4, 8), (8, 16), (16, 64), (3, 64), (32, 6)])
def test_the_error_between_view_bins_is_that_of_the_interpolation(rings: int, sectors: int) -> None:
    mesh = ball(3)
    coefficients = np.zeros((len(mesh.positions), rings * sectors, 9, 3), np.float32)
    coefficients[:, :, 0] = lobed(sphere.view_bins(rings, sectors))[:, None]
    asset, eye = asset_of(mesh, coefficients, rings, sectors, 2), np.array([1.0, 2.0, 6.0])
    towards = (eye - mesh.positions) / np.linalg.norm(eye - mesh.positions, axis=1, keepdims=True)
    visible = np.einsum("vi,vi->v", towards, mesh.normals) > 0.0
    shown = shade(asset, LIGHT, eye)
    exact = lobed(sphere.to_local(towards, mesh.normals, asset.tangents))
    true = np.sqrt(((shown[visible, 0] - exact[visible]) ** 2).sum() / (exact[visible] ** 2).sum())
    assert view_error(asset, LIGHT, eye, 1.0 * visible, shown, 0.0 * shown) == pytest.approx(true, rel=0.25)


def test_what_few_bins_do_not_tell_is_unknown_and_one_bin_for_all_views_is_exact() -> None:
    mesh, eye, ones = ball(1), np.array([0.0, 0.0, 9.0]), np.ones((18, 3))

    def error(**options) -> float | None:
        asset = make_asset(mesh, **options)
        return view_error(asset, LIGHT, eye, ones[:, 0], ones, 0.0 * ones)

    assert error(rings=2, sectors=8) is error(rings=8, sectors=3) is error(rings=1, sectors=1) is None
    assert error(rings=4, sectors=8, views=1) == 0.0
    assert view_error(make_asset(mesh), LIGHT, eye, ones[:, 0], 0.0 * ones, ones) is None


def test_independent_errors_of_bins_are_no_error_of_the_interpolation() -> None:
    """Of radiance that does not depend on the view, with noise in every bin, a tenth of the noise is left."""
    mesh, eye, noise = ball(3), np.array([0.0, 0.0, 9.0]), 0.05
    coefficients = np.zeros((len(mesh.positions), 8 * 16, 9, 3), np.float32)
    coefficients[:, :, 0] = 1.0 + noise * np.random.default_rng(1).normal(size=(len(mesh.positions), 8 * 16, 1))
    # All of the variance, nine times the mean over the harmonics, is in the first one.
    sigma = np.full(coefficients.shape[:2], noise / 3.0, np.float32)
    alone = ErrorCovariance(9.0 * np.eye(45)[:1], np.ones((1, 3)), np.array([[1.0, 1.0]]))
    asset = asset_of(mesh, coefficients, 8, 16, 2, standard_error=sigma, error_covariance=alone)
    visible, shown = 1.0 * (mesh.normals[:, 2] > 0.2), shade(asset, LIGHT, eye)
    error = radiance_error(asset, LIGHT, eye)
    assert view_error(asset, LIGHT, eye, visible, shown, error) < 0.1 * noise
    assert view_error(asset, LIGHT, eye, visible, shown, 0.0 * error) > 0.25 * noise


def test_a_picture_states_each_part_relative_to_all_of_its_light() -> None:
    """The network's share shrinks by the light that is reflected; noise is that of reflected rays."""
    asset = dataclasses.replace(glossy(ball(2), roughness=0.5), network_error=ErrorInterval(0.05))
    sky = constant()
    sky[:4] = 9.0
    dull, shiny = (render_picture(asset, sky, front(), reflection=on, background=False) for on in (False, True))
    assert dull.errors.network == pytest.approx(0.05)
    assert dull.errors.noise == 0.0
    assert dull.errors.bake == pytest.approx(dull.relative_error)
    assert 0.02 < shiny.errors.network < 0.049
    assert 0.0 < shiny.errors.noise < 0.05
    assert shiny.relative_error == pytest.approx(np.hypot(shiny.errors.bake, shiny.errors.noise))
    assert shiny.errors.network / 0.05 == pytest.approx(shiny.errors.bake / dull.errors.bake, rel=0.01)
    of = shiny.errors
    everything = np.array([of.network, of.bake, of.views, of.vertices, of.noise])
    assert shiny.errors.total == pytest.approx(np.linalg.norm(everything))


@pytest.mark.parametrize(
    ("parts", "text"),
    [
        ((0.03, 0.04, 0.0, 0.12, 0.0), "about 13.0% (network 3.0%, bake 4.0%, views 0.0%, vertices 12.0%, noise 0.0%)"),
        (
            (None, 0.04, 0.03, 0.0, 0.0),
            "at least 5.0% (network unknown, bake 4.0%, views 3.0%, vertices 0.0%, noise 0.0%)",
        ),
        (
            (0.03, None, None, None, 0.04),
            "at least 5.0% (network 3.0%, bake unknown, views unknown, vertices unknown, noise 4.0%)",
        ),
        (
            (0.03, 0.04, 0.0, 0.0, 0.0, False, None),
            "at least 5.0% (network 3.0%, bake 4.0%, views 0.0%, vertices 0.0%, noise 0.0%, suns unknown)",
        ),
        (
            (None, None, 0.03, 0.0, 0.0),
            "unknown (network unknown, bake unknown, views 3.0%, vertices 0.0%, noise 0.0%)",
        ),
        (
            (None, 0.04, 0.03, 0.0, 0.0, True),
            "about 5.0% (path traced, bake 4.0%, views 3.0%, vertices 0.0%, noise 0.0%)",
        ),
        (
            (None, None, 0.03, 0.0, 0.0, True),
            "unknown (path traced, bake unknown, views 3.0%, vertices 0.0%, noise 0.0%)",
        ),
    ],
)
def test_unknown_parts_are_named(parts: tuple, text: str) -> None:
    error = PictureError(*parts)
    assert str(error) == text
    stated = error.as_json()
    assert stated["complete"] == ("unknown" not in text)
    assert (stated["total"] is None) == text.startswith("unknown")
    assert ("network" in stated) == (not error.path_traced)
