"""Light without negative radiance: harmonics damped until their function is nowhere below 0.

The window is the flow of heat on the sphere, b_lm → exp(−t l(l+1)) b_lm. What flows never falls below its least value
(the maximum principle), so that the minimum rises with t and the least t that does is found by bisection; any function
whose mean is not negative gets there, and one that already is there stays as it is. Up to degree 2 the minimum is
exact, whatever its direction: c + g·d + dᵀA d on the unit sphere is the trust-region problem, solved in the frame of A
by its secular equation (Moré and Sorensen, "Computing a trust region step", SIAM J. Sci. Stat. Comput. 4, 1983), the
case of a g without part along the lowest axis included. Above degree 2 the minimum is searched for from a lattice.
"""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from formats.errors import QueryError
from prt_bake.mathematics import sh
from prt_bake.mathematics.directions import fibonacci

Array = NDArray[np.float64]

_HALVINGS = 45
_ROUNDS = 100
_LATTICE = 48
"""Lattice directions for each squared degree; wells of a function of degree l are about π / l wide."""
_WELLS = 8
_DESCENTS = 40


def windowed(coefficients: ArrayLike) -> Array:
    """`coefficients` [K,3] of light damped, alike in all channels, so much that no channel is below 0 anywhere.

    A channel whose mean is negative cannot be mended and raises QueryError.
    """
    light = np.asarray(coefficients, np.float64)
    spread, eigenvalues = spread_needed(light), _eigenvalues(len(light))
    # The mean stays, whatever the spread.
    return np.where(eigenvalues == 0.0, 1.0, np.exp(-spread * np.maximum(eigenvalues, 1.0)))[:, None] * light


def spread_needed(coefficients: ArrayLike) -> float:
    """The least t ≥ 0 with Σ exp(−t l(l+1)) b_lm Y_lm ≥ 0 everywhere, in every channel of `coefficients` [K,C].

    Infinite where a channel is only just not negative when all but its mean is gone. Raises QueryError where a mean is
    negative or K is not a square.
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
    """As `spread_needed` of one channel [K], and at least `least`."""
    if not channel[1:].any() or least == math.inf or minimum(np.exp(-least * eigenvalues) * channel)[0] >= 0.0:
        return least
    if channel[0] == 0.0:
        return math.inf
    low, high = least, least + 1.0
    while minimum(np.exp(-high * eigenvalues) * channel)[0] < 0.0:
        low, high = high, 2.0 * high
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        if minimum(np.exp(-middle * eigenvalues) * channel)[0] < 0.0:
            low = middle
        else:
            high = middle
    return high


def minimum(coefficients: ArrayLike) -> tuple[float, Array]:
    """The least value of Σ b_k Y_k over the sphere, and a direction [3] of it, for `coefficients` [K].

    Exact to rounding up to degree 2; above, the least of what descents from a lattice find. Raises QueryError if K is
    not a square.
    """
    function = np.asarray(coefficients, np.float64)
    degree = sh.degree_of(len(function))
    scale = float(np.abs(function).max())
    if scale == 0.0 or degree == 0:
        return float(function[0]) / math.sqrt(4.0 * math.pi), np.array([0.0, 0.0, 1.0])
    whole = function / scale
    direction = _lowest_of_quadratic(whole) if degree <= 2 else _lowest_by_descent(whole, degree)
    return scale * float(sh.evaluate(direction, degree) @ whole), direction


def _eigenvalues(harmonics: int) -> Array:
    """l(l+1) of each of K harmonics."""
    l = np.arange(sh.degree_of(harmonics) + 1)
    return np.repeat(l * (l + 1.0), 2 * l + 1)


def _lowest_of_quadratic(function: Array) -> Array:
    """Where c + g·d + dᵀA d is least on the unit sphere."""
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
    # d_i = −g_i / 2(a_i − μ), with a gap a_0 − μ ≥ 0 that makes it a unit vector; its length falls as the gap grows.
    gaps = curvatures - curvatures[0]
    low, high = 0.0, 0.5 * float(np.linalg.norm(slopes))
    gap = high
    for _ in range(_ROUNDS):
        length, fall = _length(slopes, gaps + gap)
        low, high = (gap, high) if length > 1.0 else (low, gap)
        # Newton's step on 1 / length, which is all but straight; halved where it leaves the bracket.
        gap += (length - 1.0) * length / fall if 0.0 < fall < math.inf else 0.0
        if not low < gap < high:
            gap = 0.5 * (low + high)
        if high - low <= 1e-16 * high:
            break
    place = _step(slopes, gaps + high)
    rest = 1.0 - float(place @ place)
    if rest > 0.0:
        # Along the lowest axis, where that has no slope of its own, both ways are as low.
        place[0] = math.copysign(math.sqrt(place[0] ** 2 + rest), place[0])
    direction = axes @ place
    return np.asarray(direction / np.linalg.norm(direction))


def _step(slopes: Array, curvatures: Array) -> Array:
    bent = curvatures > 0.0
    return -0.5 * np.divide(slopes, curvatures, out=np.zeros(3), where=bent)


def _length(slopes: Array, curvatures: Array) -> tuple[float, float]:
    """|d|, and how fast its square falls, by half, as all curvatures grow; infinite where a slope has no curvature."""
    if (slopes[curvatures <= 0.0] != 0.0).any():
        return math.inf, math.inf
    place = _step(slopes, curvatures)
    steeper = np.divide(place, curvatures, out=np.zeros(3), where=curvatures > 0.0)
    return math.sqrt(float(place @ place)), float(place @ steeper)


def _lowest_by_descent(function: Array, degree: int) -> Array:
    """The lowest of what shrinking stars about the lowest directions of a lattice end in."""
    lattice = fibonacci(_LATTICE * degree * degree)
    values = sh.evaluate(lattice, degree) @ function
    places = lattice[np.argsort(values, kind="stable")[:_WELLS]]
    reach = math.sqrt(4.0 * math.pi / len(lattice))
    turns = math.pi / 4.0 * np.arange(8)
    for _ in range(_DESCENTS):
        across = np.cross(places, np.eye(3)[np.argmin(np.abs(places), axis=1)])
        across /= np.linalg.norm(across, axis=1, keepdims=True)
        other = np.cross(places, across)
        rim = np.cos(turns)[:, None, None] * across + np.sin(turns)[:, None, None] * other
        star = np.concatenate([places[None], places + reach * rim])
        star /= np.linalg.norm(star, axis=2, keepdims=True)
        lowest = np.argmin(sh.evaluate(star, degree) @ function, axis=0)
        places = star[lowest, np.arange(len(places))]
        reach *= 1.0 if (lowest > 0).any() else 0.5
        if reach < 1e-9:
            break
    return np.asarray(places[np.argmin(sh.evaluate(places, degree) @ function)])
