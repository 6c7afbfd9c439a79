"""Spherical Gaussians in closed form: G(ω) = κ / (2π (1 − exp(−2κ))) exp(κ (ω·μ − 1)), of integral 1.

Its part in the harmonics up to degree L is Σ_l (2l + 1) / 4π · A_l(κ) P_l(ω·μ) with A_l = I_{l+½}(κ) / I_{½}(κ)
(`prt_bake.network.lobes`).
"""

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from prt_bake.jit.compilation import compiled

Array = NDArray[np.float64]

_EXTRA_BANDS = 6
"""Bands above the degree at which the downward recurrence of A_l begins: its error is then below 2 · 10⁻⁴."""


@compiled()
def beyond_harmonics(cosine: Any, sharpness: Any, degree: Any) -> Any:
    """G less its harmonics up to a degree, at a cosine to the axis."""
    peak = sharpness / (2.0 * math.pi * -math.expm1(-2.0 * sharpness))
    return peak * math.exp(sharpness * (cosine - 1.0)) - _harmonics(cosine, sharpness, degree) / (4.0 * math.pi)


@compiled()
def _harmonics(cosine: Any, sharpness: Any, degree: Any) -> Any:
    """4π times the harmonics of G up to a degree."""
    last = degree + _EXTRA_BANDS
    ratio = sharpness / (last + math.sqrt((last + 0.5) ** 2 + sharpness * sharpness))
    # A_l / A_{l−1} = ratio_l: series_l = (2l + 1) P_l + ratio_{l+1} series_{l+1}, from the highest band down.
    for band in range(last - 1, degree, -1):
        ratio = 1.0 / ((2 * band + 1) / sharpness + ratio)
    series = 0.0
    for band in range(degree, 0, -1):
        ratio = 1.0 / ((2 * band + 1) / sharpness + ratio)
        series = ratio * ((2 * band + 1) * legendre(band, cosine) + series)
    return 1.0 + series


@compiled()
def legendre(degree: Any, cosine: Any) -> Any:
    """The Legendre polynomial P_l."""
    value, following = 1.0, cosine
    for band in range(1, degree + 1):
        value, following = following, ((2 * band + 1) * cosine * following - band * value) / (band + 1)
    return value


def inner_product(axes: ArrayLike, sharpness: ArrayLike, other_axes: ArrayLike, other_sharpness: ArrayLike) -> Array:
    """∫ G G' over the sphere [N] of Gaussians with unit axes [N,3] and sharpness [N]: a third Gaussian's integral."""
    first, second = np.asarray(sharpness, np.float64), np.asarray(other_sharpness, np.float64)
    both = np.linalg.norm(
        first[..., None] * np.asarray(axes, np.float64) + second[..., None] * np.asarray(other_axes, np.float64),
        axis=-1,
    )
    peaks = [k / (2.0 * math.pi * -np.expm1(-2.0 * k)) for k in (first, second)]
    opposite = both < 1e-6  # of the same sharpness: the product is then even
    safe = np.where(opposite, 1.0, both)
    even = np.where(opposite, 2.0, -np.expm1(-2.0 * safe) / safe)
    return np.asarray(peaks[0] * peaks[1] * 2.0 * math.pi * np.exp(both - first - second) * even)
