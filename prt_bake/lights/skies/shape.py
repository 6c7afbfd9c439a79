"""Whether a picture can be a lat-long sky: cube maps are refused, shapes other than 2:1 are reported."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from formats.errors import ImageError
from formats.image.rows import ImageRows

_ASPECT = 2.0
_TOLERANCE = 0.01
_MIN_FACE = 4
"""Pixels: a smaller picture may have the shape of a cube map by chance."""

# Rows and columns of faces: horizontal and vertical crosses, and strips.
_CROSSES = ((3, 4), (4, 3))
_STRIPS = ((1, 6), (6, 1))


def refuse_cube_maps(rows: ImageRows) -> None:
    """Raise ImageError if the header says that the picture is a cube map, or if its layout is that of one.

    The layouts are a strip of six squares, and a cross of squares on an empty background. A picture of the shape of a
    cross is read completely.
    """
    layout = "its header says so" if rows.cube else _layout(rows)
    if layout:
        raise ImageError(
            f"{rows.path}: is a cube map ({layout}); expected a lat-long picture, twice as wide as high: convert it, "
            "for example in Blender or with cmft, or choose the equirectangular file where both are offered"
        )


def report_stretching(rows: ImageRows, say: Callable[[str], None]) -> None:
    """Call `say` if a picture of more than one pixel is not twice as wide as high."""
    aspect = rows.width / rows.height
    if rows.height * rows.width > 1 and abs(aspect / _ASPECT - 1.0) > _TOLERANCE:
        say(
            f"is {rows.width}x{rows.height} pixels, but a lat-long picture is twice as wide as high; it is stretched "
            "over all directions"
        )


def _layout(rows: ImageRows) -> str:
    for down, across in (*_STRIPS, *_CROSSES):
        face = rows.height // down
        if face < _MIN_FACE or (rows.height, rows.width) != (down * face, across * face):
            continue
        if (down, across) in _STRIPS:
            return f"{across}x{down} squares"
        if _is_cross(rows, face):
            return "a cross of six squares"
    return ""


def _is_cross(rows: ImageRows, face: int) -> bool:
    """Whether six of the twelve squares form a cross, and the others are of one colour."""
    shape = rows.height // face, rows.width // face
    low, high = np.full(shape, np.inf), np.full(shape, -np.inf)
    for first, block in rows.blocks():
        for down in range(first // face, (first + len(block) - 1) // face + 1):
            part = block[max(0, down * face - first) : (down + 1) * face - first]
            low[down] = np.minimum(low[down], _per_square(part, face, np.min))
            high[down] = np.maximum(high[down], _per_square(part, face, np.max))
    plain = low == high
    return bool(plain.sum() == 6 and np.ptp(low[plain]) == 0 and _has_arms(~plain))


def _per_square(part: NDArray[np.floating], face: int, extreme: Callable[..., NDArray[np.floating]]) -> list[float]:
    return [float(extreme(part[:, start : start + face])) for start in range(0, part.shape[1], face)]


def _has_arms(filled: NDArray[np.bool_]) -> bool:
    """Whether one line of four squares is filled, and one square on each side of it."""
    lines = filled if filled.shape == (3, 4) else filled.T
    return bool(lines[1].all() and lines[0].sum() == lines[2].sum() == 1)
