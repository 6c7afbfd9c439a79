"""Pictures of networks with lobes of their own, from which directions are drawn without an importance module."""

import numpy as np
import pytest
import torch

import prt_bake as prt
from formats.mesh import build_mesh
from prt_bake.importance.own_lobes import own_lobes
from prt_bake.network.bssrdf import NeuralBSSRDF
from prt_bake.rendering.loop import Rendering
from tests.network.test_lobes import lobed
from tests.rendering.network_pictures import Lobes, small_network
from tests.rendering.pictures import uneven_sky
from tests.shapes import ball

SPHERE = ball(2)
MESH = build_mesh(0.5 + 0.45 * np.asarray(SPHERE.positions), np.asarray(SPHERE.faces))


def network(power: float = 5.0) -> NeuralBSSRDF:
    """A part of its transport, most by default, is in lobes of about 7°; the rest is even."""
    found = lobed()
    assert found.lobes is not None
    with torch.no_grad():
        bias = found.lobes.bias.view(3, -1)
        bias[:, :3] += power
        bias[:, 3] += 1.0
        found.output.bias += 1.0
    return found


def windows() -> np.ndarray:
    """A dim room with a bright window."""
    sky = np.full((32, 64, 3), 0.05, np.float32)
    sky[12:16, 20:26] = 30.0
    return sky


def picture(sampling: str | None, seed: int, power: float, sky: np.ndarray, spp: int) -> Rendering:
    camera = prt.fit_camera(MESH, 12, 12, view="three-quarter-back")
    return prt.render_network(network(power), MESH, sky, camera, spp, seed, sampling=sampling, background=False)


def test_lobes_are_drawn_by_their_power() -> None:
    found = network().on(MESH)
    axes, sharpness, powers = found.own_lobes(MESH.positions[:6], MESH.normals[:6])
    module = own_lobes(found)
    assert module is not None
    lobe = module.lobe(MESH.positions[:6], MESH.normals[:6], MESH.normals[:6])
    np.testing.assert_allclose(lobe.weights, np.abs(powers).sum(axis=2) / np.abs(powers).sum(axis=(1, 2))[:, None])
    np.testing.assert_array_equal(lobe.axes, axes)
    np.testing.assert_allclose(lobe.sigma**-2, sharpness)


def test_directions_about_an_axis_fall_off_as_the_lobe() -> None:
    found = network().on(MESH)
    axes, sharpness, _ = found.own_lobes(MESH.positions[:1], MESH.normals[:1])
    lobe = own_lobes(found).lobe(MESH.positions[:1], MESH.normals[:1], MESH.normals[:1])
    lobe.weights[:] = np.eye(3)[0]
    drawn = lobe.draw(np.random.default_rng(1).uniform(size=(1, 40_000, 3)))[0]
    near = drawn[drawn @ axes[0, 0] > 1.0 - 4.0 / sharpness[0, 0]]
    below = (1.0 - near @ axes[0, 0]) * sharpness[0, 0]
    # 1 − cos falls off exponentially in the Gaussian; 3 % for the uniform share and the curvature of the sphere.
    expected = 1.0 - 4.0 / np.expm1(4.0)
    assert below.mean() == pytest.approx(expected, rel=0.03)


def test_a_network_without_lobes_has_no_such_sampling() -> None:
    assert own_lobes(small_network()) is None
    assert own_lobes(object()) is None


def test_own_lobes_are_the_default_and_leave_the_picture_unbiased() -> None:
    by_light, both = picture("light", 1, 2.0, uneven_sky(), 2048), picture(None, 2, 2.0, uneven_sky(), 2048)
    assert both.sampling["by"] == "mis"
    covered = by_light.coverage >= 1.0
    error = np.hypot(by_light.standard_error, both.standard_error)[covered]
    z = (by_light.image - both.image)[covered] / error
    assert z.size > 100
    # About one of 10⁴ right programs has a larger mean square of z, for as many z as a third.
    assert np.square(z).mean() < 1.0 + 4.0 * np.sqrt(2.0 / (z.size / 3))
    mean = np.abs((by_light.image - both.image)[covered].mean(axis=0))
    assert (mean < 4.0 * np.sqrt((error**2).reshape(-1, 3).sum(axis=0)) / covered.sum()).all()


def test_own_lobes_lower_the_noise() -> None:
    noise = {sampling: picture(sampling, 3, 5.0, windows(), 512).relative_noise for sampling in ("light", "mis")}
    assert noise["mis"] < 0.7 * noise["light"], noise


def test_a_given_module_is_used_in_place_of_own_lobes() -> None:
    camera, module, called = prt.fit_camera(MESH, 6, 6), Lobes(), []
    lobe = module.lobe
    module.lobe = lambda *points: (called.append(len(points[0])), lobe(*points))[1]
    prt.render_network(network(), MESH, windows(), camera, 16, importance=module, background=False)
    assert called
