"""Sets of directions: unit length, dependence on the seed, uniformity, and unbiasedness under random rotations."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2

from formats.errors import QueryError
from prt_bake.mathematics import sh, sphere

FALSE_ALARM = 1e-6  # probability that a correct set fails with a random seed


def on_square(directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """(1 − z)/2 and φ/2π in [0, 1): uniform on the square if and only if the directions are uniform on the sphere."""
    x, y, z = np.moveaxis(directions, -1, 0)
    return np.stack([(1 - z) / 2, np.arctan2(y, x) / (2 * math.pi) % 1], axis=-1)


def assert_uniform(directions: NDArray[np.float64], cells: int = 12) -> None:
    square = on_square(directions)
    counts = np.histogram2d(square[:, 0], square[:, 1], bins=cells, range=[[0, 1], [0, 1]])[0]
    expected = len(directions) / counts.size
    assert expected > 20
    assert ((counts - expected) ** 2 / expected).sum() < chi2.isf(FALSE_ALARM, counts.size - 1)


@pytest.mark.parametrize(
    "directions", [sphere.uniform(1_000, 1), sphere.sobol(1_000, 1), sphere.fibonacci(1_000), sphere.fibonacci(1)]
)
def test_directions_are_unit(directions: NDArray[np.float64]) -> None:
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1, atol=1e-15)


@pytest.mark.parametrize("draw", [sphere.uniform, sphere.sobol, sphere.random_rotations])
def test_sets_depend_on_seed_and_index_alone(draw: Callable[[int, int], NDArray[np.float64]]) -> None:
    np.testing.assert_array_equal(draw(40, 3), draw(64, 3)[:40])
    assert not np.isclose(draw(40, 3), draw(40, 4)).all(axis=tuple(range(1, draw(1, 3).ndim))).any()


def test_uniform_directions_are_uniform() -> None:
    assert_uniform(sphere.uniform(50_000, 2))


def test_uniform_directions_have_the_moments_of_the_sphere() -> None:
    directions = sphere.uniform(100_000, 3)
    # Four sigma of the means of x and of xy: variances 1/3 and 1/15.
    assert np.abs(directions.mean(axis=0)).max() < 4 * math.sqrt(1 / 3 / 100_000)
    second = directions.T @ directions / 100_000
    assert np.abs(second - np.eye(3) / 3).max() < 4 * math.sqrt(4 / 45 / 100_000)


def test_each_sobol_direction_is_uniform_over_seeds() -> None:
    drawn = np.stack([sphere.sobol(4, seed) for seed in range(1_400)])
    for index in range(4):
        assert_uniform(drawn[:, index], cells=8)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_scrambled_sobol_is_a_net(seed: int) -> None:
    # A (0, 6, 2)-net: each of the 64 boxes of every dyadic partition of the square holds one point of 64.
    square = on_square(sphere.sobol(64, seed))
    for bits in range(7):
        rows, columns = 2**bits, 2 ** (6 - bits)
        cells = np.floor(square[:, 0] * rows) * columns + np.floor(square[:, 1] * columns)
        assert np.unique(cells).size == 64


@pytest.mark.parametrize("count", [1, 2, 16, 64, 333])
def test_lattice_rows_have_equal_height_and_advance_by_the_golden_angle(count: int) -> None:
    square = on_square(sphere.fibonacci(count))
    np.testing.assert_allclose(square[:, 0], (np.arange(count) + 0.5) / count, atol=1e-14)
    steps = np.diff(square[:, 1]) % 1
    np.testing.assert_allclose(steps, 2 / (1 + math.sqrt(5)), atol=1e-12)


def test_lattice_integrates_low_degrees_far_better_than_random_directions() -> None:
    count = 2_048
    sums = 4 * math.pi / count * sh.evaluate(sphere.fibonacci(count), 6).sum(axis=0)
    sums[0] -= math.sqrt(4 * math.pi)
    chance = math.sqrt(4 * math.pi / count)
    assert np.abs(sums).max() < chance / 50


def test_rotations_are_proper_and_orthogonal() -> None:
    rotations = sphere.random_rotations(500, 4)
    np.testing.assert_allclose(rotations @ np.swapaxes(rotations, 1, 2), np.eye(3)[None].repeat(500, 0), atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(rotations), 1, atol=1e-14)


def test_rotated_axes_are_uniform() -> None:
    rotations = sphere.random_rotations(40_000, 5)
    for axis in np.eye(3):
        assert_uniform(rotations @ axis)
        assert_uniform(np.swapaxes(rotations, 1, 2) @ axis)


def test_rotation_angles_have_the_density_of_the_haar_measure() -> None:
    rotations = sphere.random_rotations(40_000, 6)
    angle = np.arccos(np.clip((np.trace(rotations, axis1=1, axis2=2) - 1) / 2, -1, 1))
    # The density (1 − cos ω)/π integrates to (ω − sin ω)/π, which is uniform.
    counts = np.histogram((angle - np.sin(angle)) / math.pi, bins=50, range=(0, 1))[0]
    expected = len(angle) / 50
    assert ((counts - expected) ** 2 / expected).sum() < chi2.isf(FALSE_ALARM, 49)


def test_rotated_lattice_is_unbiased() -> None:
    """A fixed lattice of 16 directions errs for degrees 1 to 8; the mean over random rotations does not."""
    lattice, rotations = sphere.fibonacci(16), sphere.random_rotations(3_000, 7)
    harmonics = sh.evaluate(np.einsum("rij,dj->rdi", rotations, lattice), 8)
    estimates = 4 * math.pi / 16 * harmonics.sum(axis=1)
    fixed = 4 * math.pi / 16 * sh.evaluate(lattice, 8).sum(axis=0)
    assert np.abs(fixed[1:]).max() > 0.1
    np.testing.assert_allclose(estimates[:, 0], math.sqrt(4 * math.pi), atol=1e-12)
    deviation = estimates[:, 1:].mean(axis=0)
    sigma = estimates[:, 1:].std(axis=0, ddof=1) / math.sqrt(len(rotations))
    # 80 two-sided normal tests at five sigma: false alarm below 5e-5.
    assert (np.abs(deviation) < 5 * sigma).all()


def test_sets_with_equal_seeds_are_independent() -> None:
    directions, rotations = sphere.uniform(20_000, 8), sphere.random_rotations(20_000, 8)
    for column in range(3):
        correlation = (directions * rotations[:, :, column]).sum(axis=-1).mean()
        assert abs(correlation) < 5 * math.sqrt(1 / 3 / 20_000)


@pytest.mark.parametrize("count", [0, -3])
def test_empty_sets_are_refused(count: int) -> None:
    with pytest.raises(QueryError, match="expected 1 or more"):
        sphere.fibonacci(count)
    for draw in (sphere.uniform, sphere.sobol, sphere.random_rotations):
        with pytest.raises(QueryError, match="expected 1 or more"):
            draw(count, 0)
