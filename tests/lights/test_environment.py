"""Environments: exact projection of pixels, the lat-long convention, rotation, look-up, bad pixels."""

import math
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from formats.errors import ImageError, QueryError
from formats.image import write_image
from formats.image.rows import rows_of
from prt_bake.lights import environment
from prt_bake.lights.skies import pixels
from prt_bake.mathematics import sh, sphere

UPS = ["y", "z"]


def random_sky(height: int, width: int, seed: int) -> NDArray[np.float64]:
    """Noise over four orders of magnitude, independent in each channel."""
    return 10 ** np.random.default_rng(seed).uniform(-2, 2, size=(height, width, 3))


def centres(height: int, width: int, up: str = "y") -> NDArray[np.float64]:
    v, u = np.meshgrid((np.arange(height) + 0.5) / height, (np.arange(width) + 0.5) / width, indexing="ij")
    return environment.direction_of(u, v, up)


def projected_by_brute_force(image: NDArray[np.float64], degree: int, up: str) -> NDArray[np.float64]:
    """Σ over pixels of radiance times the harmonics integrated by 48×48 Gauss nodes."""
    height, width = image.shape[:2]
    nodes, weights = np.polynomial.legendre.leggauss(48)
    coefficients = np.zeros((sh.count(degree), 3))
    for row in range(height):
        for column in range(width):
            v, u = np.meshgrid((row + 0.5 + nodes / 2) / height, (column + 0.5 + nodes / 2) / width, indexing="ij")
            solid_angle = (
                np.outer(weights, weights) / 4 * (2 * math.pi / width) * (math.pi / height) * np.sin(math.pi * v)
            )
            harmonics = sh.evaluate(environment.direction_of(u, v, up), degree)
            coefficients += np.outer(np.einsum("ij,ijk->k", solid_angle, harmonics), image[row, column])
    return coefficients


def area_means(image: NDArray[np.float64], factor: int) -> NDArray[np.float64]:
    """Means over factor × factor pixels, weighted by solid angle, which keep the flux."""
    height, width = image.shape[:2]
    edges = np.cos(math.pi * np.arange(height + 1) / height)
    areas = (edges[:-1] - edges[1:])[:, None, None]
    blocks = (image * areas).reshape(height // factor, factor, width // factor, factor, 3).sum(axis=(1, 3))
    return np.asarray(blocks / (areas.reshape(height // factor, factor).sum(axis=1)[:, None, None] * factor))


def test_the_lat_long_convention() -> None:
    """The centre of the picture is +x, row 0 is up, +z is to the right."""
    places = {(0.5, 0.5): (1, 0, 0), (0.75, 0.5): (0, 0, 1), (0.25, 0.5): (0, 0, -1), (0.0, 0.5): (-1, 0, 0)}
    places |= {(0.5, 0.0): (0, 1, 0), (0.5, 1.0): (0, -1, 0)}
    for (u, v), (x, y, z) in places.items():
        np.testing.assert_allclose(environment.direction_of(u, v), [x, y, z], atol=1e-15)
        np.testing.assert_allclose(environment.direction_of(u, v, up="z"), [x, -z, y], atol=1e-15)


@pytest.mark.parametrize("up", UPS)
def test_uv_and_directions_are_inverse(up: str) -> None:
    u, v = np.random.default_rng(1).random((2, 1_000))
    found_u, found_v = environment.pixel_of(environment.direction_of(u, v, up), up)
    np.testing.assert_allclose(found_u, u, atol=1e-12)
    np.testing.assert_allclose(found_v, v, atol=1e-12)
    behind = environment.pixel_of([[-1.0, 0.0, 0.0], [-1.0, -0.0, -0.0]], up)[0]
    np.testing.assert_array_equal(behind, 0)


@pytest.mark.parametrize("up", UPS)
@pytest.mark.parametrize(("height", "width"), [(512, 1024), (1, 1), (1, 2), (2, 1), (3, 5), (7, 1)])
@pytest.mark.parametrize("degree", [0, 2, 20])
def test_a_constant_sky_has_only_the_first_coefficient(up: str, height: int, width: int, degree: int) -> None:
    expected = np.zeros((sh.count(degree), 3))
    expected[0] = math.sqrt(4 * math.pi)
    found = environment.project(np.ones((height, width, 3), np.float32), degree, up)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("up", UPS)
@pytest.mark.parametrize(("height", "width"), [(1, 1), (1, 2), (2, 1), (3, 5), (6, 8)])
def test_every_pixel_is_integrated_exactly(up: str, height: int, width: int) -> None:
    image = np.random.default_rng(2).random((height, width, 3))
    expected = projected_by_brute_force(image, 8, up)
    np.testing.assert_allclose(environment.project(image, 8, up), expected, rtol=0, atol=1e-12)


def test_hemispheres_have_their_analytic_coefficients() -> None:
    # Over a hemisphere about an axis ∫ Y_00 = √π and ∫ 0.488603 cosθ = √(3π)/2; the right half is about +z.
    right = np.zeros((1, 2, 3))
    right[:, 1] = 1
    expected = np.array([math.sqrt(math.pi), 0, math.sqrt(3 * math.pi) / 2, 0])
    np.testing.assert_allclose(environment.project(right, 1)[:, 0], expected, atol=1e-14)
    top = np.zeros((2, 1, 3))
    top[0] = 1
    expected = np.array([math.sqrt(math.pi), math.sqrt(3 * math.pi) / 2, 0, 0])
    np.testing.assert_allclose(environment.project(top, 1)[:, 0], expected, atol=1e-14)


@pytest.mark.parametrize("up", UPS)
def test_a_sky_of_one_harmonic_has_that_coefficient(up: str) -> None:
    """Sampled at pixel centres the error is of second order in the pixel; Richardson extrapolation removes it."""
    degree = 4
    found = []
    for height in (64, 128):
        painted = sh.evaluate(centres(height, 2 * height, up), degree)
        columns = [environment.project(np.repeat(painted[..., k, None], 3, -1), degree, up)[:, 0] for k in range(25)]
        found.append(np.stack(columns, axis=-1))
    coarse, fine = (np.abs(gram - np.eye(25)).max() for gram in found)
    # |∇²Y| = l(l+1) |Y|: the mean over a pixel of size Δ is below the centre's value by l(l+1)Δ²/24 of it.
    assert fine < degree * (degree + 1) * (math.pi / 128) ** 2 / 12
    assert coarse / fine == pytest.approx(4, rel=0.02)
    np.testing.assert_allclose((4 * found[1] - found[0]) / 3, np.eye(25), rtol=0, atol=1e-6)


def test_the_azimuthal_integral_of_pixels_is_exact() -> None:
    """Pixels of cos mφ carry sin(mΔ/2)/(mΔ/2) of it; nothing leaks into other orders."""
    width, m = 24, 3
    row = np.cos(m * 2 * math.pi * ((np.arange(width) + 0.5) / width - 0.5))
    found = environment.project(np.broadcast_to(row[None, :, None], (1, width, 3)), 6, up="z")[:, 0]
    # Order m of the degrees m and m + 2 (the others are odd in z). Cosines are even in φ.
    damping = math.sin(m * math.pi / width) / (m * math.pi / width)
    cos_theta, weights = np.polynomial.legendre.leggauss(200)
    meridian = np.stack([np.sqrt(1 - cos_theta**2), np.zeros(200), cos_theta], axis=-1)
    zenith = weights @ sh.evaluate(meridian, 6)
    expected = np.zeros(49)
    for l in (3, 5):
        expected[l * (l + 1) + m] = math.pi * damping * zenith[l * (l + 1) + m]
    np.testing.assert_allclose(found, expected, atol=1e-6)
    assert abs(expected[15]) > 0.5


def test_the_error_of_resolution_is_within_its_bound() -> None:
    """If large pixels keep their flux, |b − b'| is at most max |∇Y| times half a diagonal times ∫ |L − L'|."""
    fine = random_sky(512, 1024, seed=3)
    fine[100:104, 300:304] = 1e5
    coarse = area_means(fine, 8)
    degree = 3
    difference = np.abs(environment.project(fine, degree) - environment.project(coarse, degree))
    edges = np.cos(math.pi * np.arange(513) / 512)
    areas = (edges[:-1] - edges[1:])[:, None, None] * 2 * math.pi / 1024
    step_change = (np.abs(fine - np.kron(coarse, np.ones((8, 8, 1)))) * areas).sum(axis=(0, 1))
    half_diagonal = math.hypot(math.pi / 64, math.pi / 64) / 2
    l = np.repeat(np.arange(degree + 1), 2 * np.arange(degree + 1) + 1)
    steepest = np.sqrt(l * (l + 1) * (2 * l + 1) / (4 * math.pi))
    scale = np.abs(environment.project(fine, degree)).max()
    assert (difference <= steepest[:, None] * half_diagonal * step_change + 1e-12 * scale).all()
    assert difference[0].max() < 1e-12 * scale


def test_resolutions_of_a_smooth_sky_agree_to_second_order() -> None:
    light = np.random.default_rng(4).normal(size=(16, 3))
    sky = sh.evaluate(centres(512, 1024), 3) @ light
    exact = environment.project(sky, 3)
    errors = [np.abs(environment.project(area_means(sky, factor), 3) - exact).max() for factor in (8, 16)]
    assert errors[0] < 3 * 4 * (math.pi / 64) ** 2 / 12 * np.abs(exact).max()
    assert errors[1] / errors[0] == pytest.approx(4, rel=0.05)


@pytest.mark.parametrize("degree", [2, 10])
def test_up_z_is_up_y_rotated(degree: int) -> None:
    image = random_sky(16, 32, seed=5)
    to_z = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    np.testing.assert_array_equal(to_z @ [1, 2, 3], [1, -3, 2])
    expected = sh.rotation(to_z, degree) @ environment.project(image, degree, up="y")
    np.testing.assert_allclose(environment.project(image, degree, up="z"), expected, rtol=0, atol=1e-11)


@pytest.mark.parametrize("up", UPS)
def test_rotation_is_counter_clockwise_seen_from_above(up: str) -> None:
    axis, right = {"y": ([0, 1, 0], [0, 0, -1]), "z": ([0, 0, 1], [0, 1, 0])}[up]
    turn = environment.rotation(90, up)
    np.testing.assert_allclose(turn @ axis, axis, atol=1e-15)
    np.testing.assert_allclose(turn @ [1, 0, 0], right, atol=1e-15)
    np.testing.assert_allclose(environment.rotation(30, up) @ environment.rotation(60, up), turn, atol=1e-15)


@pytest.mark.parametrize("up", UPS)
def test_rotated_light_is_the_light_of_the_rolled_picture(up: str) -> None:
    """L'(d) = L(R⁻¹ d): a rotation by 360 k/W moves every column k to the left, exactly."""
    image = random_sky(8, 24, seed=6)
    light = environment.project(image, 5, up)
    scale = np.abs(light).max()
    for columns in (1, 7, -5):
        turned = environment.rotate_light(light, 360 * columns / 24, up)
        rolled = environment.project(np.roll(image, -columns, axis=1), 5, up)
        np.testing.assert_allclose(turned, rolled, rtol=0, atol=1e-13 * scale)


@pytest.mark.parametrize("up", UPS)
def test_radiance_of_rotated_light(up: str) -> None:
    light = np.random.default_rng(7).normal(size=(16, 3))
    directions = sphere.uniform(100, 8)
    turned = sh.evaluate(directions, 3) @ environment.rotate_light(light, 77.0, up)
    undone = directions @ environment.rotation(77.0, up)
    np.testing.assert_allclose(turned, sh.evaluate(undone, 3) @ light, atol=1e-12)


def test_projection_is_linear_and_does_not_change_its_input() -> None:
    first, second = random_sky(6, 9, seed=9), random_sky(6, 9, seed=10)
    kept = first.copy()
    together = environment.project(2 * first - second)
    np.testing.assert_allclose(together, 2 * environment.project(first) - environment.project(second), atol=1e-11)
    np.testing.assert_array_equal(first, kept)


def test_the_size_of_blocks_does_not_matter(monkeypatch: pytest.MonkeyPatch) -> None:
    image = random_sky(37, 20, seed=11)
    whole = environment.project(image, 6)
    for size in (1, 50_000):
        monkeypatch.setattr(environment, "BLOCK_BYTES", size)
        np.testing.assert_allclose(environment.project(image, 6), whole, rtol=0, atol=1e-11)


def test_temporary_memory_does_not_grow_with_the_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(environment, "BLOCK_BYTES", 1 << 18)
    image = np.ones((1024, 1024, 3), np.float32)
    environment.project(image)
    tracemalloc.start()
    environment.project(image)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 4 * (1 << 18)


@pytest.mark.parametrize("up", UPS)
def test_lookup_at_a_pixel_centre_gives_that_pixel(up: str) -> None:
    image = random_sky(7, 12, seed=12)
    np.testing.assert_allclose(environment.lookup(image, centres(7, 12, up), up), image, rtol=1e-11)


def test_lookup_wraps_around_and_is_constant_at_the_poles() -> None:
    image = random_sky(4, 8, seed=13)
    seam = environment.lookup(image, environment.direction_of(0.0, (np.arange(4) + 0.5) / 4))
    np.testing.assert_allclose(seam, (image[:, 0] + image[:, -1]) / 2, rtol=1e-11)
    columns = (np.arange(8) + 0.5) / 8
    for v, row in ((0.01, 0), (0.99, -1)):
        np.testing.assert_allclose(
            environment.lookup(image, environment.direction_of(columns, v)), image[row], rtol=1e-11
        )


@pytest.mark.parametrize("up", UPS)
def test_lookup_and_projection_share_one_convention(up: str) -> None:
    """A smooth sky, projected and evaluated again, equals its look-up to second order in the pixel."""
    light = np.random.default_rng(14).normal(size=(9, 3))
    sky = sh.evaluate(centres(128, 256, up), 2) @ light
    directions = sphere.uniform(2_000, 15)
    directions = directions[np.abs(directions @ (np.eye(3)[1] if up == "y" else np.eye(3)[2])) < 0.99]
    seen = environment.lookup(sky, directions, up)
    rebuilt = sh.evaluate(directions, 2) @ environment.project(sky, 2, up)
    np.testing.assert_allclose(seen, rebuilt, atol=2e-3)
    np.testing.assert_allclose(seen, sh.evaluate(directions, 2) @ light, atol=2e-3)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_projection_refuses_pixels_that_are_not_finite(value: float) -> None:
    image = random_sky(4, 8, seed=16)
    image[2, 5, 1] = image[3, 0] = value
    with pytest.raises(ImageError, match=r"2 of 32 pixels .* row 2, column 5"):
        environment.project(image)


@pytest.mark.parametrize("shape", [(4, 8), (4, 8, 4), (0, 8, 3), (3,)])
def test_arrays_of_another_shape_are_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(ImageError, match=r"expected numbers \[H, W, 3\]"):
        environment.project(np.zeros(shape))


def test_unknown_axes_and_degrees_are_refused() -> None:
    image = np.zeros((2, 2, 3))
    with pytest.raises(QueryError, match='expected "y" or "z", found \'x\''):
        environment.project(image, up="x")
    with pytest.raises(QueryError, match="degree"):
        environment.project(image, degree=-1)
    with pytest.raises(QueryError, match='expected "y" or "z"'):
        environment.rotate_light(np.zeros((9, 3)), 10, up="x")
    with pytest.raises(QueryError, match="square"):
        environment.rotate_light(np.zeros((8, 3)), 10)


def spoiled_sky() -> NDArray[np.float32]:
    image = random_sky(4, 8, seed=17).astype(np.float32)
    image[1, 6] = [0.5, np.nan, 2.0]
    image[2, 0, 0] = np.inf
    image[3, 7] = [-1.0, -2.0, 0.0]
    return image


def test_a_file_with_bad_pixels_is_refused_with_their_number_and_position(tmp_path: Path) -> None:
    path = tmp_path / "spoiled.exr"
    write_image(path, spoiled_sky())
    with pytest.raises(ImageError) as refusal:
        environment.read_environment(path)
    sentence = str(refusal.value)
    assert "spoiled.exr" in sentence
    assert "3 of 32 pixels" in sentence
    assert "1 NaN, 1 infinite, 2 negative" in sentence
    assert "row 1, column 6: (0.5, nan, 2)" in sentence


def test_repairs_are_reported(tmp_path: Path) -> None:
    path = tmp_path / "spoiled.exr"
    image = spoiled_sky()
    write_image(path, image)
    messages: list[str] = []
    repaired = environment.read_environment(path, mend=True, say=messages.append)
    largest = image[np.isfinite(image)].max()
    expected = image.copy()
    expected[1, 6, 1], expected[2, 0, 0], expected[3, 7] = 0, largest, 0
    np.testing.assert_array_equal(repaired, expected)
    assert len(messages) == 1
    for words in ("spoiled.exr", "4 values", "1 NaN, 2 negative set to 0", f"1 infinite set to {largest:g}"):
        assert words in messages[0]
    with pytest.warns(UserWarning, match="repaired 4 values"):
        environment.read_environment(path, mend=True)


def test_a_sound_picture_is_unchanged_and_nothing_is_reported(tmp_path: Path) -> None:
    path = tmp_path / "sound.exr"
    image = random_sky(4, 8, seed=18).astype(np.float32)
    write_image(path, image)
    messages: list[str] = []
    np.testing.assert_array_equal(environment.read_environment(path, mend=True, say=messages.append), image)
    np.testing.assert_array_equal(environment.read_environment(path), image)
    assert messages == []


def test_a_picture_without_any_finite_radiance_becomes_black() -> None:
    messages: list[str] = []
    image = np.array([[[np.nan, np.inf, -np.inf]]])
    np.testing.assert_array_equal(pixels.repaired(rows_of(image), messages.append).read(), np.zeros((1, 1, 3)))
    assert "repaired 3 values" in messages[0]
