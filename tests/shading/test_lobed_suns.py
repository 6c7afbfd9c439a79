"""Suns on assets with lobes: bright places keep their lobes, dark ones have no stains."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import prt_bake as prt
from prt_bake.lights.lighting import Lighting, Sky
from prt_bake.mathematics.directions import fibonacci, random_rotations
from prt_bake.shading.vertices import shade_vertices
from tests.baking.lobes.transports import MESH, Lobed, along_normal, towards
from tests.lights.test_suns import clouds
from tests.shading.test_frame_lobes import everywhere
from tests.shading.test_picture import front
from tests.shading.test_suns import sun

VIEWS = towards(0.3)


class Opaque:
    """Light from the front of a ball, and nearly none from behind."""

    def evaluate(self, incident: Any, positions: Any, outgoing: Any) -> np.ndarray:
        """Ŝ [N,D,3]."""
        normals = np.asarray(positions) / np.linalg.norm(positions, axis=1, keepdims=True)
        cosine = np.einsum("ndi,ni->nd", np.broadcast_to(incident, (len(normals), *np.shape(incident)[-2:])), normals)
        return np.repeat((np.clip(cosine, 0.0, None) ** 0.5 + 0.01)[..., None], 3, axis=-1)


@pytest.fixture(scope="module")
def opaque():
    return prt.bake(Opaque(), MESH, rings=4, sectors=16, lobes=4)


def test_the_dark_has_fewer_errors_and_the_light_keeps_its_lobes(opaque) -> None:
    dark, bright = [], []
    for direction in fibonacci(30):
        light = prt.light_for(opaque, Lighting((), (sun(direction, (1.0, 1.0, 1.0), 0.0),)))
        exact = Opaque().evaluate(direction[None], MESH.positions, VIEWS)[:, 0]
        errors = [prt.shade(opaque, lit, VIEWS) - exact for lit in (light, everywhere(light))]
        cosine = MESH.normals @ direction
        dark.append([error[cosine < -0.3] for error in errors])
        bright.append([error[cosine > 0.3] for error in errors])
    (after, before), (in_light, in_light_before) = (
        [np.sqrt(np.mean(np.concatenate(each) ** 2)) for each in zip(*part, strict=True)] for part in (dark, bright)
    )
    assert after < 0.7 * before
    assert in_light < 1.1 * in_light_before


def test_the_error_under_suns_has_the_size_of_the_true_one(opaque) -> None:
    """Stated and true, over vertices in the light and in the dark, of a transport with an edge."""
    for sine in (-0.9, 0.0, 0.9):
        direction = np.array([np.sqrt(1.0 - sine**2), sine, 0.0])
        light = prt.light_for(opaque, Lighting((), (sun(direction, (1.0, 1.0, 1.0), 0.0),)))
        shown = shade_vertices(opaque, light, VIEWS)
        exact = Opaque().evaluate(direction[None], MESH.positions, VIEWS)[:, 0]
        for some in (MESH.normals @ direction > 0.3, MESH.normals @ direction < -0.3):
            stated, true = (np.sqrt(np.mean(part[some] ** 2)) for part in (shown.sun_error, shown.radiance - exact))
            assert 0.25 * true < stated < 4.0 * true


def test_a_picture_states_the_part_of_its_suns(opaque) -> None:
    alone, both = Lighting((), (sun(),)), Lighting((Sky(clouds(32), "y", np.eye(3)),), (sun(),))
    sunny, mixed = (prt.render_picture(opaque, light, front(), background=False).errors for light in (alone, both))
    assert 0.0 < mixed.suns < 0.9 * sunny.suns < 0.3
    assert prt.render_picture(opaque, clouds(32), front()).errors.suns == 0.0
    assert prt.render_picture(opaque, alone, front(), suns="plain").errors.suns is None
    assert prt.render_picture(replace(opaque, lobes=None), alone, front()).errors.suns is None


def test_radiance_scales_with_the_suns_and_skies_are_beside_them(opaque) -> None:
    sky = Lighting((Sky(clouds(32), "y", np.eye(3)),))
    light, brighter = (prt.light_for(opaque, Lighting((), (sun(irradiance=s * np.ones(3)),))) for s in (1.0, 1e6))
    np.testing.assert_allclose(prt.shade(opaque, brighter, VIEWS), 1e6 * prt.shade(opaque, light, VIEWS), rtol=1e-9)
    suns = sun(irradiance=np.ones(3)), sun((-0.6, 0.0, 0.8), (0.5, 1.0, 2.0), 6.0)
    parts = sky, Lighting((), suns[:1]), Lighting((), suns[1:]), Lighting(sky.skies, suns)
    *each, whole = (prt.shade(opaque, prt.light_for(opaque, part), VIEWS) for part in parts)
    np.testing.assert_allclose(whole, sum(each), rtol=1e-6)


def test_lobes_that_are_exact_stay_nearly_so() -> None:
    transport = Lobed(((along_normal, 12.0, 1.0),))
    asset = prt.bake(transport, MESH, rings=4, sectors=16, lobes=4)
    for direction in random_rotations(3, 1)[:, 0]:
        light = prt.light_for(asset, Lighting((), (sun(direction, (1.0, 1.0, 1.0), 0.0),)))
        exact = transport.evaluate(direction[None], MESH.positions, VIEWS)[:, 0]
        found = prt.shade(asset, light, VIEWS)
        assert np.abs(found - exact).max() < 0.02 * exact.max()
