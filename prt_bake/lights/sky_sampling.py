"""Drawing from a lat-long picture and looking it up, compiled.

The density over the picture is bilinear, as the light is: with weights W [H,W] of pixels it is proportional, over
places (u, v), to the bilinear look-up of W (columns wrap around, above the first row's centres and below the last row's
it stays level). Over v alone it is linear between the centres of rows, along a row linear between the centres of
columns: both are inverted exactly, v first, so that two uniform numbers become one place, and numbers that lie evenly
in the square become places that lie evenly in the light.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from prt_bake.jit.compilation import compiled

Array = NDArray[np.float64]


class SkyTable(NamedTuple):
    """What the kernels need of a sky.

    image [H,W,3] radiance; weights [H,W]; along [H,W+1] sums of the weights from the centre of column 0 on; down [H+2]
    sums over v from the top; to_object [3,3] from the frame whose +z is up and whose azimuth is φ to object space.
    """

    image: NDArray[np.float32]
    weights: Array
    along: Array
    down: Array
    to_object: Array


def sky_table(image: NDArray[np.float32], to_object: Array) -> SkyTable:
    """Weights are the mean over channels times the sine of the row's zenith angle: the energy of a pixel."""
    height = len(image)
    sines = np.sin(np.pi * (np.arange(height) + 0.5) / height)
    weights = image.mean(axis=2, dtype=np.float64) * sines[:, None]
    steps = 0.5 * (weights + np.roll(weights, -1, axis=1))
    along = np.concatenate([np.zeros((height, 1)), np.cumsum(steps, axis=1)], axis=1)
    rows = along[:, -1]
    falls = np.concatenate([[0.5 * rows[0]], 0.5 * (rows[:-1] + rows[1:]), [0.5 * rows[-1]]])
    down = np.concatenate([[0.0], np.cumsum(falls)])
    return SkyTable(np.ascontiguousarray(image, np.float32), weights, along, down, np.ascontiguousarray(to_object))


@compiled(nogil=True, error_model="numpy")
def draw_directions(sky: Any, numbers: Any, directions: Any) -> None:
    """From numbers [N,2 or more] in [0,1) directions [N,3] in object space."""
    height, width = sky.weights.shape
    for n in range(len(numbers)):
        v, top, bottom, share = _draw_row(sky, numbers[n, 0], height)
        wanted = numbers[n, 1] * ((1.0 - share) * sky.along[top, width] + share * sky.along[bottom, width])
        low, high = 0, width
        while high - low > 1:
            middle = (low + high) // 2
            if (1.0 - share) * sky.along[top, middle] + share * sky.along[bottom, middle] <= wanted:
                low = middle
            else:
                high = middle
        right = (low + 1) % width
        here = (1.0 - share) * sky.weights[top, low] + share * sky.weights[bottom, low]
        there = (1.0 - share) * sky.weights[top, right] + share * sky.weights[bottom, right]
        rest = wanted - ((1.0 - share) * sky.along[top, low] + share * sky.along[bottom, low])
        u = (low + 0.5 + _within(here, there, rest)) / width
        phi, theta = 2.0 * math.pi * (u - 0.5), math.pi * v
        sine = math.sin(theta)
        x, y, z = math.cos(phi) * sine, math.sin(phi) * sine, math.cos(theta)
        for k in range(3):
            directions[n, k] = sky.to_object[k, 0] * x + sky.to_object[k, 1] * y + sky.to_object[k, 2] * z


@compiled(nogil=True, error_model="numpy")
def look_up(sky: Any, directions: Any, radiance: Any, density: Any) -> None:
    """Add the radiance [N,3] from directions [N,3]; set the density per solid angle [N] with which they are drawn."""
    height, width = sky.weights.shape
    per_place = height * width / sky.down[height + 1] if sky.down[height + 1] > 0.0 else 0.0
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
        # At the very pole the density has no bound; what is drawn there is rounded off it.
        density[n] = weight * per_place / (2.0 * math.pi**2 * max(sine, 1e-300))


@compiled(nogil=True, error_model="numpy")
def _draw_row(sky: Any, number: Any, height: Any) -> Any:
    """v, the rows of centres above and below it, and the share of the lower one."""
    wanted = number * sky.down[height + 1]
    low, high = 0, height + 1
    while high - low > 1:
        middle = (low + high) // 2
        if sky.down[middle] <= wanted:
            low = middle
        else:
            high = middle
    width = sky.weights.shape[1]
    top, bottom = max(low - 1, 0), min(low, height - 1)
    rest = wanted - sky.down[low]
    if low in (0, height):
        # Half a row high, and level.
        whole = sky.along[top, width] if low == height else sky.along[bottom, width]
        share = min(max(rest / whole, 0.0), 0.5) if whole > 0.0 else 0.0
        edge = bottom if low == 0 else top
        return (share if low == 0 else height - 0.5 + share) / height, edge, edge, 0.0
    share = _within(sky.along[top, width], sky.along[bottom, width], rest)
    return (top + 0.5 + share) / height, top, bottom, share


@compiled(nogil=True, error_model="numpy")
def _within(here: Any, there: Any, area: Any) -> Any:
    """Where in [0, 1] the area under the line from `here` to `there` reaches `area`."""
    root = math.sqrt(max(here * here + 2.0 * (there - here) * area, 0.0))
    return min(2.0 * area / (here + root), 1.0) if here + root > 0.0 and area > 0.0 else 0.0
