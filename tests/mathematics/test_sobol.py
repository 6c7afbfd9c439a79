"""Scrambled Sobol points: each is uniform, together they form a net, and they do not depend on the batch."""

import numpy as np
import pytest

from prt_bake.mathematics.sobol import sobol_points
from tests.mathematics.sampling import assert_counts_follow, assert_mean_is


@pytest.fixture(scope="module")
def numbers() -> np.ndarray:
    return sobol_points(np.arange(16), (3, np.arange(20_000)))


def test_sixteen_points_fill_every_elementary_interval_once(numbers: np.ndarray) -> None:
    """All shapes of intervals in the first two dimensions, the square ones in the others."""
    for first, second, shapes in ((0, 1, (1, 2, 4, 8, 16)), (0, 2, (4,)), (1, 2, (4,))):
        for rows in shapes:
            x, y = numbers[..., first] * rows, numbers[..., second] * (16 // rows)
            box = x.astype(int) * (16 // rows) + y.astype(int)
            np.testing.assert_array_equal(np.sort(box, axis=1), np.broadcast_to(np.arange(16), box.shape))


def test_each_point_is_uniform_in_the_cube(numbers: np.ndarray) -> None:
    assert numbers.min() >= 0
    assert numbers.max() < 1
    for member in (0, 7):
        for dimension in range(3):
            counts = np.histogram(numbers[:, member, dimension], bins=64, range=(0, 1))[0]
            assert_counts_follow(counts, np.full(64, 1 / 64))
        cube = np.histogramdd(numbers[:, member], bins=6, range=[(0, 1)] * 3)[0]
        assert_counts_follow(cube.ravel(), np.full(216, 1 / 216))
    # The lowest bits are random too.
    assert_mean_is((numbers[:, 3, 0] * 2**40) % 1.0, 0.5)


def test_means_are_unbiased_and_converge_faster_than_random_numbers(numbers: np.ndarray) -> None:
    value = np.exp(numbers[..., 0] + numbers[..., 1] * numbers[..., 2])
    means = value.mean(axis=1)
    # (e − 1) · Σ 1 / (k! (k + 1)²)
    assert_mean_is(means, (np.e - 1) * 1.3179021514544038)
    assert means.std() < 0.25 * value.std() / 4


def test_points_depend_on_their_key_alone(numbers: np.ndarray) -> None:
    part = sobol_points(np.array([5, 2]), (3, np.arange(100, 200)))
    np.testing.assert_array_equal(part, numbers[100:200, [5, 2]])
    assert (sobol_points(np.arange(16), (4, np.arange(50)))[:, 0] != numbers[:50, 0]).all()
