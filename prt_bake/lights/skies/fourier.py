"""Spherical harmonics of a lat-long picture by the Fourier coefficients of its rows, exact over each pixel.

The coefficients of a row are the integrals over φ of its radiance times sin |m|φ (m < 0), 1 and cos mφ: an array
[H, 3, 2·degree + 1], m from −degree to degree, in the polar frame.
"""

import math
import os
from collections.abc import Generator, Iterator
from contextlib import closing
from functools import cache
from itertools import count

import numpy as np
from numpy.typing import NDArray

from bakers.in_order import in_order
from formats.image.rows import Block, ImageRows
from prt_bake.lights.skies import pixels
from prt_bake.mathematics import sh

Array = NDArray[np.float64]
Part = tuple[int, Array]
"""The number of a row, and the coefficients of the rows from it on."""

THREADS = min(4, os.cpu_count() or 1)
"""Each thread keeps a block of rows in memory, and one thread reads."""
_COLUMNS = 4096
"""Columns of a strip. A strip stays in the cache, and BLAS starts no threads for such short sums."""
_PROFILES = 1 << 15
"""Values of Legendre profiles in memory at a time."""


def row_waves(rows: ImageRows, degree: int) -> Array:
    """The coefficients of every row; `rows` are read once, block by block.

    Raises ImageError if a pixel is not finite, with the number of such pixels and the first one.
    """
    azimuth = azimuth_integrals(rows.width, degree)

    def sum_block(numbered: tuple[int, Block]) -> Part:
        first, block = numbered
        waves = np.zeros((len(block), 3, len(azimuth)))
        for channel, columns, strip in strips(block):
            add_waves(waves[:, channel], strip, azimuth[:, columns])
        return first, waves

    return gather(rows, in_order(sum_block, rows.blocks(), THREADS))


def strips(block: Block) -> Iterator[tuple[int, slice, Array]]:
    """Split a block [R,W,3] into strips: a channel, columns, and their pixels as float64 [R,w]."""
    for begin in range(0, block.shape[1], _COLUMNS):
        columns = slice(begin, begin + _COLUMNS)
        for channel in range(3):
            yield channel, columns, block[:, columns, channel].astype(np.float64, "C")


def add_waves(waves: Array, strip: Array, azimuth: Array) -> None:
    """Add the coefficients of a strip [R,w] of one channel to `waves` [R,M], by its `azimuth_integrals` [M,w]."""
    with np.errstate(invalid="ignore"):  # `gather` refuses rows with infinities
        waves += np.vecdot(strip[:, None], azimuth)


def gather(rows: ImageRows, parts: Generator[Part, None, None]) -> Array:
    """The coefficients of all rows of a picture from its parts in order. Raises as `row_waves`."""
    waves = np.empty((0, 0, 0))
    with closing(parts):
        for first, part in parts:
            # The coefficient of m = 0 is a sum with positive weights: it is finite only if every pixel is.
            if not np.isfinite(part[..., part.shape[2] // 2]).all():
                raise pixels.bad_pixels_error(rows, negative=True)
            if first == 0:
                waves = np.empty((rows.height, *part.shape[1:]))
            waves[first : first + len(part)] = part
    return waves


def harmonics(waves: Array) -> Array:
    """∫ L Y_lm dω [K, 3], K = (degree + 1)², in the polar frame, of the picture whose rows have these coefficients."""
    degree = waves.shape[2] // 2
    m = np.concatenate([np.arange(-l, l + 1) for l in range(degree + 1)])
    polar = np.zeros((sh.count(degree), 3))
    step = max(1, _PROFILES // (sh.count(degree) * _node_count(len(waves), degree)))
    for start in range(0, len(waves), step):
        part = waves[start : start + step]
        zenith = _zenith_integrals(np.arange(start, start + len(part)), len(waves), degree)
        polar += np.einsum("hk,hck->kc", zenith, part[..., m + degree])
    return polar


def azimuth_integrals(width: int, degree: int) -> Array:
    """∫ dφ over each column of sin |m|φ (m < 0), 1 or cos mφ: [2·degree + 1, W], m from −degree to degree."""
    half = math.pi / width
    centres = 2 * math.pi * ((np.arange(width) + 0.5) / width - 0.5)
    integrals = np.full((2 * degree + 1, width), 2 * half)
    for m in range(1, degree + 1):
        chord = 2 * math.sin(m * half) / m
        integrals[degree + m] = chord * np.cos(m * centres)
        integrals[degree - m] = chord * np.sin(m * centres)
    return integrals


def _zenith_integrals(rows: NDArray[np.int64], height: int, degree: int) -> Array:
    """∫ (√2) P̂_l^|m|(cosθ) sinθ dθ over each of `rows` of a picture `height` rows high: [rows, K], index l(l+1)+m."""
    nodes, weights = _nodes(_node_count(height, degree))
    theta = (math.pi / height) * (rows[:, None] + 0.5 + 0.5 * nodes)
    sin_theta = np.sin(theta)
    meridian = np.stack([sin_theta, np.zeros_like(theta), np.cos(theta)], axis=-1)
    # On the meridian φ = 0 the harmonic of m ≥ 0 is its zenith profile.
    zenith = np.concatenate([l * (l + 1) + abs(np.arange(-l, l + 1)) for l in range(degree + 1)])
    measure = (0.5 * math.pi / height) * weights * sin_theta
    return np.asarray(np.einsum("hn,hnk->hk", measure, sh.evaluate(meridian, degree))[:, zenith])


@cache
def _nodes(number: int) -> tuple[Array, Array]:
    """Gauss–Legendre nodes and weights; computing them takes longer than using them."""
    nodes, weights = np.polynomial.legendre.leggauss(number)
    return nodes, weights


def _node_count(height: int, degree: int) -> int:
    """The fewest Gauss–Legendre nodes that integrate waves of frequency up to degree + 1 over π/height to rounding.

    The error of n nodes falls as (e x / 4n)^2n, x = (degree + 1)·π/(2·height) half the phase across a row.
    """
    phase = (degree + 1) * math.pi / (2 * height)
    return next(n for n in count(1) if (math.e * phase / (4 * n)) ** (2 * n) < 1e-18)
