"""Lobes rounded to few digits, which files compress better."""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from formats.asset.lobes import Lobes
from prt_bake.lobes.gaussians import inner_product

Array = NDArray[np.float64]

_MOST_DIGITS = 12
_AT_ONCE = 1024
"""Vertices whose lobes are compared at once."""


def rounded(lobes: Lobes, allowed: float) -> tuple[Lobes, float]:
    """The lobes with as few digits as change them by at most `allowed` (`change`), and their change.

    Axes and powers become multiples of powers of two, the same for all lobes; the sharpness keeps its first digits.
    """
    typical = float(np.sqrt(np.square(lobes.powers, dtype=np.float64).mean()))
    power = 2.0 ** math.floor(math.log2(typical or 1.0))
    for step in range(3 * _MOST_DIGITS):
        # The digits at which the three contribute alike, one more of each in turn.
        powers, axes, sharpness = (step + 2) // 3, 2 + (step + 1) // 3, step // 3
        coarse = _with_digits(lobes, power * 0.5**powers, 0.5**axes, sharpness)
        changed = change(lobes, coarse)
        if changed <= allowed:
            return coarse, changed
    return lobes, 0.0


def _with_digits(lobes: Lobes, power: float, axis: float, bits: int) -> Lobes:
    powers = power * np.rint(lobes.powers / power)
    axes = axis * np.rint(lobes.axes / axis)
    fraction, exponent = np.frexp(lobes.sharpness)
    sharpness = np.ldexp(np.rint(np.ldexp(fraction, bits + 1)), exponent - bits - 1)
    nothing = ~powers.any(axis=3)
    axes[nothing], sharpness[nothing] = (0.0, 0.0, 1.0), 1.0
    return replace(lobes, axes=axes, sharpness=sharpness, powers=powers)


def change(lobes: Lobes, others: Lobes) -> float:
    """The root of the sum over vertices, nodes and lobes of ∫ |lobe − other|² over the sphere, in RGB."""
    squares = 0.0
    for first in range(0, len(lobes.powers), _AT_ONCE):
        rows = slice(first, first + _AT_ONCE)
        one, powers = _in_float64(lobes, rows)
        other, other_powers = _in_float64(others, rows)
        squares += float((np.square(powers).sum(axis=3) * inner_product(*one, *one)).sum())
        squares += float((np.square(other_powers).sum(axis=3) * inner_product(*other, *other)).sum())
        squares -= 2.0 * float(((powers * other_powers).sum(axis=3) * inner_product(*one, *other)).sum())
    return math.sqrt(max(0.0, squares))


def _in_float64(lobes: Lobes, rows: slice) -> tuple[tuple[Array, Array], Array]:
    """Unit axes and sharpness, and powers, of some vertices."""
    axes, sharpness, powers = (part[rows].astype(np.float64) for part in (lobes.axes, lobes.sharpness, lobes.powers))
    return (axes / np.linalg.norm(axes, axis=3, keepdims=True), sharpness), powers
