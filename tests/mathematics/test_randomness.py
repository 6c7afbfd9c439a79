"""Counter-based random numbers: a known sequence, dependence on the keys alone, uniformity."""

import numpy as np
import pytest
from scipy.stats import chi2

from prt_bake.mathematics import random

FALSE_ALARM = 1e-6  # probability that a correct generator fails with a random seed


def test_sequence_is_splitmix64() -> None:
    # The first words of the author's reference implementation for the seed 1234567.
    expected = [6457827717110365317, 3203168211198807973, 9817491932198370423, 4593380528125082431]
    assert random.stream(1234567, 4).tolist() == expected


def test_numbers_depend_on_their_keys_alone() -> None:
    table = random.uniforms((7, np.arange(5)[:, None], np.arange(11)), 6)
    assert table.shape == (5, 11, 6)
    np.testing.assert_array_equal(random.uniforms((7, 3, 9), 6), table[3, 9])
    np.testing.assert_array_equal(random.uniforms((7, 3, 9), 2), table[3, 9, :2])


def test_every_key_and_their_order_matter() -> None:
    keys: list[tuple[int, ...]] = [(), (0,), (0, 0), (1,), (1, 2), (2, 1), (-1,), (2**63,), (2**64 - 2,)]
    words = [int(random.hashed(*key)) for key in keys]
    assert len(set(words)) == len(words)


def test_negative_keys_count_modulo_2_to_64() -> None:
    assert random.hashed(-1) == random.hashed(2**64 - 1)


@pytest.mark.parametrize("key", [0.5, 2**64, "seed"])
def test_non_integer_keys_are_refused(key: object) -> None:
    with pytest.raises(TypeError, match="expected integers"):
        random.uniforms((key,), 1)  # type: ignore[arg-type]


def test_numbers_lie_in_the_half_open_interval() -> None:
    numbers = random.uniforms((1, np.arange(100_000)), 2)
    assert numbers.dtype == np.float64
    assert numbers.min() >= 0
    assert numbers.max() < 1
    assert ((numbers * 2.0**53) % 1 == 0).all()


@pytest.mark.parametrize("shift", [1, 2, 3])
def test_pairs_are_uniform_along_the_stream_and_across_keys(shift: int) -> None:
    table = random.uniforms((5, np.arange(400)), 400)
    for axis in (0, 1):
        pairs = np.stack([table, np.roll(table, shift, axis=axis)], axis=-1).reshape(-1, 2)
        counts = np.histogram2d(pairs[:, 0], pairs[:, 1], bins=32, range=[[0, 1], [0, 1]])[0]
        expected = len(pairs) / counts.size
        statistic = ((counts - expected) ** 2 / expected).sum()
        assert statistic < chi2.isf(FALSE_ALARM, counts.size - 1)


def test_one_bit_of_a_key_flips_half_the_bits() -> None:
    keys = np.arange(2_000, dtype=np.uint64)
    for bit in (0, 1, 31, 63):
        changed = random.words((keys,), 1) ^ random.words((keys ^ np.uint64(1 << bit),), 1)
        share = np.bitwise_count(changed).mean() / 64
        # Five sigma of 2,000 × 64 coin tosses: two-sided false alarm 6e-7.
        assert abs(share - 0.5) < 5 * 0.5 / np.sqrt(2_000 * 64)
