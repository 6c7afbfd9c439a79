"""Deringing: the harmonics of a light are damped until it is nowhere negative.

The window is the heat kernel on the sphere, b_lm → exp(−t l(l+1)) b_lm. By the maximum principle the minimum of the
function rises with t, so bisection finds the least sufficient t. It exists for every function with a positive mean, and
a function that is already nonnegative stays unchanged. Up to degree 2 the minimum is exact: c + g·d + dᵀA d on the unit
sphere is the trust-region problem, solved in the eigenbasis of A by its secular equation (Moré and Sorensen, "Computing
a trust region step", SIAM J. Sci. Stat. Comput. 4, 1983), including the hard case of a g orthogonal to the lowest
eigenvector. Above degree 2 a descent from the best points of a lattice finds the minimum.
"""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from formats.errors import QueryError
from prt_bake.mathematics import sh
from prt_bake.mathematics.directions import fibonacci

Array = NDArray[np.float64]

_BISECTIONS = 45
_NEWTON_STEPS = 100
_LATTICE = 48
"""Lattice directions per squared degree; minima of a function of degree l are about π / l wide."""
_STARTS = 8
_DESCENT_STEPS = 40


def windowed(coefficients: ArrayLike) -> Array:
    """The `coefficients` [K,3] of a light, damped equally in all channels, so that no channel is negative anywhere.

    Raises QueryError if the mean of a channel is negative.
    """
    light = np.asarray(coefficients, np.float64)
    spread, eigenvalues = required_spread(light), _eigenvalues(len(light))
    # The mean stays, also for an infinite spread.
    return np.where(eigenvalues == 0.0, 1.0, np.exp(-spread * np.maximum(eigenvalues, 1.0)))[:, None] * light


def required_spread(coefficients: ArrayLike) -> float:
    """The least t ≥ 0 with Σ exp(−t l(l+1)) b_lm Y_lm ≥ 0 everywhere, in every channel of `coefficients` [K,C].

    Infinite if a channel has a mean of 0 and other coefficients. Raises QueryError if a mean is negative or K is not a
    square.
    """
    light = np.asarray(coefficients, np.float64)
    if (light[0] < 0.0).any():
        raise QueryError("light: its mean radiance is negative; no window makes it positive")
    eigenvalues = _eigenvalues(len(light))
    spread = 0.0
    for channel in light.T:
        spread = _channel_spread(channel, eigenvalues, spread)
    return spread


def _channel_spread(channel: Array, eigenvalues: Array, least: float) -> float:
    """`required_spread` of one channel [K], at least `least`."""
    if not channel[1:].any() or least == math.inf or minimum(np.exp(-least * eigenvalues) * channel)[0] >= 0.0:
        return least
    if channel[0] == 0.0:
        return math.inf
    low, high = least, least + 1.0
    while minimum(np.exp(-high * eigenvalues) * channel)[0] < 0.0:
        low, high = high, 2.0 * high
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        if minimum(np.exp(-middle * eigenvalues) * channel)[0] < 0.0:
            low = middle
        else:
            high = middle
    return high


def minimum(coefficients: ArrayLike) -> tuple[float, Array]:
    """The minimum of Σ b_k Y_k over the sphere, and a direction [3] of it, for `coefficients` [K].

    Exact to rounding up to degree 2, by descent above. Raises QueryError if K is not a square.
    """
    function = np.asarray(coefficients, np.float64)
    degree = sh.degree_of(len(function))
    scale = float(np.abs(function).max())
    if scale == 0.0 or degree == 0:
        return float(function[0]) / math.sqrt(4.0 * math.pi), np.array([0.0, 0.0, 1.0])
    unit = function / scale
    direction = _minimum_of_quadratic(unit) if degree <= 2 else _minimum_by_descent(unit, degree)
    return scale * float(sh.evaluate(direction, degree) @ unit), direction


def _eigenvalues(harmonics: int) -> Array:
    """l(l+1) of each of K harmonics."""
    l = np.arange(sh.degree_of(harmonics) + 1)
    return np.repeat(l * (l + 1.0), 2 * l + 1)


def _minimum_of_quadratic(function: Array) -> Array:
    """The direction in which c + g·d + dᵀA d is least on the unit sphere."""
    first, second = math.sqrt(0.75 / math.pi), math.sqrt(3.75 / math.pi)
    gradient = first * function[[3, 1, 2]]
    matrix = np.zeros((3, 3))
    if len(function) == 9:
        xy, yz, zz, xz, xx = function[4:]
        along = 0.5 * math.sqrt(1.25 / math.pi) * zz
        matrix += np.diag([0.5 * second * xx - along, -0.5 * second * xx - along, 2.0 * along])
        matrix[[0, 1, 1, 2, 0, 2], [1, 0, 2, 1, 2, 0]] = 0.5 * second * np.array([xy, xy, yz, yz, xz, xz])
    curvatures, axes = np.linalg.eigh(matrix)
    slopes = axes.T @ gradient
    # d_i = −g_i / 2(a_i − μ). The gap a_0 − μ ≥ 0 makes d a unit vector; its length falls as the gap grows.
    gaps = curvatures - curvatures[0]
    low, high = 0.0, 0.5 * float(np.linalg.norm(slopes))
    gap = high
    for _ in range(_NEWTON_STEPS):
        length, fall = _length(slopes, gaps + gap)
        low, high = (gap, high) if length > 1.0 else (low, gap)
        # Newton's step on 1 / length, which is nearly linear; bisect if it leaves the bracket.
        gap += (length - 1.0) * length / fall if 0.0 < fall < math.inf else 0.0
        if not low < gap < high:
            gap = 0.5 * (low + high)
        if high - low <= 1e-16 * high:
            break
    local = _step(slopes, gaps + high)
    rest = 1.0 - float(local @ local)
    if rest > 0.0:
        # The hard case: no slope along the lowest axis, and both of its directions are minima.
        local[0] = math.copysign(math.sqrt(local[0] ** 2 + rest), local[0])
    direction = axes @ local
    return np.asarray(direction / np.linalg.norm(direction))


def _step(slopes: Array, curvatures: Array) -> Array:
    return -0.5 * np.divide(slopes, curvatures, out=np.zeros(3), where=curvatures > 0.0)


def _length(slopes: Array, curvatures: Array) -> tuple[float, float]:
    """|d|, and −½ d|d|²/dμ as all curvatures grow by μ; both infinite if an axis has a slope but no curvature."""
    if (slopes[curvatures <= 0.0] != 0.0).any():
        return math.inf, math.inf
    step = _step(slopes, curvatures)
    scaled = np.divide(step, curvatures, out=np.zeros(3), where=curvatures > 0.0)
    return math.sqrt(float(step @ step)), float(step @ scaled)


def _minimum_by_descent(function: Array, degree: int) -> Array:
    """The lowest end point of pattern searches from the lowest directions of a lattice."""
    lattice = fibonacci(_LATTICE * degree * degree)
    values = sh.evaluate(lattice, degree) @ function
    points = lattice[np.argsort(values, kind="stable")[:_STARTS]]
    reach = math.sqrt(4.0 * math.pi / len(lattice))
    turns = math.pi / 4.0 * np.arange(8)
    for _ in range(_DESCENT_STEPS):
        across = np.cross(points, np.eye(3)[np.argmin(np.abs(points), axis=1)])
        across /= np.linalg.norm(across, axis=1, keepdims=True)
        other = np.cross(points, across)
        rim = np.cos(turns)[:, None, None] * across + np.sin(turns)[:, None, None] * other
        star = np.concatenate([points[None], points + reach * rim])
        star /= np.linalg.norm(star, axis=2, keepdims=True)
        lowest = np.argmin(sh.evaluate(star, degree) @ function, axis=0)
        points = star[lowest, np.arange(len(points))]
        reach *= 1.0 if (lowest > 0).any() else 0.5
        if reach < 1e-9:
            break
    return np.asarray(points[np.argmin(sh.evaluate(points, degree) @ function)])
