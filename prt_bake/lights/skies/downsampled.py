"""A downsampled copy of a sky that is too large for memory, made in one pass over its rows, and its residual.

A pixel of the copy is the mean radiance over its solid angle (a box filter with exact weights), so the copy keeps the
energy of the sky. The residual holds the spherical harmonics of the sky minus those of the copy.
"""

import math
from collections.abc import Generator
from contextlib import closing

import numpy as np
from numpy.typing import NDArray

from bakers.in_order import in_order
from formats.image.rows import Block, ImageRows, rows_of
from prt_bake.lights.skies import fourier
from prt_bake.mathematics.box_filter import box_filter, zone

Array = NDArray[np.float64]

_MAX_ROWS = 4096


def rows_shown(height: int, fov: float) -> int:
    """The rows that a sky needs as the background of a picture of `height` pixels over `fov` degrees, at most 4096.

    No texel is then wider than a pixel.
    """
    texels = math.pi * height / (2.0 * math.tan(math.radians(fov) / 2.0))
    return max(1, min(_MAX_ROWS, math.ceil(texels)))


def shrink(rows: ImageRows, height: int, degree: int) -> tuple[NDArray[np.float32], Array]:
    """A copy of a picture, float32 [height,W,3] with W in proportion, and its residual [K,3], K = (degree + 1)².

    The residual is in the polar frame: the harmonics of the picture are those of the copy plus the residual. Raises
    ImageError as reading the picture does.
    """
    width = max(1, round(rows.width * height / rows.height))
    image = np.empty((height, width, 3), np.float32)
    picture_waves = fourier.gather(rows, _fill(image, rows, degree))
    copy_waves = fourier.row_waves(rows_of(image), degree)
    return image, fourier.harmonics(picture_waves) - fourier.harmonics(copy_waves)


def _fill(image: NDArray[np.float32], rows: ImageRows, degree: int) -> Generator[fourier.Part, None, None]:
    """Fill the copy `image` [h,w,3] block by block of the picture; yields the coefficients of the picture's rows."""
    azimuth = fourier.azimuth_integrals(rows.width, degree)
    down, across = box_filter(rows.height, len(image), zone), box_filter(rows.width, image.shape[1], np.subtract)

    def sum_block(numbered: tuple[int, Block]) -> tuple[int, int, Array, int, Array]:
        """First row of a block, the row after its last one, its coefficients, the first row of the copy that it
        overlaps, and its contribution to the copy from that row on.
        """
        first, block = numbered
        end = first + len(block)
        top, bottom = first * len(image) // rows.height, -(-end * len(image) // rows.height)
        shares = down[top:bottom, first:end]
        waves, zones = np.zeros((len(block), 3, len(azimuth))), np.empty((bottom - top, 3, rows.width))
        for channel, columns, strip in fourier.strips(block):
            fourier.add_waves(waves[:, channel], strip, azimuth[:, columns])
            zones[:, channel, columns] = shares @ strip
        means = np.stack([across @ line for line in zones.reshape(-1, rows.width)])
        return first, end, waves, top, means.reshape(-1, 3, image.shape[1])

    carried: Array | float = 0.0  # the previous block's contribution to a row of the copy that two blocks overlap
    with closing(in_order(sum_block, rows.blocks(), fourier.THREADS)) as blocks:
        for first, end, waves, top, means in blocks:
            yield first, waves
            means[0] += carried
            image[top : top + len(means)] = means.swapaxes(1, 2)
            carried = means[-1] if end * len(image) % rows.height else 0.0
