"""NeRFactor from pictures: a Lambert surface is recovered, and an unknown light up to its scale."""

import numpy as np
import pytest
import torch

from formats.errors import QueryError
from formats.image.png import to_srgb as written_srgb
from formats.scene import read_scene
from prt_bake.baselines.lit_surface import LitSurface
from prt_bake.baselines.nerfactor import NeRFactor, NeRFactorSettings
from prt_bake.baselines.nerfactor_pictures import train_from_pictures
from prt_bake.baselines.nerfactor_views import View, cameras, light_pixels, path_traced_views
from prt_bake.baselines.picture_fit import PictureFit, PictureSettings, to_srgb
from prt_bake.geometry.camera import Visibility, rays
from prt_bake.lights.environment import direction_of, project
from prt_bake.lights.lighting import as_lighting
from prt_bake.mathematics.sphere import fibonacci
from tests.shapes import ball
from tests.trainer.small_training import make_scene

ALBEDO = np.array([0.6, 0.4, 0.2])
LATTICE = fibonacci(4096)
FEW = PictureSettings(views=3, size=10, spp=2, held_out_queries=32, held_out_walks=32)


def sky(directions):
    """A smooth sky, brighter from above and from +x, and bluer from above."""
    x, y, _z = np.moveaxis(directions, -1, 0)
    return np.stack([1.0 + 0.6 * x, 1.0 + 0.3 * x + 0.2 * y, 1.0 + 0.8 * y], axis=-1)


def sky_picture(rows=32):
    v, u = np.meshgrid((np.arange(rows) + 0.5) / rows, (np.arange(2 * rows) + 0.5) / (2 * rows), indexing="ij")
    return sky(direction_of(u, v)).astype(np.float32)


class Ball:
    """What `cameras` needs of a scene."""

    mesh, up = ball(4), "y"


def lambert_views(model, count):
    """Views of a Lambert ball under `sky`, integrated on a lattice instead of the light's pixels."""
    light, visibility, views = light_pixels((16, 32), "y"), Visibility(Ball.mesh), []
    for camera in cameras(Ball, count, 24):
        through = rays(camera, slice(0, 24), np.array([[0.5, 0.5]])).rows()
        hits = visibility.first_hits(through.origins, through.directions)
        seen = np.flatnonzero(hits.faces >= 0)
        corners = Ball.mesh.positions[Ball.mesh.faces[hits.faces[seen]]]
        u, v = hits.barycentric[seen, :1], hits.barycentric[seen, 1:]
        positions = (1.0 - u - v) * corners[:, 0] + u * corners[:, 1] + v * corners[:, 2]
        normals = np.array(Ball.mesh.face_normals)[hits.faces[seen]]
        irradiance = 4.0 * np.pi / len(LATTICE) * np.maximum(normals @ LATTICE.T, 0.0) @ sky(LATTICE)
        visible = np.packbits(normals @ light.directions.T > 0.0, axis=1)
        views.append(View(positions, -through.directions[seen], normals, visible, ALBEDO / np.pi * irradiance))
    return views


def fitted(light, steps, **pictures):
    settings = NeRFactorSettings(width=32, octaves=2, reflectance=0.0, seed=1)
    model = NeRFactor(settings, Ball.mesh, metadata={"up": "y"})
    fit = PictureFit(model, sky_picture(), light, PictureSettings(rays=128, **pictures), seed=1)
    views = lambert_views(model, 13)
    fit.use(views[:-1], views[6])
    for _ in range(steps):
        fit.step()
    fit.fix_scale()
    return fit


def albedo_of(fit):
    with torch.no_grad():
        return fit.model.albedo(fit.model.encode_positions(torch.from_numpy(Ball.mesh.positions))).numpy()


@pytest.fixture(scope="module")
def of_unknown_light():
    """On a ball each normal has one position: only smoothness, asked for widely, tells albedo from light."""
    return fitted("unknown", 1200, jitter=0.3)


def test_a_lambert_sphere_is_recovered_under_a_known_light():
    fit = fitted("known", 200)
    assert np.sqrt(np.mean((albedo_of(fit) / ALBEDO - 1.0) ** 2)) < 0.02
    # Both lights are the same: nothing is left to scale.
    np.testing.assert_allclose(fit.model.albedo_scale, 1.0, rtol=0.02)


@pytest.mark.statistics
def test_a_lambert_sphere_is_recovered_under_an_unknown_light(of_unknown_light):
    found = albedo_of(of_unknown_light)
    np.testing.assert_allclose(found.mean(axis=0), ALBEDO, rtol=0.02)


@pytest.mark.statistics
def test_the_unknown_light_is_recovered_up_to_its_scale(of_unknown_light):
    """A Lambert sphere shows a light up to its second band (Ramamoorthi and Hanrahan 2001)."""
    found, true = project(of_unknown_light.found_light()), project(sky_picture())
    scale = np.sum(found * true, axis=0) / np.sum(true**2, axis=0)
    assert (scale > 0.0).all()
    assert np.abs(found / scale - true).max() < 0.05 * np.abs(true).max()


def test_pixels_belong_to_the_points_that_they_show(tmp_path):
    """Under light from +x a dense object is bright where its normals point there, in every view from a side."""
    make_scene(tmp_path, eta=1.3, roughness=0.4)
    text = (tmp_path / "scene.toml").read_text()
    (tmp_path / "scene.toml").write_text(text.replace("sigma_t = 4.0", "sigma_t = 60.0"))
    scene = read_scene(tmp_path / "scene.toml")
    lit, light = LitSurface(scene.mesh), light_pixels((16, 32), "y")
    from_x = np.repeat(np.maximum(light.directions[:, :1], 0.0), 3, axis=1).reshape(16, 32, 3).astype(np.float32)
    sides = [camera for camera in cameras(scene, 12, 20) if abs(camera.forward[0]) < 0.5]
    views, walks = path_traced_views(
        scene, as_lighting(from_x, "y", 0.0), lit, light, sides, 100, 0, lambda _view: None, lambda _share: None
    )
    assert walks > 0
    assert len(views) > 4
    for view in views:
        assert np.corrcoef(view.radiance.mean(axis=1), view.normals[:, 0])[0, 1] > 0.7
        # A convex body is lit wherever light is above its horizon.
        lit_pixels = np.unpackbits(view.visible, axis=1, count=512).astype(bool)
        np.testing.assert_array_equal(lit_pixels, view.normals @ light.directions.T > 0.0)


def test_pixels_are_encoded_as_in_files():
    linear = np.linspace(0.0, 1.0, 200, dtype=np.float32)
    np.testing.assert_allclose(to_srgb(torch.from_numpy(linear)), written_srgb(linear), atol=2e-6)


@pytest.mark.parametrize("light", ["known", "unknown"])
def test_pictures_are_path_traced_and_learned_from(tmp_path, light):
    scene = make_scene(tmp_path, eta=1.3, roughness=0.4)
    small = NeRFactorSettings(width=16, octaves=2)
    reports = []
    arguments = {"light": light, "settings": small, "pictures": FEW, "steps": 6, "sky": sky_picture(8)}
    model = train_from_pictures(scene, progress=reports.append, output=tmp_path / "model.pt", **arguments)
    training = model.metadata["training"]
    assert (training["steps"], training["light_known"], training["stopped"]) == (6, light == "known", False)
    assert np.shape(training["light"]) == (16, 32, 3)
    assert training["relative_rmse"]["coefficients"] > 0.0
    assert training["walks"] > 0
    assert [report.step for report in reports] == [6]
    again = train_from_pictures(scene, **arguments)
    for name, tensor in model.state_dict().items():
        assert torch.equal(tensor, again.state_dict()[name])


def test_what_pictures_cannot_do_is_refused(tmp_path):
    scene = make_scene(tmp_path)
    black = np.zeros((4, 8, 3))
    for arguments, message in (
        ({"resume": True}, "cannot be resumed"),
        ({"samples": "some.h5"}, "learns from pictures, not from the samples some.h5"),
        ({"light": "dim"}, 'expected "unknown" or "known", found \'dim\''),
        ({"device": "cuda"}, "expected device 'cpu'"),
        ({"sky": black, "steps": 1, "pictures": FEW}, "found a black picture"),
        ({"steps": 0}, "must be positive"),
    ):
        with pytest.raises(QueryError, match=message):
            train_from_pictures(scene, **arguments)
