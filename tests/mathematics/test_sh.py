"""Properties of the real harmonics, and a literal table of their signs and order."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import eval_legendre, sph_harm_y

from formats.errors import QueryError
from prt_bake.mathematics import sh, sphere

DEGREE = 20


def directions_with_poles(count: int, seed: int) -> NDArray[np.float64]:
    directions = sphere.uniform(count, seed)
    directions[0], directions[1] = [0, 0, 1], [0, 0, -1]
    return directions


def test_table_to_degree_2() -> None:
    directions = directions_with_poles(50, seed=1)
    x, y, z = directions.T
    table = [
        np.full_like(x, 0.282095),
        0.488603 * y,
        0.488603 * z,
        0.488603 * x,
        1.092548 * x * y,
        1.092548 * y * z,
        0.315392 * (3 * z * z - 1),
        1.092548 * x * z,
        0.546274 * (x * x - y * y),
    ]
    np.testing.assert_allclose(sh.evaluate(directions, 2), np.stack(table, axis=-1), atol=1e-6)


def test_orthonormal_to_degree_20() -> None:
    cos_theta, row_weights = np.polynomial.legendre.leggauss(30)
    phi = 2 * math.pi * (np.arange(60) + 0.25) / 60
    sin_theta = np.sqrt(1 - cos_theta**2)[:, None]
    z = np.broadcast_to(cos_theta[:, None], (30, 60))
    directions = np.stack([sin_theta * np.cos(phi), sin_theta * np.sin(phi), z], axis=-1).reshape(-1, 3)
    harmonics = sh.evaluate(directions, DEGREE)
    weights = np.repeat(row_weights * (2 * math.pi / 60), 60)
    gram = harmonics.T @ (weights[:, None] * harmonics)
    np.testing.assert_allclose(gram, np.eye(sh.count(DEGREE)), atol=1e-12)


def scipy_harmonics(directions: NDArray[np.float64], l: int) -> NDArray[np.float64]:
    """Band `l` [D, 2l + 1] from SciPy's complex harmonics, which include the Condon–Shortley phase."""
    x, y, z = directions.T
    theta, phi = np.arctan2(np.hypot(x, y), z), np.arctan2(y, x)
    band = np.empty((len(directions), 2 * l + 1))
    for m in range(l + 1):
        value = (-1) ** m * (math.sqrt(2) if m else 1) * sph_harm_y(l, m, theta, phi)
        if m:
            band[:, l - m] = value.imag
        band[:, l + m] = value.real
    return band


def test_agrees_with_scipy_at_20_000_directions() -> None:
    directions = directions_with_poles(20_000, seed=2)
    for chunk in np.split(directions, 5):
        harmonics = sh.evaluate(chunk, DEGREE)
        for l in (0, 1, 2, 3, 7, DEGREE):
            error = np.abs(harmonics[:, l * l : (l + 1) ** 2] - scipy_harmonics(chunk, l)).max()
            assert error < 1e-12, f"degree {l}"


def test_agrees_with_scipy_in_every_band() -> None:
    directions = directions_with_poles(1_000, seed=3)
    harmonics = sh.evaluate(directions, DEGREE)
    bands = np.concatenate([scipy_harmonics(directions, l) for l in range(DEGREE + 1)], axis=-1)
    np.testing.assert_allclose(harmonics, bands, rtol=0, atol=1e-12)


def test_addition_theorem() -> None:
    first, second = sphere.uniform(500, 4), sphere.uniform(500, 5)
    products = sh.evaluate(first, DEGREE) * sh.evaluate(second, DEGREE)
    cosine = (first * second).sum(axis=-1)
    for l in range(DEGREE + 1):
        expected = (2 * l + 1) / (4 * math.pi) * eval_legendre(l, cosine)
        np.testing.assert_allclose(products[:, l * l : (l + 1) ** 2].sum(axis=-1), expected, atol=1e-12)


def test_parity_follows_the_degree() -> None:
    directions = sphere.uniform(100, 6)
    sign = np.repeat((-1.0) ** np.arange(DEGREE + 1), 2 * np.arange(DEGREE + 1) + 1)
    np.testing.assert_array_equal(sh.evaluate(-directions, DEGREE), sign * sh.evaluate(directions, DEGREE))


def test_leading_axes_are_preserved_and_a_lower_degree_is_a_prefix() -> None:
    directions = sphere.uniform(24, 7).reshape(2, 3, 4, 3)
    harmonics = sh.evaluate(directions, 5)
    assert harmonics.shape == (2, 3, 4, 36)
    np.testing.assert_array_equal(sh.evaluate(directions[1, 2, 3], 2), harmonics[1, 2, 3, :9])


def test_float32_directions_are_normalised() -> None:
    directions = sphere.uniform(100, 8).astype(np.float32)
    unit = directions / np.linalg.norm(directions.astype(np.float64), axis=-1, keepdims=True)
    np.testing.assert_allclose(sh.evaluate(directions, DEGREE), sh.evaluate(unit, DEGREE), atol=1e-12)


@pytest.mark.parametrize("wrong", [[0, 0, 2.0], [0, 0, 0], [0, np.nan, 1]])
def test_non_unit_directions_are_refused_with_count_and_index(wrong: list[float]) -> None:
    directions = sphere.uniform(10, 9)
    directions[[4, 7]] = wrong
    with pytest.raises(QueryError, match=r"found 2 .* at index \[4\]"):
        sh.evaluate(directions, 1)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_rotation_law(seed: int) -> None:
    matrix = sphere.random_rotations(1, seed)[0]
    directions = directions_with_poles(500, seed)
    matrix_of_harmonics = sh.rotation(matrix, DEGREE)
    difference = sh.evaluate(directions @ matrix.T, DEGREE) - sh.evaluate(directions, DEGREE) @ matrix_of_harmonics.T
    assert np.abs(difference).max() < 1e-12
    np.testing.assert_allclose(matrix_of_harmonics @ matrix_of_harmonics.T, np.eye(sh.count(DEGREE)), atol=1e-13)


def test_rotations_compose_and_invert() -> None:
    first, second = sphere.random_rotations(2, 10)
    composed = sh.rotation(first, 8) @ sh.rotation(second, 8)
    np.testing.assert_allclose(sh.rotation(first @ second, 8), composed, atol=1e-13)
    np.testing.assert_allclose(sh.rotation(first.T, 8), sh.rotation(first, 8).T, atol=1e-13)


def test_first_band_rotates_like_a_vector() -> None:
    matrix = sphere.random_rotations(1, 11)[0]
    y_z_x = [1, 2, 0]
    np.testing.assert_allclose(sh.rotation(matrix, 1)[1:, 1:], matrix[np.ix_(y_z_x, y_z_x)], atol=1e-15)


def test_reflections_obey_the_rotation_law() -> None:
    mirror = np.diag([1.0, -1.0, 1.0])
    directions = sphere.uniform(100, 12)
    expected = sh.evaluate(directions, 6) @ sh.rotation(mirror, 6).T
    np.testing.assert_allclose(sh.evaluate(directions @ mirror.T, 6), expected, atol=1e-13)


@pytest.mark.parametrize("matrix", [np.eye(2), 2 * np.eye(3), np.full((3, 3), np.nan)])
def test_non_orthogonal_matrices_are_refused(matrix: NDArray[np.float64]) -> None:
    with pytest.raises(QueryError, match="rotation: expected"):
        sh.rotation(matrix, 2)


def test_counts_and_degrees() -> None:
    assert [sh.count(degree) for degree in range(4)] == [1, 4, 9, 16]
    assert [sh.degree_of(sh.count(degree)) for degree in range(30)] == list(range(30))
    for count in (0, -1, 8, 10):
        with pytest.raises(QueryError, match="square"):
            sh.degree_of(count)
    with pytest.raises(QueryError, match="degree"):
        sh.count(-1)
