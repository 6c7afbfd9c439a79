"""NeRFactor's sum over pixels of light and the renderer agree: units, exposure, up axis and occlusion."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

import prt_bake as prt
from formats.scene.lights import DirectionalLight
from prt_bake.baselines import nerfactor_views
from prt_bake.baselines.nerfactor import NeRFactor, NeRFactorSettings
from prt_bake.baselines.picture_fit import PictureFit, PictureSettings
from prt_bake.lights.lighting import Lighting
from tests.shapes import ring

SMALL = NeRFactorSettings(width=32, octaves=2, least_roughness=0.8, seed=1)
PICTURES = PictureSettings(views=2, size=24, albedo_smoothness=0.0, roughness_smoothness=0.0)


def lights(up):
    """Lights in the centres of pixels of a coarse sky: the sum over its pixels is exact for them."""
    rows, columns = np.array([2, 4, 5, 7, 8, 9, 11, 13]), np.array([3, 14, 28, 9, 20, 31, 6, 17])
    theta, phi = np.pi * (rows + 0.5) / 16, 2.0 * np.pi * ((columns + 0.5) / 32 - 0.5)
    x, y, z = np.cos(phi) * np.sin(theta), np.cos(theta), np.sin(phi) * np.sin(theta)
    directions = np.stack([x, y, z] if up == "y" else [x, -z, y], axis=1)
    colours = np.random.default_rng(0).uniform(0.2, 30.0, (8, 3))
    return Lighting((), tuple(DirectionalLight(*pair, 0.0) for pair in zip(directions, colours, strict=True)))


def textured(scene):
    """A glossy model whose albedo varies over the surface."""
    model = NeRFactor(SMALL, scene.mesh, metadata={"up": scene.up, "normals": "vertex"})
    torch.nn.init.normal_(model.albedo_layers[-1].weight, std=0.6, generator=torch.Generator().manual_seed(5))
    return model


@pytest.mark.parametrize("up", ["y", "z"])
@pytest.mark.parametrize("light", ["known", "unknown"])
def test_pictures_of_a_brdf_are_explained_by_it(monkeypatch, light, up):
    """The sum over the light's pixels is the radiance that the renderer finds, in its units."""
    scene = SimpleNamespace(mesh=ring(around=48, across=24), up=up)
    true, lighting = textured(scene), lights(up)

    def rendered(scene, lighting, camera, **_options):
        return prt.render_network(true, scene.mesh, lighting, camera, spp=4, background=False)

    monkeypatch.setattr(nerfactor_views, "render_scene", rendered)
    fit = PictureFit(true, lighting, light, PICTURES, seed=1)
    fit.trace(scene, None, lambda _share: None)
    fit.fix_scale()
    # A pixel is the mean over its area, and the model is evaluated in its centre.
    np.testing.assert_allclose(true.albedo_scale, 1.0, rtol=0.01)
    if light == "known":
        assert fit.step() < 1e-3  # mean square of sRGB values, most of it at hard shadows
