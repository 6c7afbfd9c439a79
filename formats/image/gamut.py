"""Linear RGB with other primaries or another white, converted to Rec.709.

Primaries and white as CIE 1931 (x, y) chromaticities (SMPTE RP 177:1993 derives RGB to XYZ from them). White points are
adapted with the Bradford transform (Lam 1985; ICC.1:2022, annex E). Radiance is not limited: colours outside Rec.709
have a negative channel.
"""

import os
from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from formats.errors import warn

Matrix = NDArray[np.float64]

REC709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
"""x and y of red, green, blue and white."""
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""Luminance of linear Rec.709 RGB (ITU-R BT.709-6)."""
REC2020 = (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, 0.3127, 0.3290)
P3_D65 = (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, 0.3127, 0.3290)
ACES_AP0 = (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.077, 0.32168, 0.33767)
ACES_AP1 = (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, 0.32168, 0.33767)
ADOBE_RGB = (0.64, 0.33, 0.21, 0.71, 0.15, 0.06, 0.3127, 0.3290)
_NAMES = {
    "Rec.2020": REC2020,
    "P3 D65": P3_D65,
    "ACES AP0": ACES_AP0,
    "ACES AP1": ACES_AP1,
    "Adobe RGB": ADOBE_RGB,
}
_TOLERANCE = 0.001
"""Chromaticities that differ less are equal: files round D65 and the primaries in several ways."""
_FARTHEST = 100.0
"""Chromaticities of greater size are damage."""
_BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])


class Primaries(NamedTuple):
    """What a file says about its primaries.

    source: where it says so, for messages. chromaticities: x and y of red, green, blue and white; empty if what the
    file says is not understood.
    """

    source: str
    chromaticities: tuple[float, ...]


def matrix_to_rec709(path: str | os.PathLike[str], primaries: Primaries | None) -> Matrix | None:
    """Return the matrix [3,3] from linear RGB to Rec.709, or None if there is nothing to convert.

    Without primaries, or with those of Rec.709, there is no warning.
    """
    if primaries is None or are_equal(primaries.chromaticities, REC709):
        return None
    try:
        matrix = _rec709_from(primaries.chromaticities)
    except (np.linalg.LinAlgError, ValueError):
        warn(f"{path}: {primaries.source} is not understood; the colours are taken as linear Rec.709")
        return None
    warn(f"{path}: {primaries.source} means {_described(primaries)}; the colours are converted to Rec.709")
    return matrix


def convert(image: NDArray[Any], matrix: Matrix | None) -> NDArray[np.float32]:
    """Apply the matrix to the colours [...,3]; None leaves them as they are."""
    if matrix is None:
        return image.astype(np.float32, copy=False)
    stored = np.moveaxis(image.astype(np.float32, copy=False), -1, 0)
    result = np.empty(image.shape, np.float32)
    with np.errstate(invalid="ignore", over="ignore"):
        # Sums of three products, not a matrix product: its rounding would depend on the number of rows.
        for channel, (r, g, b) in enumerate(matrix.tolist()):
            result[..., channel] = r * stored[0] + g * stored[1] + b * stored[2]
    return result


def converted_blocks(
    path: str | os.PathLike[str], blocks: Iterable[NDArray[Any]], matrix: Matrix, clip: bool
) -> Iterator[NDArray[np.float32]]:
    """Yield the blocks [R,W,3], converted.

    With `clip`, channels that only the conversion made negative become 0. A warning after the last block has
    their number and their share of the light.
    """
    clipped, pixels, removed, total = 0, 0, 0.0, 0.0
    for block in blocks:
        result = convert(block, matrix)
        if clip:
            outside = (result < 0) & (block >= 0).all(axis=-1, keepdims=True)
            clipped += int(outside.any(axis=-1).sum())
            pixels += outside[..., 0].size
            removed -= float(result.sum(where=outside, dtype=np.float64))
            result[outside] = 0.0
            total += float(result.sum(where=np.isfinite(result), dtype=np.float64))
        yield result
    if clipped:
        warn(
            f"{path}: {clipped} of {pixels} pixels are outside Rec.709; their negative values, "
            f"{removed / max(total, 1e-300):.2g} of the light, are set to 0"
        )


def are_equal(first: tuple[float, ...], second: tuple[float, ...]) -> bool:
    """Whether two sets of chromaticities are equal to a thousandth."""
    return len(first) == len(second) and all(abs(a - b) < _TOLERANCE for a, b in zip(first, second, strict=True))


def _rec709_from(chromaticities: tuple[float, ...]) -> Matrix:
    """Raise ValueError or LinAlgError unless they are four points, the primaries not on one line."""
    to_xyz, white = _xyz_from(chromaticities)
    rec709_to_xyz, d65 = _xyz_from(REC709)
    gains = np.diag((_BRADFORD @ d65) / (_BRADFORD @ white))
    return np.asarray(np.linalg.inv(rec709_to_xyz) @ np.linalg.inv(_BRADFORD) @ gains @ _BRADFORD @ to_xyz)


def _xyz_from(chromaticities: tuple[float, ...]) -> tuple[Matrix, Matrix]:
    """The matrix [3,3] from RGB to XYZ, and the XYZ [3] of white with Y = 1."""
    points = np.array(chromaticities, np.float64).reshape(4, 2)
    if not (np.abs(points) <= _FARTHEST).all() or points[3, 1] < 1.0 / _FARTHEST:
        raise ValueError("chromaticities")
    xyz = np.column_stack([points, 1.0 - points.sum(axis=1)])
    if abs(np.linalg.det(xyz[:3])) < 1e-6:
        raise ValueError("chromaticities")
    white = xyz[3] / xyz[3, 1]
    return xyz[:3].T * np.linalg.solve(xyz[:3].T, white), white


def _described(primaries: Primaries) -> str:
    for name, chromaticities in _NAMES.items():
        if are_equal(primaries.chromaticities, chromaticities):
            return name
    numbers = [f"{number:.4g}" for number in primaries.chromaticities]
    points = (f"{colour} ({x}, {y})" for colour, x, y in zip(_COLOURS, numbers[::2], numbers[1::2], strict=True))
    return ", ".join(points)


_COLOURS = ("red", "green", "blue", "white")
