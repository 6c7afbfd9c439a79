"""Rotating the sky equals rotating object and eye the other way, for pictures with suns and reflections."""

import dataclasses

import numpy as np
import pytest

from formats.asset import Asset
from formats.mesh import build_mesh
from prt_bake.geometry.camera import Camera
from prt_bake.lights import environment
from prt_bake.lights.lighting import Lighting, Sky
from prt_bake.mathematics import sh
from prt_bake.shading import turntable as turntable_module
from prt_bake.shading.picture import render_picture
from prt_bake.shading.turntable import turntable
from tests.shading.test_picture import front, make_asset, painted_sky
from tests.tracer.scenes import lumpy


def glossy(roughness: float) -> Asset:
    return make_asset(lumpy(2), provenance={"eta": 1.4, "roughness": roughness})


def turned_asset(asset: Asset, turn: np.ndarray) -> Asset:
    """The rotated object with its transport: a'(R x, R ωo) = M(R) a(x, ωo)."""
    mesh = build_mesh(asset.mesh.positions @ turn.T, asset.mesh.faces)
    rotated = np.einsum("kj,vbjc->vbkc", sh.rotation(turn, asset.degree), asset.coefficients.astype(np.float64))
    return dataclasses.replace(asset, mesh=mesh, tangents=asset.tangents @ turn.T, coefficients=rotated)


def turned_camera(view: Camera, turn: np.ndarray) -> Camera:
    return dataclasses.replace(view, eye=turn @ view.eye, target=turn @ view.target, up=turn @ view.up)


def with_sun(sky: np.ndarray) -> np.ndarray:
    sky = np.repeat(np.repeat(sky, 16, axis=0), 16, axis=1)
    sky[70, 40] = 1e5
    return sky


@pytest.mark.parametrize("degrees", [90.0, -37.0])
@pytest.mark.parametrize("sky", [painted_sky(), with_sun(painted_sky())], ids=["painted", "sun"])
@pytest.mark.parametrize("options", [{}, {"reflection": True}], ids=["plain", "reflection"])
def test_rotating_the_sky_equals_rotating_object_and_eye_the_other_way(
    degrees: float, sky: np.ndarray, options
) -> None:
    asset, view = glossy(0.3), front()
    back = environment.rotation(-degrees, "y")
    by_sky = render_picture(asset, sky, view, rotate=degrees, background=False, **options)
    by_object = render_picture(turned_asset(asset, back), sky, turned_camera(view, back), background=False, **options)
    assert by_sky.image.max() > 0.5
    # A ray at the silhouette may hit in one picture and miss in the other.
    close = np.isclose(by_sky.image, by_object.image, rtol=1e-5, atol=1e-5).all(axis=2)
    assert close.mean() > 0.995
    assert by_sky.suns == by_object.suns == (1 if sky.max() > 1e4 else 0)


def test_a_turntable_prepares_a_light_that_stays_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """That of an asset with lobes takes seconds. The frames are those of single pictures."""
    asset, view, sky = glossy(0.3), front(), Lighting((Sky(painted_sky(), "y", np.eye(3)),))
    eyes = [environment.rotation(angle, "y") @ (view.eye - view.target) + view.target for angle in (0.0, 120.0, 240.0)]
    alone = [render_picture(asset, sky, dataclasses.replace(view, eye=eye), suns="window").image for eye in eyes]
    prepared = []
    kept = turntable_module.prepare_light
    monkeypatch.setattr(turntable_module, "prepare_light", lambda *light: prepared.append(light) or kept(*light))
    frames = [picture.image for picture in turntable(asset, sky, view, 3, "eye", suns="window")]
    assert len(prepared) == 1
    np.testing.assert_array_equal(frames, alone)
