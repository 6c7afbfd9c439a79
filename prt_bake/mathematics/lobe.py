"""Sampling of directions about an axis: a generalised Gaussian of the angle, wrapped around the sphere, mixed with the
uniform density.

A point in the tangent plane at the axis is sampled with density ∝ exp(−(r/α)^β). The shape β is 2 for a Gaussian, less
for a peaked lobe, more for a flat one with a sharp edge. α is chosen so that σ is the standard deviation of each of the
two coordinates (Varanasi and Aazhang 1989 in one dimension; E[r²] = 2σ² in two). The direction is the end of the
geodesic of length r from the axis towards that point; beyond π it wraps around the sphere. The density per steradian is
thus the sum over all wraps r = θ, 2π − θ, 2π + θ, … of g(r) r / sin θ. At the antipode, and for wide lobes also at the
axis, it grows as 1/sin θ, which is integrable. It is bounded below, so that quotients by it are bounded.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import special

from formats.errors import QueryError
from prt_bake.mathematics.directions import on_sphere
from prt_bake.mathematics.sphere import tangent_frame

Array = NDArray[np.float64]

UNIFORM_SHARE = 0.1
"""Default share of uniform samples; f / density is at most 4π f / share."""
SIGMAS = (1e-5, 100.0)
"""Radians. A narrower lobe is below the resolution of a float64 cosine. A wider one is practically uniform in angle and
only has more wraps to sum."""
SHAPES = (0.5, 16.0)
TAIL = 1e-14
"""Share of a lobe in the wraps that are neglected."""
_POLE = 1e-8
"""Below this sine a float64 cosine is ±1; the density is clamped to its value here."""
_LARGEST_NUMBER = 1.0 - 2.0**-53


def width_per_sigma(shape: float) -> float:
    """α/σ: the scale of exp(−(r/α)^shape) in the plane whose coordinates have standard deviation 1."""
    return math.sqrt(2.0 * math.gamma(2.0 / shape) / math.gamma(4.0 / shape))


def normalisation(shape: float) -> float:
    """Factor with which exp(−(r/α)^shape), α = 1, integrates to 1 over the plane."""
    return shape / (2.0 * math.pi * math.gamma(2.0 / shape))


def reach(shape: float, tail: float = TAIL) -> float:
    """Angle, in units of α, beyond which a share `tail` of the lobe lies."""
    return float(special.gammainccinv(2.0 / shape, tail) ** (1.0 / shape))


def density(sigma: ArrayLike, shape: float, cosine: ArrayLike, share: float = UNIFORM_SHARE) -> Array:
    """Density per steradian of the mixture at directions whose cosine with the axis is `cosine`.

    `sigma` [radians] and `cosine` broadcast. The density integrates to 1 over the sphere and is at least share/4π.
    Raises QueryError if a sigma is outside `SIGMAS`, the shape outside `SHAPES`, or the share outside (0, 1].
    """
    _require(sigma, shape, share)
    return np.asarray((1.0 - share) * _wrapped(sigma, shape, cosine) + share / (4.0 * math.pi))


def draw(sigma: ArrayLike, shape: float, numbers: ArrayLike, normals: ArrayLike, share: float = UNIFORM_SHARE) -> Array:
    """Sample unit directions [N,3] about the axes `normals` [N,3] with density `density`.

    `numbers` [N,3] are uniform in [0, 1): the first selects the lobe or the uniform density, the others angle and
    azimuth. Raises QueryError as `density`.
    """
    _require(sigma, shape, share)
    u = np.asarray(numbers, dtype=np.float64)
    axes = np.asarray(normals, dtype=np.float64)
    directions = _geodesic_end(axes, _radius(np.asarray(sigma, dtype=np.float64), shape, u[:, 1]), u[:, 2])
    return np.where((u[:, 0] < share)[:, None], on_sphere(u[:, 1], u[:, 2]), directions)


@dataclass(frozen=True, eq=False)
class Lobe:
    """Sampling densities of N queries: a mixture of L lobes and the uniform density each.

    axes: unit vectors [N,L,3]. sigma: [N,L] in radians. weights: [N,L], sum to 1 over the lobes of a query.
    """

    axes: Array
    sigma: Array
    weights: Array
    shape: float
    share: float = UNIFORM_SHARE

    def __post_init__(self) -> None:
        _require(self.sigma, self.shape, self.share)

    def draw(self, numbers: ArrayLike) -> Array:
        """Sample unit directions [N,S,3] from numbers [N,S,3] uniform in [0, 1)."""
        u = np.asarray(numbers, dtype=np.float64)
        rows, samples = u.shape[:2]
        # Given that the first number selects the lobes, the rest of it is uniform again.
        rest = np.clip((u[..., 0] - self.share) / (1.0 - self.share), 0.0, 1.0) if self.share < 1.0 else u[..., 0]
        bounds = np.cumsum(self.weights[:, :-1], axis=1)
        chosen = (rest[:, :, None] >= bounds[:, None, :]).sum(axis=2)
        query = np.arange(rows)[:, None]
        axes, sigma = self.axes[query, chosen].reshape(-1, 3), self.sigma[query, chosen].ravel()
        flat = u.reshape(-1, 3)
        return draw(sigma, self.shape, flat, axes, self.share).reshape(rows, samples, 3)

    def density(self, directions: ArrayLike) -> Array:
        """Density per steradian [N,S] of the mixture at unit directions [N,S,3]."""
        d = np.asarray(directions, dtype=np.float64)
        total = np.full(d.shape[:2], self.share / (4.0 * math.pi))
        for number in range(self.sigma.shape[1]):
            cosine = np.einsum("nsk,nk->ns", d, self.axes[:, number])
            weight = (1.0 - self.share) * self.weights[:, number, None]
            total += weight * _wrapped(self.sigma[:, number, None], self.shape, cosine)
        return total


def _wrapped(sigma: ArrayLike, shape: float, cosine: ArrayLike) -> Array:
    """Density per steradian of the lobe alone: the sum over the wraps of its angle."""
    c = np.clip(np.asarray(cosine, dtype=np.float64), -1.0, 1.0)
    width = np.asarray(sigma, dtype=np.float64) * width_per_sigma(shape)
    width, c = np.broadcast_arrays(width, c)
    theta = np.asarray(np.arccos(c))
    sine = np.asarray(np.maximum(np.sqrt((1.0 - c) * (1.0 + c)), _POLE))
    total = np.asarray(_exponential(theta / width, shape) * np.where(theta > 0.0, theta / sine, 1.0))
    farthest = width * reach(shape)
    turn = 2.0 * math.pi
    while (wrapped := farthest > turn - theta).any():
        at, scale = theta[wrapped], width[wrapped]
        back, forth = turn - at, turn + at
        total[wrapped] += (
            back * _exponential(back / scale, shape) + forth * _exponential(forth / scale, shape)
        ) / sine[wrapped]
        turn += 2.0 * math.pi
    return np.asarray(normalisation(shape) * total / (width * width))


def _exponential(relative: Array, shape: float) -> Array:
    """exp(−relative^shape)."""
    if shape == 2.0:
        power = relative * relative
    elif shape == 3.0:
        power = relative * relative * relative
    else:
        with np.errstate(over="ignore"):
            power = relative**shape
    return np.asarray(np.exp(-power))


def _radius(sigma: Array, shape: float, numbers: Array) -> Array:
    """Angle at the cumulative probability `numbers`, before wrapping."""
    # The Box–Muller radius in units of √2 σ; the angle of other shapes is a smooth function of it.
    gaussian = np.sqrt(-np.log1p(-np.minimum(numbers, _LARGEST_NUMBER)))
    relative = gaussian if shape == 2.0 else np.interp(gaussian, *_gaussian_to_shape(shape))
    return np.asarray(sigma * width_per_sigma(shape) * relative)


@lru_cache
def _gaussian_to_shape(shape: float) -> tuple[Array, Array]:
    """Angles of the Gaussian and of `shape`, in units of α, at equal cumulative probability.

    A table of the inverse regularised incomplete gamma function in steps of 2·10⁻⁴. Linear interpolation errs by less
    than 4·10⁻⁸ σ.
    """
    gaussian = np.linspace(0.0, math.sqrt(-math.log(1.0 - _LARGEST_NUMBER)), 1 << 15)
    share = -np.expm1(-(gaussian**2))
    lower = special.gammaincinv(2.0 / shape, np.minimum(share, 0.5))
    upper = special.gammainccinv(2.0 / shape, np.maximum(np.exp(-(gaussian**2)), 2.0**-54))
    return gaussian, np.where(share < 0.5, lower, upper) ** (1.0 / shape)


def _geodesic_end(axes: Array, radius: Array, turn: Array) -> Array:
    """Ends of geodesics of length `radius` from the axes; sine and cosine wrap them around the sphere."""
    across = tangent_frame(axes)
    other = np.cross(axes, across)
    phi, sine = 2.0 * math.pi * turn, np.sin(radius)
    towards = np.cos(radius)[:, None] * axes
    towards += (sine * np.cos(phi))[:, None] * across + (sine * np.sin(phi))[:, None] * other
    return np.asarray(towards / np.linalg.norm(towards, axis=1, keepdims=True))


def _require(sigma: Any, shape: float, share: float) -> None:
    values = np.asarray(sigma)
    sound = (values >= SIGMAS[0]) & (values <= SIGMAS[1])
    if not sound.all():
        raise QueryError(
            f"lobe: expected sigmas from {SIGMAS[0]:g} to {SIGMAS[1]:g} radians, found {int((~sound).sum())} of "
            f"{values.size} outside, for example {values[~sound].flat[0]}"
        )
    if not SHAPES[0] <= shape <= SHAPES[1]:
        raise QueryError(f"lobe: expected a shape from {SHAPES[0]:g} to {SHAPES[1]:g}, found {shape}")
    if not 0.0 < share <= 1.0:
        raise QueryError(f"lobe: expected a uniform share above 0 and at most 1, found {share}")
