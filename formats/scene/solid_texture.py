"""Solid textures: procedural patterns in space that give the weight of a second substance at each point.

A pattern sums gradient noise on a lattice (Perlin, "Improving Noise", 2002), its gradients hashed from the
lattice point, the octave and the seed with the finaliser of SplitMix64 (Steele, Lea, Flood 2014). The
noise uses sums, products, quotients, square roots and rounding only, so every platform computes the same numbers.
"""

from collections.abc import Callable
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Pattern = Literal["noise", "veins", "turbulence"]
THRESHOLDS: dict[Pattern, tuple[float, float]] = {
    "noise": (0.4, 0.6),
    "veins": (0.7, 0.95),
    "turbulence": (0.3, 0.5),
}
"""The default thresholds of each pattern."""

_DEVIATION = 0.1909436  # standard deviation of one octave of the noise, over space and seeds
_STEPS = 2.0**16  # weights are rounded to multiples of its inverse, which hides differences in the last digits
_GOLDEN = 0x9E3779B97F4A7C15
_OFFSET = (
    0.3819660112501051,
    0.7548776662466927,
    0.5698402909980532,
)  # shift of the lattice per octave


def blend_weight(
    points: NDArray[np.float64],
    pattern: Pattern,
    feature: float,
    seed: int = 0,
    octaves: int = 4,
    thresholds: tuple[float, float] | None = None,
) -> NDArray[np.float64]:
    """Return the weight of the second substance at each point, from 0 to 1.

    Args:
        points: positions [...,3], in scene units.
        pattern: "noise" (soft blobs), "veins" (thin sheets where the noise crosses zero) or "turbulence" (billows with
            sharp creases).
        feature: size of the largest features, in scene units.
        seed: selects a pattern, from 0 to 2⁶⁴ − 1.
        octaves: number of octaves, each with half the feature size and half the amplitude of the one before.
        thresholds: the weight is 0 below the first and 1 above the second value of the pattern's field, and smooth
            between them. The field of noise has mean ½ and standard deviation 1/6; that of veins is 1 in the middle of
            a vein and 0 one standard deviation from it; that of turbulence is 0 in the creases and 0.32 on average.
            `THRESHOLDS` by default.

    Returns:
        Weights [...], float64, multiples of 2⁻¹⁶.
    """
    low, high = thresholds or THRESHOLDS[pattern]
    field = _FIELDS[pattern](np.asarray(points, np.float64) / feature, seed, octaves)
    t = np.clip((field - low) / (high - low), 0.0, 1.0)
    rounded: NDArray[np.float64] = np.rint(t * t * (3.0 - 2.0 * t) * _STEPS) / _STEPS
    return rounded


def gradient_noise(points: NDArray[np.float64], seed: int, octave: int = 0) -> NDArray[np.float64]:
    """Return one octave of gradient noise at points [...,3]: features of size 1, mean 0, within ±1.5."""
    rows = points.reshape(-1, 3)  # never a scalar, which would warn when the hash overflows
    cell = np.floor(rows)
    within = rows - cell
    smooth = within * within * within * (within * (within * 6.0 - 15.0) + 10.0)
    corner = cell.astype(np.int64)
    total = np.zeros(len(rows))
    for step in np.ndindex(2, 2, 2):
        gradient = _gradients(corner + step, seed, octave)
        away = within - step
        slope = gradient[0] * away[..., 0] + gradient[1] * away[..., 1] + gradient[2] * away[..., 2]
        faded = np.where(step, smooth, 1.0 - smooth)
        total += faded[..., 0] * faded[..., 1] * faded[..., 2] * slope
    return total.reshape(points.shape[:-1])


def _gradients(corner: NDArray[np.int64], seed: int, octave: int) -> list[NDArray[np.float64]]:
    """Return the gradient, three numbers in [−1, 1), of each lattice point [...,3]."""
    state = _mix64(np.full(corner.shape[:-1], seed, np.uint64) + np.uint64(octave * _GOLDEN % 2**64))
    for axis in range(3):
        state = _mix64(state ^ corner[..., axis].astype(np.uint64))
    bits = np.uint64(2**21 - 1)
    return [((state >> np.uint64(21 * axis)) & bits).astype(np.float64) * (2.0 / 2**21) - 1.0 for axis in range(3)]


def _mix64(state: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """The finaliser of SplitMix64, modulo 2⁶⁴."""
    state = state + np.uint64(_GOLDEN)
    state = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    state = (state ^ (state >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return state ^ (state >> np.uint64(31))


def _octave(points: NDArray[np.float64], seed: int, octave: int) -> NDArray[np.float64]:
    return gradient_noise(points * 2.0**octave + np.array(_OFFSET) * octave, seed, octave) / _DEVIATION


def _summed(points: NDArray[np.float64], seed: int, octaves: int) -> NDArray[np.float64]:
    """Return the sum of the octaves, scaled to standard deviation 1."""
    total = np.zeros(points.shape[:-1])
    for octave in range(octaves):
        total += _octave(points, seed, octave) * 0.5**octave
    return total / float(np.sqrt(sum(0.25**octave for octave in range(octaves))))


def _noise(points: NDArray[np.float64], seed: int, octaves: int) -> NDArray[np.float64]:
    return 0.5 + _summed(points, seed, octaves) / 6.0


def _veins(points: NDArray[np.float64], seed: int, octaves: int) -> NDArray[np.float64]:
    return 1.0 - np.abs(_summed(points, seed, octaves))


def _turbulence(points: NDArray[np.float64], seed: int, octaves: int) -> NDArray[np.float64]:
    total = np.zeros(points.shape[:-1])
    for octave in range(octaves):
        total += np.abs(_octave(points, seed, octave)) * 0.5**octave
    return total / (2.5 * sum(0.5**octave for octave in range(octaves)))


_FIELDS: dict[Pattern, Callable[[NDArray[np.float64], int, int], NDArray[np.float64]]] = {
    "noise": _noise,
    "veins": _veins,
    "turbulence": _turbulence,
}
