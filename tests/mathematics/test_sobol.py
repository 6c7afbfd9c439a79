"""Numbers that lie evenly: each uniform, all together a net, and the same in any batch."""

import numpy as np
import pytest

from prt_bake.mathematics.sobol import even_numbers
from tests.mathematics.sampling import assert_counts_follow, assert_mean_is


@pytest.fixture(scope="module")
def numbers() -> np.ndarray:
    return even_numbers(np.arange(16), (3, np.arange(20_000)))


def test_sixteen_of_them_fill_every_box_of_a_sixteenth_once(numbers: np.ndarray) -> None:
    """Of the first two dimensions every shape of box, of the others the square one."""
    for first, second, shapes in ((0, 1, (1, 2, 4, 8, 16)), (0, 2, (4,)), (1, 2, (4,))):
        for rows in shapes:
            x, y = numbers[..., first] * rows, numbers[..., second] * (16 // rows)
            box = x.astype(int) * (16 // rows) + y.astype(int)
            np.testing.assert_array_equal(np.sort(box, axis=1), np.broadcast_to(np.arange(16), box.shape))


def test_each_of_them_is_uniform_and_pairs_are_independent_of_the_net(numbers: np.ndarray) -> None:
    assert numbers.min() >= 0
    assert numbers.max() < 1
    for member in (0, 7):
        for dimension in range(3):
            counts = np.histogram(numbers[:, member, dimension], bins=64, range=(0, 1))[0]
            assert_counts_follow(counts, np.full(64, 1 / 64))
        cube = np.histogramdd(numbers[:, member], bins=6, range=[(0, 1)] * 3)[0]
        assert_counts_follow(cube.ravel(), np.full(216, 1 / 216))
    # The last of 53 bits are random too.
    assert_mean_is((numbers[:, 3, 0] * 2**40) % 1.0, 0.5)


def test_means_are_unbiased_and_near_faster_than_chance(numbers: np.ndarray) -> None:
    value = np.exp(numbers[..., 0] + numbers[..., 1] * numbers[..., 2])
    means = value.mean(axis=1)
    # (e − 1) · Σ 1 / (k! (k + 1)²)
    assert_mean_is(means, (np.e - 1) * 1.3179021514544038)
    assert means.std() < 0.25 * value.std() / 4


def test_a_number_hangs_on_its_key_alone(numbers: np.ndarray) -> None:
    part = even_numbers(np.array([5, 2]), (3, np.arange(100, 200)))
    np.testing.assert_array_equal(part, numbers[100:200, [5, 2]])
    assert (even_numbers(np.arange(16), (4, np.arange(50)))[:, 0] != numbers[:50, 0]).all()
