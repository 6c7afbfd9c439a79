"""Standard errors of radiance and of pictures by the errors of a bake."""

import dataclasses

import numpy as np
import pytest

from bakers.error_covariance import packed
from formats.asset import Asset
from formats.asset.error_covariance import ErrorCovariance
from prt_bake.mathematics import sphere
from prt_bake.shading.errors.radiance import interpolate_over_faces
from prt_bake.shading.picture import radiance_error, render_picture, shade
from tests.shading.test_picture import ball, constant, front, make_asset, make_light


def every_view(asset: Asset) -> list[np.ndarray]:
    """Directions to the eye [V,3] in the local frames: anywhere, near the normal and near the horizon."""
    rng = np.random.default_rng(3)
    count = len(asset.mesh.positions)
    out = []
    for least, most in ((0.0, 1.0), (0.97, 1.0), (0.0, 0.05)):
        cosine, phi = rng.uniform(least, most, count), rng.uniform(0.0, 7.0, count)
        sine = np.sqrt(1.0 - cosine**2)
        local = np.stack([sine * np.cos(phi), sine * np.sin(phi), cosine], axis=1)
        out.append(sphere.to_world(local, asset.mesh.normals, asset.tangents))
    return out


@pytest.mark.parametrize("apart", [0.0, 0.5, 1.0])
@pytest.mark.parametrize(("rings", "sectors"), [(4, 6), (1, 3), (3, 1), (1, 1)])
def test_errors_between_bins_with_shared_and_independent_parts(rings: int, sectors: int, apart: float) -> None:
    """Simulated errors with the asset's covariance have the predicted size for all views, pole and horizon included."""
    rng = np.random.default_rng(8)
    exact = make_asset(ball(2), rings, sectors, seed=1)
    count, bins = len(exact.mesh.positions), rings * sectors
    sigma = rng.uniform(0.5, 2.0, (count, bins)).astype(np.float32)
    shape = ErrorCovariance(
        packed(np.eye(9))[None], np.array([[1.5, 1.0, 0.5]]), np.array([[apart, 1.0]]), np.zeros(count, np.int64)
    )
    asset = dataclasses.replace(exact, standard_error=sigma, error_covariance=shape)
    light = np.zeros((9, 3))
    light[0] = 1.0
    for views in every_view(asset):
        squares = 0.0
        for _draw in range(100):
            own, shared = rng.normal(size=(count, bins)), rng.normal(size=(count, 1))
            noise = sigma * (np.sqrt(apart) * own + np.sqrt(1.0 - apart) * shared)
            coefficients = np.zeros_like(exact.coefficients)
            coefficients[:, :, 0] = 30.0 + noise[..., None] * np.sqrt([1.5, 1.0, 0.5])
            off = shade(dataclasses.replace(exact, coefficients=coefficients), light, views) - 30.0
            squares = squares + off**2 / 100
        predicted = radiance_error(asset, light, views)
        ratio = np.sqrt(squares.mean(axis=0) / (predicted**2).mean(axis=0))
        assert (np.abs(ratio - 1.0) < 0.03).all()


def test_independent_errors_of_vertices_are_smaller_between_them() -> None:
    asset = make_asset(ball(1), 1, 1)
    sigma = np.random.default_rng(0).uniform(1.0, 2.0, (len(asset.valid), 3))
    corners = asset.mesh.faces[[0, 5]]
    shares = np.array([[0.5, 0.25, 0.25], [1.0, 0.0, 0.0]])
    linear = np.einsum("nk,nkc->nc", shares, sigma[corners])
    squares = np.sqrt(np.einsum("nk,nkc->nc", shares**2, sigma[corners] ** 2))
    for apart, expected in ((None, linear), (0.0, linear), (1.0, squares)):
        shape = (
            None
            if apart is None
            else ErrorCovariance(packed(np.eye(9))[None], np.ones((1, 3)), np.array([[1.0, apart]]))
        )
        found = interpolate_over_faces(dataclasses.replace(asset, error_covariance=shape), shares, corners, sigma)
        np.testing.assert_allclose(found, expected)
        np.testing.assert_allclose(found[1], sigma[corners[1, 0]])


@pytest.mark.parametrize("channels", [3, 1])
def test_the_error_of_radiance_is_predicted(channels: int) -> None:
    """For simulated noise of the coefficients: exact at bin centres, an upper bound between bins."""
    rng = np.random.default_rng(8)
    exact, light = make_asset(ball(3), 16, 64, channels=channels), make_light()
    sigma = (0.002 * rng.uniform(0.5, 2.0, exact.standard_error.shape)).astype(np.float32)
    noise = sigma[:, :, None, None] * rng.normal(size=exact.coefficients.shape)
    noisy = dataclasses.replace(
        exact, coefficients=(exact.coefficients + noise).astype(np.float32), standard_error=sigma
    )
    at_centres = sphere.to_world(exact.directions[77], exact.mesh.normals, exact.tangents)
    between = np.tile([0.0, 0.0, 9.0], (len(exact.mesh.positions), 1))
    for views, least in ((at_centres, 0.93), (between, 0.4)):
        predicted = radiance_error(noisy, light, views)
        off = shade(noisy, light, views) - shade(exact, light, views)
        ratio = np.sqrt((off**2).sum(axis=0) / (predicted**2).sum(axis=0))
        assert (ratio < 1.07).all()
        assert (ratio > least).all()
    picture = render_picture(noisy, constant(), front())
    assert (picture.error[picture.coverage == 0.0] == 0.0).all()
    assert (picture.error[picture.coverage > 0.0] > 0.0).all()
    clean = render_picture(exact, constant(), front())
    off = ((picture.image - clean.image)[picture.coverage > 0.5] ** 2).mean()
    assert off < 1.1 * (picture.error[picture.coverage > 0.5] ** 2).mean()
    assert 0.0 < picture.relative_error < 0.01
