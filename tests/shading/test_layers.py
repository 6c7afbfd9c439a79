"""Layers of a picture, and pictures without background."""

import numpy as np
import pytest
from PIL import Image

from formats.errors import ImageError, QueryError
from formats.image import read_image, read_layers, write_image
from formats.image.png import to_srgb
from prt_bake.geometry import camera
from prt_bake.shading.picture import render_picture
from tests.shading.test_picture import constant, front, make_asset
from tests.shapes import ball


def test_position_normal_and_vertex_of_a_ball() -> None:
    mesh = ball(4)
    picture = render_picture(make_asset(mesh), constant(), front(64, 48), layers=("position", "normal", "vertex"))
    position, normal, vertex = (picture.layers[name] for name in ("position", "normal", "vertex"))
    whole, nothing = picture.coverage >= 1.0, picture.coverage <= 0.0
    np.testing.assert_allclose(np.linalg.norm(position[whole], axis=1), 1.0, atol=0.02)
    np.testing.assert_allclose(normal[whole], position[whole], atol=0.03)
    nearest = mesh.positions[vertex[whole].astype(int)]
    assert np.linalg.norm(nearest - position[whole], axis=1).max() < 0.15
    assert not position[nothing].any()
    assert not normal[nothing].any()
    np.testing.assert_array_equal(vertex[nothing], -1)
    # At edges the mean is over the object's part of the pixel.
    edge = (picture.coverage > 0.0) & ~whole
    assert np.linalg.norm(position[edge], axis=1).min() > 0.9
    np.testing.assert_allclose(np.linalg.norm(normal[picture.coverage > 0.0], axis=1), 1.0, atol=1e-6)


def test_only_requested_layers_are_computed_and_unknown_ones_are_refused() -> None:
    asset = make_asset(ball(2))
    assert render_picture(asset, constant(), front()).layers == {}
    with pytest.raises(QueryError, match=r"expected some of position, normal, .*found 'depth'"):
        render_picture(asset, constant(), front(), layers=("depth",))


def test_an_orthographic_picture_equals_one_from_very_far_away() -> None:
    asset = make_asset(ball(3))
    far = camera.fit(asset.mesh, 48, 48, [3e4, 4e4, 0.0], fov=1e-3)
    distance = np.linalg.norm(far.eye - far.target)
    extent = 2.0 * distance * np.tan(np.radians(far.fov) / 2.0)
    flat = camera.fit(asset.mesh, 48, 48, far.eye, extent=extent)
    ours, theirs = (render_picture(asset, constant(), view, background=False, samples=2).image for view in (flat, far))
    assert abs(ours - theirs).mean() < 1e-3 * theirs.mean()


def test_a_transparent_picture_composes_over_a_colour(tmp_path) -> None:
    picture = render_picture(make_asset(ball(2)), constant((0.2, 0.3, 0.4)), front(), background=False)
    whole = render_picture(make_asset(ball(2)), constant((0.2, 0.3, 0.4)), front())
    write_image(tmp_path / "a.exr", picture.image, alpha=picture.coverage)
    layered = read_layers(tmp_path / "a.exr")
    over = layered.image + (1.0 - layered.layers["A"])[..., None] * np.array([0.2, 0.3, 0.4], np.float32)
    np.testing.assert_allclose(over, whole.image, atol=1e-6)
    np.testing.assert_array_equal(read_image(tmp_path / "a.exr"), picture.image)
    write_image(tmp_path / "a.png", picture.image, alpha=picture.coverage)
    stored = np.asarray(Image.open(tmp_path / "a.png"), np.float64) / 255.0
    np.testing.assert_allclose(stored[..., 3], picture.coverage, atol=0.5 / 255)
    # PNG is not premultiplied: an edge is as bright as the object next to it.
    inside = picture.coverage > 0.0
    due = to_srgb(picture.image[inside] / picture.coverage[inside][:, None])
    np.testing.assert_allclose(stored[inside][:, :3], due, atol=0.6 / 255)
    np.testing.assert_array_equal(stored[~inside], 0.0)


def test_alpha_of_another_size_or_in_a_format_without_alpha_is_refused(tmp_path) -> None:
    image = np.zeros((4, 5, 3))
    with pytest.raises(ImageError, match=r"alpha: expected shape \[4, 5\], found \[5, 4\]"):
        write_image(tmp_path / "a.exr", image, alpha=np.zeros((5, 4)))
    with pytest.raises(ImageError, match=r"write \.exr or \.png"):
        write_image(tmp_path / "a.hdr", image, alpha=np.zeros((4, 5)))
    assert not list(tmp_path.iterdir())
