"""A prefiltered sky: averages over solid angles of any size, which lobes look up without noise.

The levels are maps on the equal-area octahedron (Clarberg 2008, "Fast equal-area mapping of the (hemi)sphere using
SIMD"). All texels of a level have the same solid angle, and four texels are exactly one of the next level. The
octahedron is in the polar frame of the sky, so that a turned sky has the same texels.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from prt_bake.jit.compilation import compiled
from prt_bake.jit.threads import in_threads

Array = NDArray[np.float64]

_LARGEST = 1024
_DIRECTIONS_A_SLICE = 4096
_ALONG = 4
"""Look-ups along each side of a texel: even a sun of one pixel keeps its energy."""


class PrefilteredSky(NamedTuple):
    """A pyramid of averages.

    levels: float32 [n_k,n_k,3], each half as wide as the one before; the last has one texel. to_polar [3,3]: object
    space to the polar frame.
    """

    levels: tuple[NDArray[np.float32], ...]
    to_polar: Array


def prefilter(image: NDArray[np.float32], to_object: Array, finest: float = 0.0) -> PrefilteredSky:
    """Average a lat-long picture [H,W,3] over texels of at most `finest` steradians, and over all coarser ones.

    The finest level has no more detail than the picture, and at most 1024 texels along a side. to_object [3,3]: polar
    frame to object space.
    """
    image = np.ascontiguousarray(image, np.float32)
    # Twice as fine as the picture, to resolve its bilinear tents, and fine enough not to skip its columns.
    detail = 2.0 * math.sqrt(2.0 / math.pi * image.shape[0] * image.shape[1])
    wanted = min(detail, math.sqrt(4.0 * math.pi / finest)) if finest > 0.0 else detail
    size = min(_LARGEST, 1 << math.ceil(math.log2(max(wanted, _lookup_size(image.shape[1]), 1.0))))
    texels = np.zeros((size, size, 3), np.float32)
    in_threads(_average, size, _reduced(image, size), texels)
    levels = [texels]
    while len(levels[-1]) > 1:
        last = 0.25 * levels[-1]  # before the sum, which may exceed float32
        levels.append(last[::2, ::2] + last[1::2, ::2] + last[::2, 1::2] + last[1::2, 1::2])
    return PrefilteredSky(tuple(levels), to_object.T)


def radiance(sky: PrefilteredSky, directions: Array, solid_angles: Array) -> Array:
    """Mean radiance [N,3] over about `solid_angles` [N] (steradians) around unit `directions` [N,3]."""
    total = np.zeros(directions.shape)
    level = np.array([len(part) for part in sky.levels])
    starts = np.concatenate([[0], np.cumsum(level * level)])
    texels = np.concatenate([part.reshape(-1, 3) for part in sky.levels])
    local = np.ascontiguousarray(directions @ sky.to_polar.T)
    angles = np.ascontiguousarray(solid_angles, np.float64)
    in_threads(_look_up, len(local), texels, level, starts, local, angles, total, least=_DIRECTIONS_A_SLICE)
    return total


def texel_directions(size: int) -> Array:
    """Unit directions [size,size,3] of the centres of the texels of a level, in the polar frame."""
    directions = np.empty((size, size, 3))
    in_threads(_fill_directions, size, directions)
    return directions


def texel_numbers(directions: Array, size: int) -> NDArray[np.int64]:
    """The texels [N], row · size + column, of a level that contain unit directions [N,3] of the polar frame."""
    numbers = np.empty(len(directions), np.int64)
    in_threads(_find_texels, len(directions), np.ascontiguousarray(directions), size, numbers)
    return numbers


def _reduced(image: NDArray[np.float32], size: int) -> NDArray[np.float32]:
    """The picture, or means over blocks of its pixels if it is finer than the look-ups of a level of `size`."""
    height, width = image.shape[:2]
    wanted = math.ceil(_lookup_size(width) / size)
    step = next((side for side in range(wanted, 4 * wanted) if height % side == 0 and width % side == 0), 1)
    if step == 1:
        return image
    return np.ascontiguousarray(image.reshape(height // step, step, width // step, step, 3).mean(axis=(1, 3)))


def _lookup_size(width: int) -> float:
    """The texels along a side whose look-ups are as far apart as the columns of a picture are on the horizon."""
    return width / (2.0 * math.pi) * math.sqrt(4.0 * math.pi) / _ALONG


@compiled(nogil=True, error_model="numpy")
def _average(first: Any, stop: Any, image: Any, texels: Any) -> None:
    """Set the rows `first` to `stop` of texels [n,n,3] to the means of the picture over them."""
    size = texels.shape[0]
    height, width = image.shape[0], image.shape[1]
    for row in range(first, stop):
        for column in range(size):
            for sample in range(_ALONG * _ALONG):
                u = (column + (sample % _ALONG + 0.5) / _ALONG) / size
                v = (row + (sample // _ALONG + 0.5) / _ALONG) / size
                x, y, z = _to_direction(u, v)
                down = min(max(math.atan2(math.hypot(x, y), z) / math.pi * height - 0.5, 0.0), height - 1.0)
                across = (math.atan2(y, x) / (2.0 * math.pi) + 0.5) * width - 0.5
                top, left = math.floor(down), math.floor(across)
                bottom, low, right = min(top + 1, height - 1), down - top, across - left
                left, beside = left % width, (left + 1) % width
                for c in range(3):
                    texels[row, column, c] += (
                        (1.0 - low) * ((1.0 - right) * image[top, left, c] + right * image[top, beside, c])
                        + low * ((1.0 - right) * image[bottom, left, c] + right * image[bottom, beside, c])
                    ) / (_ALONG * _ALONG)


@compiled(nogil=True, error_model="numpy")
def _fill_directions(first: Any, stop: Any, directions: Any) -> None:
    size = directions.shape[0]
    for row in range(first, stop):
        for column in range(size):
            x, y, z = _to_direction((column + 0.5) / size, (row + 0.5) / size)
            directions[row, column, 0], directions[row, column, 1], directions[row, column, 2] = x, y, z


@compiled(nogil=True, error_model="numpy")
def _find_texels(first: Any, stop: Any, directions: Any, size: Any, numbers: Any) -> None:
    for n in range(first, stop):
        u, v = to_square(directions[n, 0], directions[n, 1], directions[n, 2])
        numbers[n] = min(int(v * size), size - 1) * size + min(int(u * size), size - 1)


@compiled(nogil=True, error_model="numpy")
def _look_up(
    first: Any, stop: Any, texels: Any, sizes: Any, starts: Any, directions: Any, solid_angles: Any, total: Any
) -> None:
    last = len(sizes) - 1
    finest = 4.0 * math.pi / (sizes[0] * sizes[0])
    for n in range(first, stop):
        u, v = to_square(directions[n, 0], directions[n, 1], directions[n, 2])
        level = min(max(0.5 * math.log2(max(solid_angles[n] / finest, 1.0)), 0.0), float(last))
        fine = min(int(level), last)
        coarse, share = min(fine + 1, last), level - fine
        add_bilinear(texels, starts[fine], sizes[fine], u, v, 1.0 - share, total[n])
        if share > 0.0:
            add_bilinear(texels, starts[coarse], sizes[coarse], u, v, share, total[n])


@compiled(error_model="numpy")
def add_bilinear(texels: Any, start: Any, size: Any, u: Any, v: Any, weight: Any, total: Any) -> None:
    """Add to total [3] `weight` times the texels [T,3] of a level, interpolated at (u, v)."""
    x, y = u * size - 0.5, v * size - 0.5
    left, top = math.floor(x), math.floor(y)
    right, down = x - left, y - top
    for corner in range(4):
        i, j = corner % 2, corner // 2
        share = (right if i else 1.0 - right) * (down if j else 1.0 - down)
        column, row = _wrapped(int(left) + i, int(top) + j, size)
        texel = texels[start + row * size + column]
        for c in range(3):
            total[c] += weight * share * texel[c]


@compiled(error_model="numpy")
def _wrapped(column: Any, row: Any, size: Any) -> Any:
    """The texel beyond an edge of the map: each edge is folded on itself about its middle."""
    if column < 0 or column >= size:
        column = min(max(column, 0), size - 1)
        row = size - 1 - row
    if row < 0 or row >= size:
        row = min(max(row, 0), size - 1)
        column = size - 1 - column
    return column, row


@compiled(error_model="numpy")
def to_square(x: Any, y: Any, z: Any) -> Any:
    """The (u, v) in [0, 1]² of a unit direction."""
    r = math.sqrt(max(0.0, (x * x + y * y) / (1.0 + abs(z))))
    turn = math.atan2(abs(y), abs(x)) * 2.0 / math.pi
    v = turn * r
    u = r - v
    if z < 0.0:
        u, v = 1.0 - v, 1.0 - u
    return 0.5 + 0.5 * math.copysign(u, x), 0.5 + 0.5 * math.copysign(v, y)


@compiled(error_model="numpy")
def _to_direction(u: Any, v: Any) -> Any:
    """The unit direction at (u, v) in [0, 1]²."""
    a, b = 2.0 * u - 1.0, 2.0 * v - 1.0
    p, q = abs(a), abs(b)
    below = 1.0 - (p + q)
    r = 1.0 - abs(below)
    turn = math.pi / 4.0 * ((q - p) / r + 1.0) if r > 0.0 else 0.0
    flat = r * math.sqrt(max(0.0, 2.0 - r * r))
    z = math.copysign(1.0 - r * r, below)
    return math.copysign(flat * math.cos(turn), a), math.copysign(flat * math.sin(turn), b), z
