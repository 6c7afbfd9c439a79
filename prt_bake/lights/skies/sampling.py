"""Importance sampling of a lat-long picture and its look-up, compiled.

The density over (u, v) is proportional to the bilinear look-up of the pixels' weights [H,W]; columns wrap around, and
the density is constant above the centres of the first row and below those of the last. The marginal density of v is
linear between the centres of rows, and the density along a row is linear between the centres of columns. Both are
inverted exactly, v first. Two uniform numbers therefore become one (u, v), and low-discrepancy points stay well
stratified.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from prt_bake.jit.compilation import compiled

Array = NDArray[np.float64]


class SkyTable(NamedTuple):
    """Tables of a sky for the kernels.

    image [H,W,3]: radiance. weights [H,W]. along [H,W+1]: cumulative weights along each row, from the centre of column
    0. down [H+2]: cumulative weights over v, from the top. to_object [3,3]: polar frame to object space.
    """

    image: NDArray[np.float32]
    weights: Array
    along: Array
    down: Array
    to_object: Array


def sky_table(image: NDArray[np.float32], to_object: Array) -> SkyTable:
    """Tables for drawing a pixel by its energy: the mean over channels times the sine of the row's zenith angle.

    Colours outside Rec.709 have negative channels, but hardly ever a negative mean; such a pixel is not drawn.
    """
    height = len(image)
    sines = np.sin(np.pi * (np.arange(height) + 0.5) / height)
    weights = np.maximum(image.mean(axis=2, dtype=np.float64), 0.0) * sines[:, None]
    steps = 0.5 * (weights + np.roll(weights, -1, axis=1))
    along = np.concatenate([np.zeros((height, 1)), np.cumsum(steps, axis=1)], axis=1)
    rows = along[:, -1]
    falls = np.concatenate([[0.5 * rows[0]], 0.5 * (rows[:-1] + rows[1:]), [0.5 * rows[-1]]])
    down = np.concatenate([[0.0], np.cumsum(falls)])
    return SkyTable(np.ascontiguousarray(image, np.float32), weights, along, down, np.ascontiguousarray(to_object))


@compiled(nogil=True, error_model="numpy")
def draw_directions(sky: Any, numbers: Any, directions: Any) -> None:
    """Set directions [N,3], in object space, from numbers [N,2 or more] in [0,1)."""
    height, width = sky.weights.shape
    for n in range(len(numbers)):
        v, top, bottom, share = _draw_row(sky, numbers[n, 0], height)
        target = numbers[n, 1] * ((1.0 - share) * sky.along[top, width] + share * sky.along[bottom, width])
        low, high = 0, width
        while high - low > 1:
            middle = (low + high) // 2
            if (1.0 - share) * sky.along[top, middle] + share * sky.along[bottom, middle] <= target:
                low = middle
            else:
                high = middle
        right = (low + 1) % width
        at_left = (1.0 - share) * sky.weights[top, low] + share * sky.weights[bottom, low]
        at_right = (1.0 - share) * sky.weights[top, right] + share * sky.weights[bottom, right]
        rest = target - ((1.0 - share) * sky.along[top, low] + share * sky.along[bottom, low])
        u = (low + 0.5 + _invert_linear(at_left, at_right, rest)) / width
        phi, theta = 2.0 * math.pi * (u - 0.5), math.pi * v
        sine = math.sin(theta)
        x, y, z = math.cos(phi) * sine, math.sin(phi) * sine, math.cos(theta)
        for k in range(3):
            directions[n, k] = sky.to_object[k, 0] * x + sky.to_object[k, 1] * y + sky.to_object[k, 2] * z


@compiled(nogil=True, error_model="numpy")
def look_up(sky: Any, directions: Any, radiance: Any, density: Any) -> None:
    """Add the radiance [N,3] of directions [N,3], and set their density per solid angle [N]."""
    height, width = sky.weights.shape
    per_uv = height * width / sky.down[height + 1] if sky.down[height + 1] > 0.0 else 0.0
    for n in range(len(directions)):
        x = y = z = 0.0
        for k in range(3):
            x += sky.to_object[k, 0] * directions[n, k]
            y += sky.to_object[k, 1] * directions[n, k]
            z += sky.to_object[k, 2] * directions[n, k]
        sine = math.hypot(x, y)
        row = min(max(math.atan2(sine, z) / math.pi * height - 0.5, 0.0), height - 1.0)
        column = (math.atan2(y, x) / (2.0 * math.pi) + 0.5) * width - 0.5
        top, left = math.floor(row), math.floor(column)
        bottom, down, across = min(top + 1, height - 1), row - top, column - left
        left, right = left % width, (left + 1) % width
        corners = (1.0 - down) * (1.0 - across), (1.0 - down) * across, down * (1.0 - across), down * across
        for k in range(3):
            radiance[n, k] += (
                corners[0] * sky.image[top, left, k]
                + corners[1] * sky.image[top, right, k]
                + corners[2] * sky.image[bottom, left, k]
                + corners[3] * sky.image[bottom, right, k]
            )
        weight = (
            corners[0] * sky.weights[top, left]
            + corners[1] * sky.weights[top, right]
            + corners[2] * sky.weights[bottom, left]
            + corners[3] * sky.weights[bottom, right]
        )
        # The density has no bound at the pole; rounding keeps drawn directions off it.
        density[n] = weight * per_uv / (2.0 * math.pi**2 * max(sine, 1e-300))


@compiled(nogil=True, error_model="numpy")
def _draw_row(sky: Any, number: Any, height: Any) -> Any:
    """v, the rows whose centres are above and below it, and the interpolation weight of the lower row."""
    target = number * sky.down[height + 1]
    low, high = 0, height + 1
    while high - low > 1:
        middle = (low + high) // 2
        if sky.down[middle] <= target:
            low = middle
        else:
            high = middle
    width = sky.weights.shape[1]
    top, bottom = max(low - 1, 0), min(low, height - 1)
    rest = target - sky.down[low]
    if low in (0, height):
        # Half a row with a constant density.
        total = sky.along[top, width] if low == height else sky.along[bottom, width]
        share = min(max(rest / total, 0.0), 0.5) if total > 0.0 else 0.0
        edge = bottom if low == 0 else top
        return (share if low == 0 else height - 0.5 + share) / height, edge, edge, 0.0
    share = _invert_linear(sky.along[top, width], sky.along[bottom, width], rest)
    return (top + 0.5 + share) / height, top, bottom, share


@compiled(nogil=True, error_model="numpy")
def _invert_linear(first: Any, last: Any, area: Any) -> Any:
    """The x in [0, 1] at which the area under the line from `first` (at 0) to `last` (at 1) reaches `area`."""
    root = math.sqrt(max(first * first + 2.0 * (last - first) * area, 0.0))
    return min(2.0 * area / (first + root), 1.0) if first + root > 0.0 and area > 0.0 else 0.0
