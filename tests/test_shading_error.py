"""The error that a bake has left, as pictures tell it."""

import dataclasses

import numpy as np
import pytest
from test_shading import ball, constant, front, make_asset, make_light

from prt_bake import sphere
from prt_bake.shading import radiance_error, render_picture, shade


@pytest.mark.parametrize("channels", [3, 1])
def test_the_error_of_radiance_is_told(channels: int) -> None:
    """Noise of the standard error's size on the coefficients: at bin centres exactly, between bins at most."""
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
        told = radiance_error(noisy, light, views)
        off = shade(noisy, light, views) - shade(exact, light, views)
        ratio = np.sqrt((off**2).sum(axis=0) / (told**2).sum(axis=0))
        assert (ratio < 1.07).all()
        assert (ratio > least).all()
    picture = render_picture(noisy, constant(), front())
    assert (picture.error[picture.coverage == 0.0] == 0.0).all()
    assert (picture.error[picture.coverage > 0.0] > 0.0).all()
    clean = render_picture(exact, constant(), front())
    off = ((picture.image - clean.image)[picture.coverage > 0.5] ** 2).mean()
    assert off < 1.1 * (picture.error[picture.coverage > 0.5] ** 2).mean()
    assert 0.0 < picture.relative_error < 0.01
