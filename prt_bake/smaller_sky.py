"""A smaller copy of a sky too large for memory, made while its rows are read, and what the copy has lost.

A pixel of the copy is the mean radiance over its solid angle, rows weighed exactly, so that the energy is that of the
whole; the rest of the difference is kept as spherical harmonics, which makes those of the copy those of the whole.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from formats.image_rows import Block, ImageRows
from prt_bake import environment

if TYPE_CHECKING:
    from scipy.sparse import csr_array

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
    the whole, K = (degree + 1)², are those of the copy and these. Raises ImageError where the picture does.
    """
    width = max(1, round(rows.width * height / rows.height))
    image = np.zeros((height, width, 3), np.float32)
    down = _means(rows.height, height, _zone)
    across = _means(rows.width, width, np.subtract).T.tocsr()

    def folding() -> Iterator[Block]:
        planes = np.empty((3, 0, rows.width))
        for first, block in rows.blocks():
            begin, end = first * height // rows.height, -(-(first + len(block)) * height // rows.height)
            share = down[begin:end, first : first + len(block)]
            if planes.shape[1] != len(block):
                planes = np.empty((3, len(block), rows.width))
            for channel, plane in enumerate(planes):
                plane[:] = block[..., channel]
                image[begin:end, :, channel] += (share @ plane) @ across
            yield np.moveaxis(planes, 0, 2)

    whole = environment.project(replace(rows, open_blocks=folding), degree, up)
    return image, whole - environment.project(image, degree, up)


def _means(fine: int, coarse: int, measure: Callable[[Array, Array], Array]) -> "csr_array":
    """Shares [coarse, fine] of `fine` equal parts of a line in the mean over each of `coarse` parts, by the measure of
    what they have in common.

    measure: of stretches between ends [S] and beginnings [S], as parts of the line.
    """
    from scipy.sparse import csr_array  # takes a tenth of a second, which most skies need not wait for

    cuts = np.union1d(np.arange(fine + 1) * coarse, np.arange(coarse + 1) * fine)  # in parts of fine · coarse, exact
    begins, ends = cuts[:-1], cuts[1:]
    within = begins // fine
    size = measure(ends / (fine * coarse), begins / (fine * coarse))
    size /= np.bincount(within, size)[within]
    return csr_array((size, (within, begins // coarse)), (coarse, fine))


def _zone(end: Array, begin: Array) -> Array:
    """Solid angle, up to a factor, between two parts of the way from pole to pole."""
    return np.asarray(np.sin(math.pi * 0.5 * (begin + end)) * np.sin(math.pi * 0.5 * (end - begin)))
