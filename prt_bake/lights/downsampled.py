"""A downsampled copy of a sky too large for memory, made while its rows are read, and what the copy has lost.

A pixel of the copy is the mean radiance over its solid angle (a box filter, weighted exactly), so the copy has the
energy of the sky. The rest of the difference is kept as spherical harmonics: added to the copy's, they give the sky's.
"""

import math
from collections.abc import Generator
from contextlib import closing

import numpy as np
from numpy.typing import NDArray

from bakers.in_order import in_order
from formats.image.rows import Block, ImageRows, rows_of
from prt_bake.lights import environment, sky_fourier
from prt_bake.mathematics import sh
from prt_bake.mathematics.box_filter import box_filter, zone

Array = NDArray[np.float64]

_MOST_ROWS = 4096


def rows_shown(height: int, fov: float) -> int:
    """How high a sky must be for a picture of `height` pixels over `fov` degrees to show no texel over a pixel, at
    most 4096.
    """
    texels = math.pi * height / (2.0 * math.tan(math.radians(fov) / 2.0))
    return max(1, min(_MOST_ROWS, math.ceil(texels)))


def shrink(rows: ImageRows, height: int, degree: int, up: str) -> tuple[NDArray[np.float32], Array]:
    """A copy of a picture, float32 [height,W,3] with W in proportion, and the harmonics [K,3] that it lacks: those of
    the picture, K = (degree + 1)², are those of the copy and these. Raises ImageError where the picture does.
    """
    to_object = sh.rotation(environment.from_polar(up), degree)
    width = max(1, round(rows.width * height / rows.height))
    image = np.empty((height, width, 3), np.float32)
    picture_waves = sky_fourier.gathered(rows, _fill(image, rows, degree))
    copy_waves = sky_fourier.of_picture(rows_of(image), degree)
    return image, to_object @ (sky_fourier.harmonics(picture_waves) - sky_fourier.harmonics(copy_waves))


def _fill(image: NDArray[np.float32], rows: ImageRows, degree: int) -> Generator[sky_fourier.Part, None, None]:
    """Fill the copy `image` [h,w,3] block by block of the picture; yields the coefficients of the picture's rows."""
    azimuth = sky_fourier.azimuth_integrals(rows.width, degree)
    down, across = box_filter(rows.height, len(image), zone), box_filter(rows.width, image.shape[1], np.subtract)

    def sum_up(numbered: tuple[int, Block]) -> tuple[int, int, Array, int, Array]:
        """A block's first row, the row after its last one and its coefficients; the first row of the copy that it has
        a share in, and what it adds to the copy from there on.
        """
        first, block = numbered
        end = first + len(block)
        top, bottom = first * len(image) // rows.height, -(-end * len(image) // rows.height)
        shares = down[top:bottom, first:end]
        waves, zones = np.zeros((len(block), 3, len(azimuth))), np.empty((bottom - top, 3, rows.width))
        for channel, columns, strip in sky_fourier.strips(block):
            sky_fourier.add_waves(waves[:, channel], strip, azimuth[:, columns])
            zones[:, channel, columns] = shares @ strip
        means = np.stack([across @ line for line in zones.reshape(-1, rows.width)])
        return first, end, waves, top, means.reshape(-1, 3, image.shape[1])

    begun: Array | float = 0.0  # what the block before has added to a row of the copy that two blocks share
    with closing(in_order(sum_up, rows.blocks(), sky_fourier.THREADS)) as blocks:
        for first, end, waves, top, means in blocks:
            yield first, waves
            means[0] += begun
            image[top : top + len(means)] = means.swapaxes(1, 2)
            begun = means[-1] if end * len(image) % rows.height else 0.0
