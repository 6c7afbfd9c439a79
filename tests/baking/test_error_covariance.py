"""Error covariances: the reported errors of radiance agree with the scatter over seeds, under any light."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from bakers.baker import _walk_errors
from bakers.error_covariance import (
    added_covariance,
    clustered,
    error_sums,
    normalised_covariance,
    packed,
    trace,
    unknown_covariance,
    unpacked,
)
from formats.asset import Asset
from formats.asset.error_covariance import ErrorCovariance, pairs
from prt_bake import bake, compress
from prt_bake.mathematics import sh
from prt_bake.shading.errors.radiance import radiance_error
from prt_bake.shading.vertices import shade
from tests.bakers.transports import Array, Lobed, icosphere
from tests.shading.assets import asset_of

MESH = icosphere(1)
MIRROR = Lobed(sharpness=40.0, floor=0.2)
LIGHTS = {"towards": [0.0, 0.0, -1.0], "from the side": [0.0, -1.0, 0.0], "behind": [0.0, 0.0, 1.0]}
METHODS: dict[str, dict[str, Any]] = {
    "halves": {"rings": 2, "sectors": 8, "samples": 64},
    "neighbours": {"rings": 2, "sectors": 32, "samples": 32},
    "residual": {"rings": 2, "sectors": 8, "samples": 20},
    "sums": {"rings": 2, "sectors": 8, "samples": 64, "directions": "uniform"},
    "to an error": {"rings": 4, "sectors": 8, "error": 0.05},
}
BAKES = 12
EYES = np.tile([0.3, 0.2, 3.0], (42, 1)) - MESH.positions


def baked(arguments: dict[str, Any], **more: Any) -> list[Asset]:
    return [bake(MIRROR, MESH, seed=seed, leave_out=[], **arguments, **more) for seed in range(BAKES)]


@pytest.fixture(scope="module", params=METHODS)
def method(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="module")
def bakes(method: str) -> list[Asset]:
    return baked(METHODS[method])


def light_from(direction: list[float]) -> Array:
    """Harmonics [9,3] of a directional light."""
    return sh.evaluate(np.array([direction]), 2)[0][:, None] * np.ones((1, 3))


def radiance(asset: Asset, light: Array | None) -> Array:
    """Radiance without the clamp at 0."""
    return shade(asset, light, EYES) if light is None else shade(asset, light, EYES) - shade(asset, -light, EYES)


def reported_over_measured(bakes: list[Asset], light: Array | None) -> float:
    """Reported error of the radiance over its scatter between bakes, rms over vertices and channels."""
    reported = [radiance_error(each, light, EYES) for each in bakes]
    variance = np.var([radiance(each, light) for each in bakes], axis=0, ddof=1)
    return float(np.sqrt(np.mean(np.square(reported)) / variance.mean()))


@pytest.mark.statistics
@pytest.mark.parametrize("where", LIGHTS)
def test_the_reported_error_under_a_light_is_the_scatter_of_bakes(method: str, bakes: list[Asset], where: str) -> None:
    """Directions that miss a narrow lobe cause errors in all harmonics at once. These add up under a light from the
    lobe's direction, and cancel under others. The estimate from residuals is conservative.
    """
    light = light_from(LIGHTS[where])
    assert 0.75 < reported_over_measured(bakes, light) < (1.75 if method == "residual" else 1.3)
    plain = reported_over_measured([dataclasses.replace(each, error_covariance=None) for each in bakes], light)
    assert plain < 0.75 if where == "towards" else plain > 1.35


@pytest.mark.parametrize("where", LIGHTS)
def test_an_asset_for_one_light_reports_the_same_error(where: str) -> None:
    bakes = baked(METHODS["halves"], for_light=light_from(LIGHTS[where]) + np.eye(9)[:, :1])
    assert 0.75 < reported_over_measured(bakes, None) < 1.3


@pytest.mark.parametrize("where", LIGHTS)
def test_the_error_of_compression_is_reported_exactly(where: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """For one view, equal channels, exact bakes and one covariance per vertex."""
    monkeypatch.setattr("bakers.error_covariance.VERTICES_PER_CLUSTER", 1)
    coefficients = np.random.default_rng(0).normal(size=(42, 1, 9, 1)) * np.ones((1, 1, 1, 3)) + 20.0 * np.eye(9)[:, :1]
    asset = asset_of(MESH, coefficients.astype(np.float32), 1, 1, 2, error_covariance=unknown_covariance(42, 9))
    asset = dataclasses.replace(asset, standard_error=np.zeros((42, 1), np.float32))
    light, compact = light_from(LIGHTS[where]), compress(asset, 0.02)
    off = radiance(compact, light) - radiance(asset, light)
    np.testing.assert_allclose(
        radiance_error(compact, light, EYES), np.abs(off), rtol=0.01, atol=2e-3 * np.abs(off).max()
    )


def test_walks_have_a_variance_for_each_harmonic() -> None:
    """The variances of harmonics in the world frame hold in the frame of any view."""
    rng = np.random.default_rng(0)
    squares = rng.uniform(size=(5, 7, 9, 3))
    errors = _walk_errors(squares)
    covariance, channels = error_sums(errors)
    np.testing.assert_allclose(unpacked(covariance, 9), squares.sum(axis=(1, 3))[:, :, None] * np.eye(9))
    np.testing.assert_allclose(channels, squares.sum(axis=(1, 2)))


def shapes(count: int, vertices: int, kinds: int, seed: int = 0) -> ErrorCovariance:
    """Covariances of a few kinds, each slightly different at every vertex."""
    rng = np.random.default_rng(seed)
    errors = rng.normal(size=(kinds, 2, count, 3))[rng.integers(0, kinds, vertices)]
    errors = errors * (1.0 + 0.01 * rng.normal(size=errors.shape))
    return normalised_covariance(*error_sums(errors), rng.random((vertices, 2)), count)


@pytest.mark.parametrize(("vertices", "kinds"), [(1, 1), (5, 2), (100, 3), (3000, 40)])
def test_clustered_covariances_keep_the_sums_over_vertices(vertices: int, kinds: int) -> None:
    shape, size = shapes(4, vertices, kinds), np.random.default_rng(1).random(vertices)
    size[1::7] = 0.0
    few = clustered(shape, size)
    assert len(few.covariance) <= max(1, vertices // 16)
    each = few.at_vertices(np.arange(vertices))
    for name in ("covariance", "channels", "apart"):
        clusters, vertex_sums = (np.einsum("v,v...->...", size, getattr(part, name)) for part in (each, shape))
        np.testing.assert_allclose(clusters, vertex_sums, rtol=1e-4, atol=1e-4 * size.sum())
    np.testing.assert_allclose(trace(few.covariance, 4), 4.0, rtol=1e-5)
    np.testing.assert_allclose(few.channels.mean(axis=1), 1.0, rtol=1e-5)


def test_similar_vertices_share_a_covariance() -> None:
    shape = dataclasses.replace(shapes(9, 640, 4), apart=np.ones((640, 2), np.float32))
    each = clustered(shape, np.ones(640)).at_vertices(np.arange(640))
    np.testing.assert_allclose(each.covariance, shape.covariance, atol=0.2)


def test_errors_of_zero_or_not_finite_have_a_covariance() -> None:
    sums = np.zeros((3, pairs(4))), np.zeros((3, 3))
    sums[0][1], sums[1][2] = np.nan, np.inf
    with np.errstate(all="raise"):
        shape = normalised_covariance(*sums, np.array([0.5, np.nan, 2.0]), 4)
    np.testing.assert_array_equal(unpacked(shape.covariance, 4), np.broadcast_to(np.eye(4), (3, 4, 4)))
    np.testing.assert_array_equal(shape.channels, np.ones((3, 3)))
    np.testing.assert_array_equal(shape.apart, [[0.5, 1.0], [0.0, 1.0], [1.0, 1.0]])


def test_two_covariances_are_combined_by_their_sizes() -> None:
    first, second = (shapes(4, 6, 6, seed) for seed in (0, 1))
    size, more = np.array([0.0, 1.0, 2.0, 3.0, 4.0, 0.5]), np.array([1.0, 0.0, 2.0, 1.0, 4.0, 1.5])
    whole = added_covariance(first, size, second.covariance * more[:, None], second.channels * more[:, None])
    share = (size / (size + more))[:, None]
    np.testing.assert_allclose(whole.covariance, share * first.covariance + (1 - share) * second.covariance, rtol=1e-5)
    np.testing.assert_allclose(whole.apart, share * first.apart, rtol=1e-5)


def test_truncated_covariances_and_variances_under_lights() -> None:
    shape, light = shapes(9, 20, 20), np.random.default_rng(2).normal(size=(20, 9, 3))
    full = unpacked(shape.covariance, 9)
    expected = np.einsum("vkc,vkl,vlc->vc", light, full, light) * shape.channels
    np.testing.assert_allclose(shape.variance_under(light), expected, rtol=1e-5)
    first = unpacked(shape.truncated(4).covariance, 4)
    scale = 4.0 / np.trace(full[:, :4, :4], axis1=1, axis2=2)
    np.testing.assert_allclose(first, scale[:, None, None] * full[:, :4, :4], rtol=1e-5)
    lone = unknown_covariance(2, 9)
    np.testing.assert_allclose(lone.variance_under(light[:2]), (light[:2] ** 2).sum(axis=1), rtol=1e-6)
    np.testing.assert_array_equal(packed(full), np.asarray(shape.covariance, np.float64))
