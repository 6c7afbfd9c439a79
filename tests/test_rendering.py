"""Path-traced pictures: what is known of them exactly, and how honest their error is."""

import math
from pathlib import Path

import numpy as np
import pytest
from shapes import ball

from formats.errors import QueryError
from formats.mesh import write_mesh
from formats.scene import Scene, read_scene
from prt_bake.camera import Camera
from prt_bake.rendering import Rendering, render_scene

WHITE = np.ones((8, 16, 3), np.float32)


def make_scene(folder: Path, albedo: str = "1.0", eta: float = 1.0, roughness: float = 0.0) -> Scene:
    write_mesh(ball(3), folder / "ball.ply")
    (folder / "ball.toml").write_text(
        f'[object]\nmesh = "ball.ply"\n[interface]\neta = {eta}\nroughness = {roughness}\n'
        f"[medium]\nsigma_t = 3.0\nalbedo = {albedo}\nphase_g = 0.4\n"
    )
    return read_scene(folder / "ball.toml")


def front(eye=(0.0, 0.0, 4.0), size=16) -> Camera:
    return Camera(np.array(eye), np.zeros(3), np.array([0.0, 1.0, 0.0]), 40.0, size, size)


def uneven_sky() -> np.ndarray:
    return np.random.default_rng(3).random((16, 32, 3)).astype(np.float32) ** 3


def z_score(one: Rendering, other: Rendering) -> float:
    """Of the mean over pixels of the squared difference, which should be the sum of the variances that both state."""
    inside = (one.coverage == 1) & (other.coverage == 1)
    stated = one.standard_error[inside].astype(np.float64) ** 2 + other.standard_error[inside].astype(np.float64) ** 2
    seen = (one.image[inside].astype(np.float64) - other.image[inside]) ** 2
    excess = (seen - stated).mean(axis=1)  # channels share their walks
    return float(excess.mean() / (excess.std(ddof=1) / math.sqrt(len(excess))))


def test_a_white_furnace_cannot_be_seen(tmp_path: Path) -> None:
    """Index-matched, nothing absorbed, a constant sky: radiance 1 on the object, beside it and across its edge."""
    picture = render_scene(make_scene(tmp_path), WHITE, front(), spp=16)
    assert 0.2 < picture.coverage.mean() < 0.9
    np.testing.assert_allclose(picture.image, 1.0, rtol=0, atol=1e-6)
    np.testing.assert_allclose(picture.standard_error, 0.0, rtol=0, atol=1e-6)


def test_behind_a_smooth_interface_what_is_reflected_is_missing(tmp_path: Path) -> None:
    """Radiance 1 − F(cosθ): at the middle of the ball, by Fresnel's equations at normal incidence."""
    picture = render_scene(make_scene(tmp_path, eta=1.5), WHITE, front(size=15), spp=256)
    expected = 1.0 - (0.5 / 2.5) ** 2
    middle, error = picture.image[7, 7], picture.standard_error[7, 7]
    assert (np.abs(middle - expected) < 4 * error + 1e-3).all()
    assert picture.image[picture.coverage == 1].max() < 1.0
    np.testing.assert_array_equal(picture.image[picture.coverage == 0], 1.0)


def test_two_seeds_differ_by_what_their_errors_say(tmp_path: Path) -> None:
    scene, sky = make_scene(tmp_path, "[0.9, 0.7, 0.5]"), uneven_sky()
    pictures = [render_scene(scene, sky, front(size=24), spp=64, seed=seed) for seed in (1, 2, 3, 4)]
    assert abs(z_score(pictures[0], pictures[1])) < 4
    assert abs(z_score(pictures[2], pictures[3])) < 4


def test_more_walks_halve_the_error(tmp_path: Path) -> None:
    scene, sky = make_scene(tmp_path, "0.8"), uneven_sky()
    few, many = (render_scene(scene, sky, front(), spp=spp) for spp in (32, 128))
    inside = few.coverage == 1
    ratio = np.mean(many.standard_error[inside] ** 2) / np.mean(few.standard_error[inside] ** 2)
    assert ratio == pytest.approx(0.25, rel=0.1)
    assert many.walks == pytest.approx(4 * few.walks, rel=0.02)


def test_a_picture_depends_on_its_seed_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene, sky = make_scene(tmp_path, "0.8"), uneven_sky()
    one = render_scene(scene, sky, front(), spp=16, seed=5)
    monkeypatch.setattr("prt_bake.render_pass._RAYS_AT_ONCE", 16 * 16 * 3)
    told: list[float] = []
    again = render_scene(scene, sky, front(), spp=16, seed=5, progress=told.append)
    other = render_scene(scene, sky, front(), spp=16, seed=6)
    np.testing.assert_array_equal(again.image, one.image)
    np.testing.assert_array_equal(again.standard_error, one.standard_error)
    assert told[-1] == 1.0
    assert (other.image != one.image).any()


def test_turning_the_sky_is_rolling_its_columns(tmp_path: Path) -> None:
    scene, sky = make_scene(tmp_path, "0.8"), uneven_sky()
    turned = render_scene(scene, sky, front(), spp=16, rotate=90.0)
    rolled = render_scene(scene, np.roll(sky, -8, axis=1), front(), spp=16)
    np.testing.assert_allclose(turned.image, rolled.image, rtol=0, atol=1e-5)


def test_turning_sky_and_eye_leaves_a_ball_as_it_was(tmp_path: Path) -> None:
    """A quarter turn takes the mesh to itself: other walks, the same picture within the errors of both."""
    scene, sky = make_scene(tmp_path, "0.8"), uneven_sky()
    sky[:, :8] += 3.0
    still = render_scene(scene, sky, front(size=24), spp=64, seed=1)
    turned = render_scene(scene, sky, front((4.0, 0.0, 0.0), 24), spp=64, seed=2, rotate=90.0)
    unturned = render_scene(scene, sky, front((4.0, 0.0, 0.0), 24), spp=64, seed=2)
    assert abs(z_score(still, turned)) < 4
    assert z_score(still, unturned) > 6


def test_without_background_the_sky_is_black(tmp_path: Path) -> None:
    picture = render_scene(make_scene(tmp_path), WHITE, front(), spp=16, background=False)
    np.testing.assert_allclose(picture.image, np.repeat(picture.coverage[..., None], 3, axis=2), rtol=0, atol=1e-6)


def test_what_makes_no_picture_is_refused(tmp_path: Path) -> None:
    scene = make_scene(tmp_path)
    with pytest.raises(QueryError, match="spp: 1 "):
        render_scene(scene, WHITE, front(), spp=1)
    with pytest.raises(QueryError, match="inside the object"):
        render_scene(scene, WHITE, front((0.0, 0.0, 0.5)))
    with pytest.raises(QueryError, match="up"):
        render_scene(scene, WHITE, front(), up="x")
