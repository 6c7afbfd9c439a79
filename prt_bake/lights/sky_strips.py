"""The sums of `sky_kernels` for pictures whose halves are multiples of `STEP` columns wide, as most are: by strips of a
row and of what lies half a turn away, summed and shrunk while they are in the first cache.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from prt_bake.jit.compilation import compiled
from prt_bake.jit.strip_vectors import STEP, STRIDE, short_sums, strip_sums, strip_sums_added, strip_sums_set
from prt_bake.jit.vectors import as_double
from prt_bake.lights.sky_sums import Planes
from prt_bake.mathematics.box_filter import BoxFilter

Array = NDArray[np.float64]

STRIP = 512
"""Columns of a strip and of the one opposite, at most."""
_NOT, _SET, _ADD = 0, 1, 2
"""What is done to a total."""


class StripWaves(NamedTuple):
    """The waves sin mφ and cos mφ over a strip, and where strips begin.

    waves: of pairs of m, (1, 2), (3, 4) …: sine and cosine of each, integrated over columns, from the middle of a
        strip's first column on; `STRIDE` numbers each, one after another.
    turns: [S, degree + 2, 2], cosine and sine of m times the angle of the middle of each strip's first column.
    column: the angle that a column takes.
    """

    waves: Array
    turns: Array
    column: float


class Copy(NamedTuple):
    """How a picture's columns are shrunk, and what is told of the copy's own: its waves where its width is even.

    azimuth: the copy's waves; half: columns of half a copy, up to a multiple of `STEP`, or 0 where none are wanted.
    """

    across: BoxFilter
    azimuth: StripWaves
    half: int


def fits(width: int) -> bool:
    """Whether pictures of this width come in whole strips."""
    return width % (2 * STEP) == 0


def strip_waves(width: int, degree: int) -> StripWaves:
    """The waves of degrees up to `degree` for pictures of `width` columns."""
    column = 2.0 * math.pi / width
    m = np.arange(1, max(2, degree + degree % 2) + 1)
    angles = m[:, None] * column * np.arange(STRIP)
    waves = np.zeros((len(m), 2, STRIDE))
    waves[:, :, :STRIP] = np.stack([np.sin(angles), np.cos(angles)], axis=1)
    waves *= (2.0 * np.sin(0.5 * m * column) / m)[:, None, None]
    begins = column * (np.arange(0, width // 2 + STEP, STRIP) + 0.5) - math.pi
    starts = begins[:, None] * np.arange(len(m) + 1)
    return StripWaves(waves.ravel(), np.stack([np.cos(starts), np.sin(starts)], axis=2), column)


def copy_of(across: BoxFilter, degree: int) -> Copy:
    """What a copy takes whose columns are means `across`."""
    width = len(across.begins)
    half = -(-width // (2 * STEP)) * STEP if width % 2 == 0 else 0
    return Copy(across, strip_waves(width, degree), half)


@compiled(nogil=True, fastmath={"contract"})
def row_waves(planes: Planes, azimuth: StripWaves, degree: int) -> Array:
    """Σ over columns of the waves' integrals · pixel for each row and channel: [R,3,M], from −degree to degree."""
    waves = np.zeros((planes.rows, 3, 2 * degree + 1))
    # A few rows at a time stay in the second cache from strip to strip.
    for first in range(0, planes.rows, 4):
        _take_rows(planes, first, min(first + 4, planes.rows), azimuth, waves)
    return waves


@compiled(nogil=True, fastmath={"contract"})
def _take_rows(planes: Planes, first: int, end: int, azimuth: StripWaves, waves: Array) -> None:
    unused = np.zeros((3, 1))
    for begin in range(0, planes.width // 2, STRIP):
        for channel in range(3):
            for row in range(first, end):
                _take_strip(planes, channel, row, begin, azimuth, waves, unused, 0.0, _NOT)


@compiled(nogil=True, fastmath={"contract"})
def waves_and_means(
    planes: Planes,
    azimuth: StripWaves,
    degree: int,
    tops: NDArray[np.int64],
    bottoms: NDArray[np.int64],
    down: Array,
    copy: Copy,
    image: NDArray[np.float32],
    image_waves: Array,
) -> Array:
    """`row_waves`; and each row n of image [h,w,3] is the means across of Σ down[n,r] · row tops[n] + r, before
    bottoms[n], image_waves [h,3,M] what `row_waves` is of it, if it is wanted.
    """
    waves = np.zeros((planes.rows, 3, 2 * degree + 1))
    across, half = copy.across, planes.width // 2
    total = np.zeros((3, planes.width + across.weights.shape[1]))
    line, middle, there = np.zeros((3, _line_length(copy)), np.float32), _opposite(across, planes.width), 0
    for n in range(len(image)):
        if tops[n] > there:
            _take_rows(planes, there, tops[n], azimuth, waves)
            there = tops[n]
        near, far = 0, middle
        for begin in range(0, half, STRIP):
            size = min(STRIP, half - begin)
            for channel in range(3):
                # A row that the mean before this one has a share of has given its waves.
                for row in range(tops[n], there):
                    share, begun = down[n, row - tops[n]], row == tops[n]
                    _add(planes, channel, row, begin, size, share, total[channel], begun)
                    _add(planes, channel, row, half + begin, size, share, total[channel], begun)
                for row in range(there, bottoms[n]):
                    share, into = down[n, row - tops[n]], _SET if row == tops[n] else _ADD
                    _take_strip(planes, channel, row, begin, azimuth, waves, total, share, into)
            near = _shrink(total, copy, near, _ready(across, near, middle, begin + size), image[n], line, 0)
            far_end = _ready(across, far, len(image[n]), half + begin + size)
            far = _shrink(total, copy, far, far_end, image[n], line, copy.half - middle)
        _finish(total, copy, near, middle, image[n], line, 0)
        _finish(total, copy, far, len(image[n]), image[n], line, copy.half - middle)
        _line_waves(line, copy, degree, image_waves[n : n + 1])
        there = max(there, bottoms[n])
    _take_rows(planes, there, planes.rows, azimuth, waves)
    return waves


@compiled(nogil=True, fastmath={"contract"})
def shrink_line(
    total: Array, width: int, copy: Copy, degree: int, image: NDArray[np.float32], image_waves: Array
) -> None:
    """A row of an image [w,3] from its sums total [3, W and as many zeros as a mean has terms], and its waves [1,3,M],
    as `waves_and_means` makes them.
    """
    middle, line = _opposite(copy.across, width), np.zeros((3, _line_length(copy)), np.float32)
    _finish(total, copy, 0, middle, image, line, 0)
    _finish(total, copy, middle, len(image), image, line, copy.half - middle)
    _line_waves(line, copy, degree, image_waves)


@compiled(nogil=True)
def _opposite(across: BoxFilter, width: int) -> int:
    """The first of the copy's columns in the picture's second half: that of the copy's own, where its width is even."""
    return int(np.searchsorted(across.begins, width // 2))


@compiled(nogil=True)
def _line_length(copy: Copy) -> int:
    return max(2 * copy.half, len(copy.across.begins) + STEP)


@compiled(nogil=True, fastmath={"contract"})
def _line_waves(line: NDArray[np.float32], copy: Copy, degree: int, waves: Array) -> None:
    """Set waves [1,3,M] to those of a row of the copy, whose halves lie in line [3, 2·half or more]."""
    if copy.half > 0:
        waves[:] = 0.0
        planes = Planes(line.ravel(), 0, line.shape[1], line.size, 1, 2 * copy.half)
        _take_rows(planes, 0, 1, copy.azimuth, waves)


@compiled(nogil=True, fastmath={"contract"})
def _take_strip(
    planes: Planes,
    channel: int,
    row: int,
    begin: int,
    azimuth: StripWaves,
    waves: Array,
    total: Array,
    weight: float,
    into: int,
) -> None:
    """Add what a strip of a row gives to waves [R,3,M]; add weight · the strip to total [3, W or more], or set it."""
    half, degree = planes.width // 2, waves.shape[2] // 2
    near = planes.first + channel * planes.channel_step + row * planes.row_step + begin
    numbers, far, size, turns = planes.numbers, near + half, min(STRIP, half - begin), azimuth.turns
    table, here, there, strip = azimuth.waves, begin, begin + half, begin // STRIP
    sums_of = total[channel]
    for m in range(1, max(2, degree + 1), 2):
        first = 2 * (m - 1) * STRIDE
        if into == _NOT or m > 1:
            sums = strip_sums(numbers, near, far, size, table, first, sums_of, here, there, weight)
        elif into == _SET:
            sums = strip_sums_set(numbers, near, far, size, table, first, sums_of, here, there, weight)
        else:
            sums = strip_sums_added(numbers, near, far, size, table, first, sums_of, here, there, weight)
        if m == 1:
            waves[row, channel, degree] += azimuth.column * sums[0]
        for k in range(min(2, degree + 1 - m)):
            cosine, sine = turns[strip, m + k, 0], turns[strip, m + k, 1]
            waves[row, channel, degree - m - k] += cosine * sums[1 + 2 * k] + sine * sums[2 + 2 * k]
            waves[row, channel, degree + m + k] += cosine * sums[2 + 2 * k] - sine * sums[1 + 2 * k]


@compiled(nogil=True, fastmath={"contract"})
def _add(
    planes: Planes, channel: int, row: int, begin: int, size: int, weight: float, total: Array, begun: bool
) -> None:
    """Add weight · the columns from `begin` on of a row to total [W], or set it where it is begun."""
    place = planes.first + channel * planes.channel_step + row * planes.row_step + begin
    pixels, sums = planes.numbers[place : place + size], total[begin : begin + size]
    if begun:
        for i in range(size):
            sums[i] = weight * as_double(pixels[i])
    else:
        for i in range(size):
            sums[i] += weight * as_double(pixels[i])


@compiled(nogil=True)
def _ready(across: BoxFilter, first: int, end: int, columns: int) -> int:
    """Up to which mean of those from `first` to before `end` all terms lie before `columns`, in steps of 4 from
    `first`: `short_sums` takes as many at a time.
    """
    last = columns - across.weights.shape[1]
    return first + int(np.searchsorted(across.begins[first:end], last, "right")) // 4 * 4


@compiled(nogil=True)
def _shrink(
    total: Array, copy: Copy, first: int, end: int, image: NDArray[np.float32], line: NDArray[np.float32], shift: int
) -> int:
    """The means across of total from `first` to before `end`, a multiple of 4 of them, into image [w,3] and, `shift`
    later, line [3, w or more]; returns `end`.
    """
    shift = shift if copy.half > 0 else 0
    begins, shares, length = copy.across.begins, copy.across.weights, line.shape[1]
    short_sums(total, total.shape[1], begins, shares, shares.shape[1], first, end - first, image, line, length, shift)
    return end


@compiled(nogil=True, fastmath={"contract"})
def _finish(
    total: Array, copy: Copy, first: int, end: int, image: NDArray[np.float32], line: NDArray[np.float32], shift: int
) -> None:
    """As `_shrink`, of as many as there are: those that are left one by one."""
    shift = shift if copy.half > 0 else 0
    first = _shrink(total, copy, first, first + (end - first) // 4 * 4, image, line, shift)
    begins, shares = copy.across.begins, copy.across.weights
    for j in range(first, end):
        for channel in range(3):
            mean = 0.0
            for k in range(shares.shape[1]):
                mean += shares[j, k] * total[channel, begins[j] + k]
            image[j, channel] = mean
            line[channel, j + shift] = image[j, channel]
