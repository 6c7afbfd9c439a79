"""Sets of directions over the sphere, and random rotations. All depend on the seed alone.

With equal weights 4π/D a set of D directions estimates integrals over the sphere. Uniform and scrambled Sobol sets are
unbiased. The Fibonacci and rank-1 lattices are unbiased after a rotation that is uniform on SO(3).
"""

import math

import numpy as np
from numpy.typing import NDArray

from formats.arguments import whole_number
from formats.errors import QueryError
from prt_bake.mathematics.random import hashed, uniforms

# Separate streams of random numbers keep sets with equal seeds independent.
UNIFORM_STREAM, SOBOL_STREAM, ROTATION_STREAM = 1, 2, 3
SOBOL_BITS = 32
LATTICE_GENERATOR, LARGEST_LATTICE = 741, 1 << 14


def uniform(count: int, seed: int) -> NDArray[np.float64]:
    """`count` independent unit directions [D, 3], uniform over the sphere. Raises QueryError if `count` is below 1.

    >>> from prt_bake import sphere
    >>> sphere.uniform(2, seed=1).shape
    (2, 3)
    """
    _require_some(count, seed)
    numbers = uniforms((UNIFORM_STREAM, seed, np.arange(count)), 2)
    return on_sphere(numbers[:, 0], numbers[:, 1])


def sobol(count: int, seed: int) -> NDArray[np.float64]:
    """The first `count` points of the two-dimensional Sobol sequence, scrambled by `seed`, as unit directions [D, 3].

    Each direction alone is uniform over the sphere; powers of two are best. SciPy scrambles by a random linear map of
    the bits and a digital shift, whose variance is that of nested uniform scrambling. Sources: Matoušek, "On the
    L2-discrepancy for anchored boxes", Journal of Complexity 14 (1998); Owen, "Variance with alternative scramblings
    of digital nets", ACM TOMACS 13 (2003). Raises QueryError if `count` is below 1 or above 2³².
    """
    from scipy.stats import qmc

    _require_some(count, seed)
    if count > 2**SOBOL_BITS:
        raise QueryError(f"Sobol directions: expected at most 2**{SOBOL_BITS}, found {count}")
    sequence = qmc.Sobol(2, bits=SOBOL_BITS, rng=np.random.default_rng(int(hashed(SOBOL_STREAM, seed))))
    points = sequence.random_base2((count - 1).bit_length())[:count] + 0.5 / 2**SOBOL_BITS
    return on_sphere(points[:, 0], points[:, 1])


def fibonacci(count: int) -> NDArray[np.float64]:
    """The Fibonacci lattice of `count` unit directions [D, 3]: z_i = 1 − (2i + 1)/D, φ_i = 2π i/Φ, Φ the golden ratio.

    Deterministic: rotate it by `random_rotations` for unbiased estimates. Source: Marques et al., "Spherical Fibonacci
    point sets for illumination integrals", Computer Graphics Forum 32 (2013). Raises QueryError if `count` is below 1.

    >>> from prt_bake import sphere
    >>> sphere.fibonacci(4)[:, 2].tolist()
    [0.75, 0.25, -0.25, -0.75]
    """
    _require_some(count)
    index = np.arange(count)
    golden_ratio = (1 + math.sqrt(5)) / 2
    return on_sphere((index + 0.5) / count, (index / golden_ratio) % 1)


def extensible_lattice(count: int) -> NDArray[np.float64]:
    """The first `count` points of a rank-1 lattice sequence as unit directions [D, 3].

    For every power of two D up to 2¹⁴ the points form a lattice z_k = 1 − 2(k/D + shift), φ_k = 2π k h/D, which
    contains all smaller ones. Among all h below 1024 this one minimises the energy Σ −|x − y| beyond degree 2, worst
    case over 2⁵ to 2¹⁰ points: 1.00 to 1.09 times that of a Fibonacci lattice. Degree-2 fits of trained networks have
    0.9 to 1.3 times the error with 32 to 128 points, 1.0 to 1.6 times with 256.

    Deterministic: rotate it by `random_rotations` for unbiased estimates. Source: Hickernell et al., "Extensible
    lattice sequences for quasi-Monte Carlo quadrature", SIAM J. Sci. Comput. 22 (2000). Raises QueryError if `count` is
    below 1 or above 2¹⁴.
    """
    _require_some(count)
    if count > LARGEST_LATTICE:
        raise QueryError(f"extensible lattice: expected at most {LARGEST_LATTICE} directions, found {count}")
    index = np.arange(count)
    radical_inverse = np.zeros(count)
    for bit in range(LARGEST_LATTICE.bit_length() - 1):
        radical_inverse += ((index >> bit) & 1) * 0.5 ** (bit + 1)
    # The shift, a third of the spacing of 32 heights, is one or two thirds of the spacing for every larger size.
    return on_sphere((radical_inverse + 1.0 / 96.0) % 1.0, (radical_inverse * LATTICE_GENERATOR) % 1.0)


def random_rotations(count: int, seed: int) -> NDArray[np.float64]:
    """`count` independent rotation matrices [R, 3, 3], uniform on SO(3); the r-th depends on `seed` and r alone.

    Raises QueryError if `count` is below 1.
    """
    _require_some(count, seed)
    return rotations(uniforms((ROTATION_STREAM, seed, np.arange(count)), 3))


def rotations(numbers: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotation matrices [R, 3, 3], uniform on SO(3), from numbers [R, 3] uniform in [0, 1).

    Source: Shoemake, "Uniform random rotations", Graphics Gems III (1992): uniform unit quaternions.
    """
    from scipy.spatial.transform import Rotation

    low, high = np.sqrt(1 - numbers[:, 0]), np.sqrt(numbers[:, 0])
    alpha, beta = 2 * math.pi * numbers[:, 1], 2 * math.pi * numbers[:, 2]
    quaternions = np.stack([low * np.sin(alpha), low * np.cos(alpha), high * np.sin(beta), high * np.cos(beta)], axis=1)
    return np.asarray(Rotation.from_quat(quaternions).as_matrix())


def on_sphere(height: NDArray[np.float64], turn: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit directions [..., 3] by the area-preserving map of the unit square: z = 1 − 2·height, φ = 2π·turn."""
    radius = 2 * np.sqrt(height * (1 - height))
    phi = 2 * math.pi * turn
    return np.stack([radius * np.cos(phi), radius * np.sin(phi), 1 - 2 * height], axis=-1)


def _require_some(count: int, seed: int = 0) -> None:
    whole_number("seed", seed)
    if whole_number("count", count) < 1:
        raise QueryError(f"number of directions: expected 1 or more, found {count}")
