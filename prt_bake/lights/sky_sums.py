"""Sums over the rows of pictures, as kernels: the Fourier coefficients of each row, and means over rows and columns.

Pictures come as `Planes` of float64, float32, or the bits of float16 as uint16. Each number is widened to float64 where
it is read, and every sum runs in one order, whatever block a row comes in.
"""

from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.lib.stride_tricks import as_strided
from numpy.typing import NDArray

from prt_bake.jit.compilation import compiled
from prt_bake.jit.vectors import as_double

Array = NDArray[np.float64]

THREADS = min(4, int(vars(numba.config)["NUMBA_NUM_THREADS"]))
"""For blocks of rows: each thread holds one, and what reads them keeps no more than four busy."""
_COLUMNS = 256
"""As many of 4 rows and of a few waves fit the first cache."""


class Planes(NamedTuple):
    """A block [R,W,3]: its pixels' numbers as they lie in memory, and where each row of a channel begins among them:
    first + channel · channel_step + row · row_step.
    """

    numbers: NDArray[Any]
    first: int
    channel_step: int
    row_step: int
    rows: int
    width: int


def as_planes(block: NDArray[np.floating[Any]]) -> Planes:
    """A block [R,W,3] as kernels take it, without a copy where the pixels of a channel's row follow one another."""
    if block.dtype not in (np.float16, np.float32, np.float64):
        block = block.astype(np.float64)
    rows, width, channels = block.shape
    each = block.itemsize
    if block.strides[1] != each or block.strides[0] < 0 or any(stride % each for stride in block.strides):
        block = np.moveaxis(np.ascontiguousarray(np.moveaxis(block, 2, 0)), 0, 2)
    row_step, _, channel_step = (stride // each for stride in block.strides)
    behind = (channels - 1) * abs(channel_step)
    lowest = block[:1, :1, -1:] if channel_step < 0 else block[:1, :1, :1]
    numbers = as_strided(lowest, ((rows - 1) * row_step + behind + width,), (each,), writeable=False)
    first = behind if channel_step < 0 else 0
    kind = np.uint16 if block.dtype == np.float16 else block.dtype
    return Planes(numbers.view(kind), first, channel_step, row_step, rows, width)


@compiled(nogil=True)
def _row(planes: Planes, channel: int, row: int, begin: int, size: int) -> NDArray[Any]:
    place = planes.first + channel * planes.channel_step + row * planes.row_step + begin
    return planes.numbers[place : place + size]


# Sums of one row over its columns may be split among the lanes of a vector; nothing is assumed to be finite.
@compiled(nogil=True, fastmath={"reassoc", "contract", "nsz"})
def row_waves(planes: Planes, azimuth: Array) -> Array:
    """Σ over columns of azimuth [M,W] · pixel for each row and channel: [R,3,M], waves from −(M−1)/2 to (M−1)/2."""
    rows, width, degree = planes.rows, planes.width, len(azimuth) // 2
    waves = np.zeros((rows, 3, len(azimuth)))
    # Half a turn leaves even waves as they are and makes odd ones their opposite: columns are taken by twos.
    half = width // 2 if width % 2 == 0 else width
    even, odd = np.zeros((4, _COLUMNS)), np.zeros((4, _COLUMNS))
    for begin in range(0, half, _COLUMNS):
        size = min(_COLUMNS, half - begin)
        for channel in range(3):
            for first in range(0, rows, 4):
                # A wave is read once for 4 rows; those that are not there leave what their places hold, unused.
                there = min(4, rows - first)
                for r in range(there):
                    near = _row(planes, channel, first + r, begin, size)
                    if half == width:
                        for i in range(size):
                            even[r, i] = odd[r, i] = as_double(near[i])
                    else:
                        far = _row(planes, channel, first + r, begin + half, size)
                        for i in range(size):
                            one, other = as_double(near[i]), as_double(far[i])
                            even[r, i], odd[r, i] = one + other, one - other
                for m in range(len(azimuth)):
                    sums = _of_four(azimuth[m, begin : begin + size], odd if (m - degree) % 2 else even)
                    for r in range(there):
                        waves[first + r, channel, m] += sums[r]
    return waves


@compiled(nogil=True, fastmath={"reassoc", "contract", "nsz"})
def _of_four(wave: Array, rows: Array) -> tuple[float, float, float, float]:
    one, two, three, four = rows[0], rows[1], rows[2], rows[3]
    a = b = c = d = 0.0
    for i in range(len(wave)):
        a += wave[i] * one[i]
        b += wave[i] * two[i]
        c += wave[i] * three[i]
        d += wave[i] * four[i]
    return a, b, c, d


@compiled(nogil=True, fastmath={"contract"})
def add_rows(planes: Planes, first: int, weights: Array, total: Array) -> None:
    """Add Σ weights[r] · row first + r to total [3, W or more], row after row."""
    for channel in range(3):
        for begin in range(0, planes.width, _COLUMNS):
            size = min(_COLUMNS, planes.width - begin)
            sums = total[channel, begin : begin + size]
            for r in range(len(weights)):
                row, weight = _row(planes, channel, first + r, begin, size), weights[r]
                for i in range(size):
                    sums[i] += weight * as_double(row[i])


@compiled(nogil=True, fastmath={"contract"})
def mean_columns(total: Array, begins: NDArray[np.int64], shares: Array, line: NDArray[np.float32]) -> None:
    """line[j] [w,3] = Σ shares[j,k] · total[:, begins[j] + k], total [3, at least begins + K], K a multiple of 4."""
    one, two, three, four = np.uintp(1), np.uintp(2), np.uintp(3), np.uintp(4)
    reds, greens, blues = total[0], total[1], total[2]
    for j in range(len(begins)):
        red, green, blue, place = 0.0, 0.0, 0.0, np.uintp(begins[j])
        for k in range(0, shares.shape[1], 4):
            a, b, c, d = shares[j, k], shares[j, k + 1], shares[j, k + 2], shares[j, k + 3]
            # Unsigned places are not looked at for a count from the end.
            q, r, s = place + one, place + two, place + three
            red += a * reds[place] + b * reds[q] + c * reds[r] + d * reds[s]
            green += a * greens[place] + b * greens[q] + c * greens[r] + d * greens[s]
            blue += a * blues[place] + b * blues[q] + c * blues[r] + d * blues[s]
            place += four
        line[j, 0], line[j, 1], line[j, 2] = red, green, blue


@compiled(nogil=True, fastmath={"contract"})
def mean_rows(
    planes: Planes,
    tops: NDArray[np.int64],
    bottoms: NDArray[np.int64],
    down: Array,
    begins: NDArray[np.int64],
    across: Array,
    image: NDArray[np.float32],
) -> None:
    """Each row n of image [h,w,3]: `mean_columns` of Σ down[n,r] · row tops[n] + r, before bottoms[n]."""
    total = np.zeros((3, planes.width + across.shape[1]))
    for n in range(len(image)):
        total[:] = 0.0
        add_rows(planes, tops[n], down[n, : bottoms[n] - tops[n]], total)
        mean_columns(total, begins, across, image[n])
