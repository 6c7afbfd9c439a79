"""Shading and pictures of assets: reconstruction, light, rotation, visibility, errors."""

import dataclasses
import math
import subprocess
import sys

import numpy as np
import pytest

from formats.asset import Asset, read_asset, write_asset
from formats.errors import QueryError
from formats.mesh import Mesh
from prt_bake.geometry import camera
from prt_bake.geometry.camera import Camera
from prt_bake.lights import environment
from prt_bake.mathematics import sh, sphere
from prt_bake.shading import picture as shading
from prt_bake.shading.picture import render_picture, shade, shade_vertices
from tests import ROOT
from tests.shading import reference
from tests.shading.assets import asset_of
from tests.shapes import ball, ring


def make_asset(
    mesh: Mesh, rings=4, sectors=6, degree=2, seed=0, storage="float32", views=None, channels=3, valid=None, **others
) -> Asset:
    """A positive first coefficient and small others, so that radiance is positive in these tests."""
    rng = np.random.default_rng(seed)
    bins, terms, vertices = rings * sectors, sh.count(degree), len(mesh.positions)
    coefficients = 0.02 * rng.normal(size=(vertices, views or bins, terms, channels))
    coefficients[:, :, 0] += 1.0
    if valid is not None:
        others["valid"] = valid
    return asset_of(mesh, coefficients.astype(storage), rings, sectors, degree, **others)


def make_light(degree=2, seed=5) -> np.ndarray:
    light = 0.3 * np.random.default_rng(seed).normal(size=(sh.count(degree), 3))
    light[0] = 2.0
    return light


def constant(radiance=(1.0, 1.0, 1.0)) -> np.ndarray:
    return np.tile(np.array(radiance, np.float32), (8, 16, 1))


def painted_sky() -> np.ndarray:
    sky = np.random.default_rng(3).random((16, 32, 3)).astype(np.float32)
    sky[:8] += 2.0
    return sky


def front(width=40, height=30, eye=(0.0, 0.5, 4.0)) -> Camera:
    return Camera(np.array(eye), np.zeros(3), np.array([0.0, 1.0, 0.0]), 45.0, width, height)


VIEWS = np.concatenate([sphere.uniform(60, 1), sphere.fibonacci(6)])


@pytest.mark.parametrize("storage", ["float32", "float16"])
@pytest.mark.parametrize(("rings", "sectors", "degree"), [(16, 64, 2), (4, 6, 3), (1, 1, 2), (1, 5, 1), (3, 1, 0)])
@pytest.mark.parametrize(("views", "channels"), [(None, 3), (1, 3), (None, 1), (1, 1)])
def test_the_compiled_kernel_equals_the_slow_reference(storage, rings, sectors, degree, views, channels) -> None:
    """For directions over the whole sphere; below the horizon the last ring is used."""
    valid = np.arange(66) % 5 != 2
    asset = make_asset(ball(2), rings, sectors, degree, 0, storage, views, channels, valid)
    light = make_light(degree)
    expected = np.maximum(reference.reconstruct(asset, light, VIEWS), 0.0)
    np.testing.assert_allclose(shade(asset, light, VIEWS), expected, rtol=0, atol=1e-12)
    assert (expected[~valid] == 0).all()
    assert (expected[valid] > 0).all()


@pytest.mark.parametrize("cos_theta", [1.0, 1 - 1e-9, 1 - 0.5 / 16, 0.5 / 16, 1e-3, 0.0])
def test_pole_seam_and_grazing_equal_the_reference(cos_theta: float) -> None:
    asset = make_asset(ball(2), 16, 64)
    phi = np.concatenate([np.linspace(-1e-3, 1e-3, 33), np.linspace(-math.pi, math.pi, 33)])
    sin_theta = math.sqrt(1 - cos_theta**2)
    local = np.stack([sin_theta * np.cos(phi), sin_theta * np.sin(phi), np.full(66, cos_theta)], axis=1)
    views = sphere.to_world(local, asset.mesh.normals, asset.tangents)
    expected = reference.reconstruct(asset, make_light(), views)
    np.testing.assert_allclose(shade(asset, make_light(), views), expected, rtol=0, atol=1e-12)


def test_along_the_normal_the_mean_of_ring_0_is_used() -> None:
    asset = make_asset(ball(2))
    expected = np.einsum("vkc,kc->vc", asset.coefficients[:, :6].astype(np.float64).mean(axis=1), make_light())
    np.testing.assert_allclose(shade(asset, make_light(), asset.mesh.normals), expected, rtol=0, atol=1e-12)


def test_the_centre_of_a_bin_gives_that_bin() -> None:
    asset = make_asset(ball(2))
    for b, local in enumerate(asset.directions):
        views = sphere.to_world(local, asset.mesh.normals, asset.tangents)
        expected = np.einsum("vkc,kc->vc", asset.coefficients[:, b].astype(np.float64), make_light())
        np.testing.assert_allclose(shade(asset, make_light(), views), expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("storage", ["float32", "float16"])
def test_an_open_file_is_shaded_like_the_array_in_it(tmp_path, monkeypatch, storage) -> None:
    """With small chunks, few chunks at a time, and vertices in some of them."""
    monkeypatch.setattr("formats.asset.asset_file._CHUNK_BYTES", 8_000)
    monkeypatch.setattr("prt_bake.shading.reconstruction._BYTES_AT_ONCE", 30_000)
    asset = make_asset(ball(2), storage=storage, valid=np.arange(66) % 7 != 0)
    write_asset(asset, tmp_path / "asset.h5")
    opened = read_asset(tmp_path / "asset.h5", load=False)
    assert not isinstance(opened.coefficients, np.ndarray)
    assert 1 < opened.coefficients.chunks[0] < 10
    loaded = dataclasses.replace(opened, coefficients=opened.coefficients[:])
    some = np.arange(66) % 13 == 1
    for visible in (None, some, np.zeros(66, np.bool_)):
        ours, theirs = (shade_vertices(part, make_light(), VIEWS, visible) for part in (opened, loaded))
        np.testing.assert_array_equal(ours.radiance, theirs.radiance)
        assert ours.shaded == theirs.shaded
    assert shade(opened, make_light(), VIEWS).any()
    opened.close()


def test_a_constant_sky_gives_its_radiance_times_the_first_coefficient() -> None:
    asset = make_asset(ball(2), views=1)
    light = environment.project(constant((1.0, 2.0, 0.5)))
    expected = math.sqrt(4 * math.pi) * asset.coefficients[:, 0, 0].astype(np.float64) * [1.0, 2.0, 0.5]
    np.testing.assert_allclose(shade(asset, light, [0, 0, 9.0]), expected, rtol=1e-9)


def test_radiance_is_linear_in_the_light() -> None:
    asset, eye = make_asset(ball(2)), np.array([1.0, 2.0, 9.0])
    one, two = make_light(seed=1), make_light(seed=2)
    mixed = shade(asset, 0.3 * one + 2.0 * two, eye)
    np.testing.assert_allclose(mixed, 0.3 * shade(asset, one, eye) + 2.0 * shade(asset, two, eye), rtol=1e-12)


def test_rotating_the_light_equals_rotating_object_and_eye_back() -> None:
    asset, eye = make_asset(ball(2)), np.array([1.0, 2.0, 3.0])
    for turn in sphere.random_rotations(5, seed=4):
        back = turn.T
        mesh = Mesh(asset.mesh.positions @ back.T, asset.mesh.faces, asset.mesh.normals @ back.T)
        turned = dataclasses.replace(
            asset,
            mesh=mesh,
            tangents=asset.tangents @ back.T,
            coefficients=(sh.rotation(back, 2) @ asset.coefficients).astype(np.float32),
        )
        under_turned_light = shade(asset, sh.rotation(turn, 2) @ make_light(), eye)
        np.testing.assert_allclose(shade(turned, make_light(), back @ eye), under_turned_light, rtol=1e-5)


def test_a_distant_eye_equals_one_direction() -> None:
    asset = make_asset(ball(2))
    direction = np.array([2.0, -3.0, 6.0]) / 7.0
    expected = shade(asset, make_light(), np.tile(direction, (66, 1)))
    np.testing.assert_allclose(shade(asset, make_light(), 1e9 * direction), expected, rtol=1e-7)
    np.testing.assert_allclose(shade(asset, make_light(), np.tile(5.0 * direction, (66, 1))), expected, rtol=1e-12)


def test_negative_radiance_is_clamped_and_reported() -> None:
    asset = make_asset(ball(2), views=1, degree=0)
    coefficients = np.ones_like(asset.coefficients)
    coefficients[:22] = -0.5
    part = shade_vertices(dataclasses.replace(asset, coefficients=coefficients), np.ones((1, 3)), [0, 0, 9.0])
    assert part.radiance.min() == 0.0
    assert part.clamped == pytest.approx(0.5 * 22 / 44, rel=1e-12)
    none = shade_vertices(dataclasses.replace(asset, coefficients=-np.abs(coefficients)), np.ones((1, 3)), [0, 0, 9.0])
    assert (none.radiance.any(), none.clamped) == (False, 1.0)


def test_asset_and_light_are_unchanged() -> None:
    asset, light = make_asset(ball(2), storage="float16"), make_light()
    coefficients, before = asset.coefficients.copy(), light.copy()
    shade(asset, light, [0, 0, 9.0])
    np.testing.assert_array_equal(asset.coefficients, coefficients)
    np.testing.assert_array_equal(light, before)


def test_an_asset_made_for_one_light_is_shaded() -> None:
    asset = dataclasses.replace(make_asset(ball(2), views=1, degree=0), quantity="radiance", degree=2)
    np.testing.assert_allclose(shade(asset, None, [0, 0, 9.0]), asset.coefficients[:, 0, 0], rtol=1e-12)
    picture = render_picture(asset, constant(), front())
    assert picture.image[15, 20] == pytest.approx(np.ones(3), abs=0.1)
    with pytest.raises(QueryError, match="cannot be relit"):
        shade(asset, make_light(), [0, 0, 9.0])


@pytest.mark.parametrize(
    ("light", "sentence"),
    [
        (np.ones((4, 3)), r"shape \[9, 3\] for an asset of degree 2, found \[4, 3\]"),
        (np.ones((16, 3)), r"shape \[9, 3\] .*found \[16, 3\]"),
        (np.ones(9), r"shape \[9, 3\] .*found \[9\]"),
        (np.full((9, 3), np.nan), "27 of its coefficients are not finite"),
        (None, r"expected shape \[9, 3\]"),
        ("sky.hdr", r"expected coefficients \[K, 3\], .*found the text 'sky.hdr'"),
        (object(), "found an object"),
    ],
)
def test_lights_that_do_not_fit_are_refused(light, sentence: str) -> None:
    with pytest.raises(QueryError, match=sentence):
        shade(make_asset(ball(2)), light, [0, 0, 9.0])


@pytest.mark.parametrize(
    ("eye", "sentence"),
    [
        (ball(2).positions[17], "eye"),
        (1.00001 * ball(2).positions[17], "on the surface"),
        ((0.1, 0.2, 0.1), "inside the object"),
        ((0, 0, math.inf), "finite"),
        ((0, math.nan, 9), "finite"),
        ((0, 0, 1e200), "finite"),
        ((0, 9), r"a point \[3\] or directions \[66, 3\], found shape \[2\]"),
        (np.ones((65, 3)), r"found shape \[65, 3\]"),
        (np.zeros((66, 3)), "66 vertices, the first is 0"),
    ],
)
def test_eyes_that_see_nothing_are_refused(eye, sentence: str) -> None:
    with pytest.raises(QueryError, match=sentence):
        shade(make_asset(ball(2)), make_light(), eye)


def test_an_asset_without_any_baked_vertex_is_refused() -> None:
    asset = make_asset(ball(2), valid=np.zeros(66, np.bool_))
    with pytest.raises(QueryError, match="no vertex was baked"):
        shade(asset, make_light(), [0, 0, 9.0])
    with pytest.raises(QueryError, match="no vertex was baked"):
        render_picture(asset, constant(), front())


def test_a_white_furnace_is_invisible() -> None:
    """∫ Ŝ dωi = 1 everywhere: object, sky and silhouettes have the same radiance."""
    asset = make_asset(ring())
    coefficients = np.zeros_like(asset.coefficients)
    coefficients[:, :, 0] = 1 / math.sqrt(4 * math.pi)
    picture = render_picture(dataclasses.replace(asset, coefficients=coefficients), constant(), front())
    assert 0.1 < picture.coverage.mean() < 0.9
    np.testing.assert_allclose(picture.image, 1.0, rtol=0, atol=1e-6)


@pytest.mark.parametrize("eye", [(0.0, 0.5, 4.0), (-3.0, 2.0, -1.0), (0.3, 0.1, 0.2)])
def test_a_picture_shows_vertex_radiance_interpolated_over_faces(eye) -> None:
    """With one sample per pixel, compared with the nearest face and with the look-up of the sky."""
    asset, view = make_asset(ring()), front(eye=eye)
    sky = painted_sky()
    picture = render_picture(asset, sky, view, samples=1)
    rays = camera.directions(view, slice(None), np.array([[0.5, 0.5]])).reshape(-1, 3)
    corners = asset.mesh.positions[asset.mesh.faces]
    faces, distance = reference.nearest_hits(corners, view.eye, rays)
    radiance = reference.reconstruct(asset, environment.project(sky), view.eye)
    hit = faces >= 0
    np.testing.assert_array_equal(picture.coverage.ravel() > 0, hit)
    points = view.eye + distance[hit, None] * rays[hit]
    shares = np.linalg.solve(corners[faces[hit]].transpose(0, 2, 1), points[..., None])[..., 0]
    expected = environment.lookup(sky, rays)
    expected[hit] = np.einsum("nk,nkc->nc", shares, radiance[asset.mesh.faces[faces[hit]]])
    np.testing.assert_allclose(picture.image.reshape(-1, 3), expected, rtol=0, atol=2e-4)


def test_only_visible_vertices_are_shaded(monkeypatch) -> None:
    requested = []

    def recording(asset, light, eye, visible=None, suns=()):
        requested.append(visible)
        return shade_vertices(asset, light, eye, visible)

    monkeypatch.setattr(shading, "shade_vertices", recording)
    asset = make_asset(ball(3))
    picture = render_picture(asset, constant(), front())
    behind = asset.mesh.positions @ [0.0, 0.5, 4.0] < -1.5
    assert picture.shaded == requested[0].sum() < 0.6 * len(asset.valid)
    assert not requested[0][behind].any()


def test_pictures_of_different_sizes_agree() -> None:
    asset, sky = make_asset(ball(3)), painted_sky()
    small = render_picture(asset, sky, front(), samples=4)
    large = render_picture(asset, sky, front(160, 120), samples=1)
    blocks = large.image.reshape(30, 4, 40, 4, 3).mean(axis=(1, 3))
    # The rays are the same.
    np.testing.assert_allclose(large.coverage.reshape(30, 4, 40, 4).mean(axis=(1, 3)), small.coverage, atol=1e-6)
    on_object = small.coverage == 1
    np.testing.assert_allclose(small.image[on_object], blocks[on_object], rtol=0, atol=1e-4)
    # The background is sampled at pixel centres: the sky changes by at most 3 over 11 degrees, a pixel has 1.5 degrees.
    np.testing.assert_allclose(small.image, blocks, rtol=0, atol=3.0 * 0.5 * 1.5 / 11.25)


def test_a_sky_finer_than_the_picture_does_not_flicker() -> None:
    """Many stripes of one texel in a pixel give their mean."""
    stripes = np.zeros((512, 1024, 3), np.float32)
    stripes[:, ::2] = 2.0
    view = Camera(np.array([0.0, 0.0, 3.0]), np.zeros(3), np.array([0.0, 1.0, 0.0]), 120.0, 16, 12)
    picture = render_picture(make_asset(ball(2)), stripes, view, samples=16)
    sky = picture.image[picture.coverage == 0]
    assert abs(sky - 1.0).max() < 0.35
    assert render_picture(make_asset(ball(2)), stripes, view, samples=1).image[0].std() > 0.3


def test_without_background_only_the_sky_is_black() -> None:
    asset, sky = make_asset(ball(2)), painted_sky()
    whole, bare = (render_picture(asset, sky, front(), background=with_sky) for with_sky in (True, False))
    on_object, off_object = whole.coverage == 1, whole.coverage == 0
    np.testing.assert_array_equal(whole.image[on_object], bare.image[on_object])
    assert not bare.image[off_object].any()
    assert (whole.image[off_object] > 0).all()


@pytest.mark.parametrize("up", ["y", "z"])
def test_rotating_the_sky_equals_rolling_its_columns(up: str) -> None:
    asset, sky = make_asset(ring(), up=up), painted_sky()
    turned = render_picture(asset, sky, front(), rotate=90.0).image
    rolled = [render_picture(asset, np.roll(sky, columns, axis=1), front()).image for columns in (-8, 8)]
    np.testing.assert_allclose(turned, rolled[0], rtol=0, atol=1e-5)
    assert abs(turned - rolled[1]).max() > 0.1


def test_the_up_axis_of_the_sky_can_be_overridden() -> None:
    sky = painted_sky()
    as_z = render_picture(make_asset(ring(), up="z"), sky, front()).image
    np.testing.assert_array_equal(render_picture(make_asset(ring(), up="y"), sky, front(), up="z").image, as_z)
    assert abs(render_picture(make_asset(ring(), up="y"), sky, front()).image - as_z).max() > 0.1


def test_faces_without_baked_vertices_are_black_and_reported() -> None:
    mesh = ball(3)
    asset = make_asset(mesh, valid=mesh.positions[:, 0] < 0.0)
    picture = render_picture(asset, constant((4.0, 4.0, 4.0)), front())
    whole = render_picture(make_asset(mesh), constant((4.0, 4.0, 4.0)), front())
    inside = whole.coverage == 1
    black = inside & (picture.image == 0).all(axis=2)
    assert picture.unlit == pytest.approx(0.5, abs=0.1)
    assert black.sum() == pytest.approx(0.5 * inside.sum(), rel=0.2)
    assert picture.image[inside & ~black].mean() > 0.8 * whole.image[inside].mean()


@pytest.mark.parametrize(
    ("view", "sentence"),
    [
        (Camera(np.array([0, 0, 4.0]), np.array([0, 0, 9.0]), np.array([0, 1.0, 0]), 45.0, 8, 8), "sees nothing"),
        (front(eye=(0.0, 0.0, 0.5)), "inside the object"),
        (front(8, 8, eye=(0.0, 0.0, 1e6)), "sees nothing of the object"),
    ],
)
def test_cameras_that_show_nothing_are_refused(view: Camera, sentence: str) -> None:
    with pytest.raises(QueryError, match=sentence):
        render_picture(make_asset(ball(2)), constant(), view)


def test_invalid_samples_and_axes_are_refused() -> None:
    with pytest.raises(QueryError, match="samples: expected at least 1"):
        render_picture(make_asset(ball(2)), constant(), front(), samples=0)
    with pytest.raises(QueryError, match="up"):
        render_picture(make_asset(ball(2)), constant(), front(), up="x")


def test_shading_a_picture_loads_no_torch() -> None:
    program = (
        "import sys\n"
        "from tests.shading.test_picture import ball, constant, front, make_asset, render_picture\n"
        "import prt_bake.comparison.metrics, prt_bake.rendering.scene\n"
        "render_picture(make_asset(ball(1)), constant(), front())\n"
        "print('torch' in sys.modules)\n"
    )
    paths = [str(ROOT), *sys.path]
    ran = subprocess.run(
        [sys.executable, "-c", f"import sys; sys.path[:] = {paths!r}\n{program}"],
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert (ran.returncode, ran.stdout.strip()) == (0, "False"), ran.stderr


def test_an_asset_of_another_basis_is_refused() -> None:
    """Check values detect the Condon–Shortley phase, another order and another norm."""
    asset = make_asset(ball(1))
    for change in (
        lambda values: values * np.array([1, -1, 1, -1, 1, -1, 1, -1, 1]),
        lambda values: values[:, [0, 2, 3, 1, 4, 5, 6, 7, 8]],
        lambda values: values * np.sqrt(4 * np.pi),
    ):
        other = dataclasses.replace(asset, check_values=change(asset.check_values))
        with pytest.raises(QueryError, match="of another basis or damaged"):
            shade(other, make_light(), VIEWS[: len(asset.valid)])
