"""Real spherical harmonics of any degree, by a recursion in Cartesian coordinates without a singularity at the poles.

Convention, for the whole product: real, orthonormal over the sphere (∫ Y_lm Y_l'm' dω = δ_ll' δ_mm'), polar axis +z,
azimuth φ from +x toward +y, no Condon–Shortley phase; the harmonic (l, m) has index l(l+1)+m:

    Y_00 = 0.282095,   Y_1,-1 … Y_1,1 = 0.488603 (y, z, x),
    Y_2,-2 … Y_2,2 = 1.092548 xy, 1.092548 yz, 0.315392 (3z²−1), 1.092548 xz, 0.546274 (x²−y²).

With P̂_l^m the associated Legendre function normalised so that ∫ Y² dω = 1, without its phase,

    Y_lm = √2 P̂_l^m(cosθ) cos mφ   (m > 0),      P̂_l^0(cosθ)   (m = 0),      √2 P̂_l^|m|(cosθ) sin |m|φ   (m < 0).

P̂_l^m / sin^m θ is a polynomial in z, and sin^m θ (cos mφ, sin mφ) are the real and imaginary parts of (x + iy)^m:
neither needs θ, φ or a division. Source of the three-term recursion: Holmes and Featherstone, "A unified approach to
the Clenshaw summation and the recursive computation of very high degree and order normalised associated Legendre
functions", J. Geodesy 76 (2002).

    >>> import prt_bake as prt
    >>> prt.sh.evaluate([[0.0, 1.0, 0.0]], degree=1).round(6).tolist()
    [[0.282095, 0.488603, 0.0, 0.0]]
"""

import math
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from formats.arguments import numbers, whole_number
from formats.errors import QueryError

HIGHEST_ROTATED = 100
"""The quadrature of a rotation grows with the fourth power of the degree: 1.6 GB here."""
UNIT_TOLERANCE = 1e-5  # accepts float32 directions, which are normalised in float64


def count(degree: int) -> int:
    """Number of harmonics up to `degree`, K = (degree + 1)². Raises QueryError if `degree` is negative.

    >>> from prt_bake import sh
    >>> sh.count(2)
    9
    """
    if whole_number("degree", degree) < 0:
        raise QueryError(f"degree of the harmonics: expected 0 or more, found {degree}")
    return (degree + 1) ** 2


def degree_of(count: int) -> int:
    """Degree whose K = (degree + 1)² is `count`. Raises QueryError if `count` is not a square of 1 or more."""
    root = math.isqrt(max(whole_number("count", count), 0))
    if count < 1 or root * root != count:
        raise QueryError(f"number of harmonics: expected a square, 1, 4, 9, 16, …, found {count}")
    return root - 1


def evaluate(directions: ArrayLike, degree: int) -> NDArray[np.float64]:
    """Values [..., K] of all harmonics up to `degree` [sr^-½] in unit directions [..., 3].

    K = (degree + 1)², float64, index l(l+1)+m. Lengths within 1e-5 of 1 are normalised first. Raises QueryError if the
    last axis is not 3, or for directions that are not finite or not unit, with their count and the first index.

    >>> from prt_bake import sh
    >>> sh.evaluate([0.0, 0.0, 1.0], degree=1).round(6).tolist()
    [0.282095, 0.0, 0.488603, 0.0]
    """
    harmonics_count = count(degree)
    x, y, z = _unit_components(directions)
    harmonics = np.empty((*x.shape, harmonics_count))
    # sin^m θ cos mφ and sin^m θ sin mφ: real and imaginary part of (x + iy)^m.
    cosine, sine = np.ones_like(x), np.zeros_like(x)
    # P̂_m^m / sin^m θ.
    diagonal = math.sqrt(1 / (4 * math.pi))
    for m in range(degree + 1):
        if m > 0:
            cosine, sine = x * cosine - y * sine, x * sine + y * cosine
            diagonal *= math.sqrt((2 * m + 1) / (2 * m))
        # (√2) P̂_l^m / sin^m θ, for this l and for l − 1.
        profile = np.full_like(x, diagonal if m == 0 else math.sqrt(2) * diagonal)
        previous = np.zeros_like(x)
        for l in range(m, degree + 1):
            if l > m:
                scale = math.sqrt((4 * l * l - 1) / (l * l - m * m))
                share = math.sqrt(((l - 1) ** 2 - m * m) / (4 * (l - 1) ** 2 - 1)) if l > m + 1 else 0.0
                previous, profile = profile, scale * (z * profile - share * previous)
            harmonics[..., l * (l + 1) + m] = profile * cosine
            if m > 0:
                harmonics[..., l * (l + 1) - m] = profile * sine
    return harmonics


def rotation(matrix: ArrayLike, degree: int) -> NDArray[np.float64]:
    """Matrix M [K, K] with Y(R d) = M Y(d) for every direction d, R = `matrix` [3, 3] orthogonal.

    The rotated function L'(d) = L(R⁻¹ d) has the coefficients M b if L has b. M is orthogonal and block-diagonal by
    degree; each block is ∫ Y_l(R d) Y_l(d)ᵀ dω, integrated exactly by quadrature. Reflections (determinant −1) are
    accepted and obey the same law. Raises QueryError if `matrix` is not 3×3, finite and orthogonal to 1e-6.

    >>> import numpy as np
    >>> from prt_bake import sh
    >>> quarter_turn_about_z = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    >>> light_from_x = sh.evaluate([1.0, 0.0, 0.0], degree=2)
    >>> np.allclose(sh.rotation(quarter_turn_about_z, 2) @ light_from_x, sh.evaluate([0.0, 1.0, 0.0], degree=2))
    True
    """
    if count(degree) > count(HIGHEST_ROTATED):
        raise QueryError(f"degree: rotations are computed up to degree {HIGHEST_ROTATED}, found {degree}")
    orthogonal = np.asarray(numbers("rotation", matrix), dtype=np.float64)
    if orthogonal.shape != (3, 3):
        raise QueryError(f"rotation: expected a matrix [3, 3], found an array of shape {list(orthogonal.shape)}")
    defect = float(np.abs(orthogonal @ orthogonal.T - np.eye(3)).max())
    if not defect <= 1e-6:
        raise QueryError(f"rotation: expected an orthogonal matrix, found R Rᵀ off the identity by {defect:.3g}")
    directions, weights = quadrature(degree)
    harmonics = evaluate(directions, degree)
    rotated = evaluate(directions @ orthogonal.T, degree)
    blocks = np.zeros((count(degree), count(degree)))
    for l in range(degree + 1):
        band = slice(l * l, (l + 1) ** 2)
        blocks[band, band] = (rotated[:, band] * weights[:, None]).T @ harmonics[:, band]
    return blocks


def rotations(matrices: NDArray[np.float64], degree: int) -> NDArray[np.float64]:
    """`rotation` for rotation matrices [R,3,3]: [R,K,K]. Elements between bands are rounding errors, not exact
    zeros.
    """
    directions, weights = quadrature(degree)
    rotated = evaluate((directions @ matrices.transpose(0, 2, 1)).reshape(-1, 3), degree)
    harmonics = evaluate(directions, degree) * weights[:, None]
    return np.asarray(rotated.reshape(len(matrices), len(directions), count(degree)).transpose(0, 2, 1) @ harmonics)


@lru_cache(maxsize=32)
def quadrature(degree: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Directions [D, 3] and weights [D] [sr] that integrate any product of two harmonics up to `degree` exactly.

    Gauss–Legendre in cosθ (exact to degree 2·degree + 1) times equal steps in φ (exact below frequency 2·degree + 1);
    D = (degree + 1)(2·degree + 1). The arrays are cached and read-only. Raises QueryError if `degree` is negative.

    >>> from prt_bake import sh
    >>> directions, weights = sh.quadrature(2)
    >>> len(directions), float(weights.sum().round(6))
    (15, 12.566371)
    """
    if degree < 0:
        raise QueryError(f"degree of the quadrature: expected 0 or more, found {degree}")
    rows, columns = degree + 1, 2 * degree + 1
    cos_theta, row_weights = np.polynomial.legendre.leggauss(rows)
    phi = 2 * math.pi * np.arange(columns) / columns
    sin_theta = np.sqrt((1 - cos_theta) * (1 + cos_theta))
    directions = np.stack(
        [
            np.outer(sin_theta, np.cos(phi)).ravel(),
            np.outer(sin_theta, np.sin(phi)).ravel(),
            np.repeat(cos_theta, columns),
        ],
        axis=-1,
    )
    weights = np.repeat(row_weights * (2 * math.pi / columns), columns)
    directions.flags.writeable = False
    weights.flags.writeable = False
    return directions, weights


def _unit_components(
    directions: ArrayLike,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    vectors = np.asarray(numbers("directions", directions), dtype=np.float64)
    if vectors.ndim == 0 or vectors.shape[-1] != 3:
        raise QueryError(f"directions: expected an array [..., 3], found shape {list(vectors.shape)}")
    x, y, z = vectors[..., 0], vectors[..., 1], vectors[..., 2]
    length = np.sqrt(x * x + y * y + z * z)
    bad = ~(np.abs(length - 1) <= UNIT_TOLERANCE)
    if bad.any():
        first = tuple(int(axis[0]) for axis in np.nonzero(np.atleast_1d(bad)))
        raise QueryError(
            f"directions: expected unit vectors, found {int(bad.sum())} that are not; the first, "
            f"at index {list(first)}, is {vectors.reshape(-1, 3)[int(np.argmax(bad))].tolist()}"
        )
    return x / length, y / length, z / length
