"""Low-discrepancy numbers: a three-dimensional Sobol sequence, Owen-scrambled separately for each key.

Each point alone is uniform and means are unbiased, but a mean of n points converges faster than n^-1/2. Sources: Owen,
"Randomly permuted (t,m,s)-nets and (t,s)-sequences", 1995; Burley, "Practical hash-based Owen scrambling", JCGT 9
(2020). Every bit is flipped by a hash of the bits above it. A permutation of the reversed bits does so in a few
operations (Laine and Karras 2011), here with the constants of Vegdahl (2021).

The sequence is SciPy's. Its scrambling takes 490 µs per key, this one 1.3 µs.
"""

from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from prt_bake.jit.compilation import compiled
from prt_bake.mathematics.random import words

Array = NDArray[np.float64]

MOST = 1 << 16
"""Length of the sequence."""
_FIRST, _SECOND, _THIRD = np.uint32(0x3D20ADEA), np.uint32(0x05526C56), np.uint32(0x53A22864)


def sobol_points(members: NDArray[np.int64], keys: tuple[ArrayLike, ...]) -> Array:
    """Points `members` [S] of the sequence, scrambled for each combination of integer keys [N]: [N,S,3] in [0, 1)."""
    seeds = words(keys, 3)
    numbers = np.empty((len(seeds), len(members), 3))
    _scramble(_sequence()[members], np.asarray(members, np.uint64), seeds, numbers)
    return numbers


@compiled(nogil=True, error_model="numpy")
def _scramble(reversed_points: Any, members: Any, seeds: Any, numbers: Any) -> None:
    for n in range(seeds.shape[0]):
        for k in range(3):
            seed = np.uint32(seeds[n, k] >> np.uint64(32))
            for s in range(reversed_points.shape[0]):
                # numba widens 32-bit products to 64 bits.
                x = reversed_points[s, k]
                x = np.uint32(x ^ np.uint32(x * _FIRST))
                x = np.uint32(x + seed)
                x = np.uint32(x * ((seed >> np.uint32(16)) | np.uint32(1)))
                x = np.uint32(x ^ np.uint32(x * _SECOND))
                x = np.uint32(x ^ np.uint32(x * _THIRD))
                # The bits below 2⁻³² are independent random numbers.
                rest = (seeds[n, k] + members[s]) * np.uint64(0xBF58476D1CE4E5B9)
                rest = (rest ^ (rest >> np.uint64(29))) * np.uint64(0x94D049BB133111EB)
                fine = np.float64(rest >> np.uint64(43)) * 2.0**-21
                numbers[n, s, k] = (np.float64(_reversed(x)) + fine) * 2.0**-32


@compiled(nogil=True, error_model="numpy")
def _reversed(x: Any) -> Any:
    """The 32 bits of x in reverse order."""
    y = np.uint64(x)
    y = ((y >> np.uint64(1)) & np.uint64(0x55555555)) | ((y & np.uint64(0x55555555)) << np.uint64(1))
    y = ((y >> np.uint64(2)) & np.uint64(0x33333333)) | ((y & np.uint64(0x33333333)) << np.uint64(2))
    y = ((y >> np.uint64(4)) & np.uint64(0x0F0F0F0F)) | ((y & np.uint64(0x0F0F0F0F)) << np.uint64(4))
    y = ((y >> np.uint64(8)) & np.uint64(0x00FF00FF)) | ((y & np.uint64(0x00FF00FF)) << np.uint64(8))
    return (y >> np.uint64(16)) | ((y & np.uint64(0xFFFF)) << np.uint64(16))


@cache
def _sequence() -> NDArray[np.uint32]:
    """The Sobol sequence [MOST,3] of SciPy (Joe and Kuo's direction numbers) with its bits reversed."""
    from scipy.stats import qmc

    points = (qmc.Sobol(3, scramble=False).random(MOST) * 2.0**32).astype(np.uint32)
    reversed_points = np.zeros_like(points)
    for bit in range(32):
        reversed_points |= ((points >> np.uint32(bit)) & np.uint32(1)) << np.uint32(31 - bit)
    return np.asarray(reversed_points)
