"""A smaller copy of a sky too large for memory, made while its rows are read, and what the copy has lost.

A pixel of the copy is the mean radiance over its solid angle, rows weighed exactly, so that the energy is that of the
whole; the rest of the difference is kept as spherical harmonics, which makes those of the copy those of the whole.
"""

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bakers.in_order import in_order
from formats.image.rows import ImageRows, rows_of
from prt_bake.lights import environment, sky_fourier, sky_strips, sky_sums
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
    the whole, K = (degree + 1)², are those of the copy and these. Raises ImageError where the picture does.
    """
    to_object = sh.rotation(environment.from_polar(up), degree)
    copy = _Copy(rows, height, max(1, round(rows.width * height / rows.height)), degree)
    whole = sky_fourier.gathered(rows, in_order(copy.fill_within, copy.pieces(rows), sky_sums.THREADS))
    return copy.image, to_object @ (sky_fourier.harmonics(whole) - sky_fourier.harmonics(copy.coefficients()))


class _Piece(NamedTuple):
    """Rows of a picture from `first` on, and the rows [begin, end) of its copy that lie within them."""

    first: int
    planes: sky_sums.Planes
    begin: int
    end: int


class _Copy:
    """An image [h,w,3] each of whose rows is the mean of rows of a picture, summed in one order however they come."""

    def __init__(self, rows: ImageRows, height: int, width: int, degree: int) -> None:
        self._degree = degree
        self._down, self._across = box_filter(rows.height, height, zone), box_filter(rows.width, width, np.subtract)
        self._sums = np.zeros((3, rows.width + self._across.shares.shape[1]))
        self._azimuth = sky_fourier.azimuth_integrals(rows.width, degree)
        self._in_strips = sky_strips.fits(rows.width)
        self._strips, self._own = sky_strips.strip_waves(rows.width, degree), sky_strips.copy_of(self._across, degree)
        self._coefficients = np.zeros((height, 3, 2 * degree + 1))
        self.image = np.empty((height, width, 3), np.float32)

    def coefficients(self) -> Array:
        """Those of the image's rows, once they are filled."""
        if self._in_strips and self._own.half:
            return self._coefficients
        return sky_fourier.of_picture(rows_of(self.image), self._degree, large=True)

    def pieces(self, rows: ImageRows) -> Iterator[_Piece]:
        """The picture's blocks. Rows of the copy that lie across blocks are filled here, from block to block."""
        row, down = 0, self._down
        for first, block in rows.blocks():
            planes, last = sky_sums.as_planes(block), first + len(block)
            if self._begun(row, first):
                self._add(row, first, planes)
                if down.ends[row] <= last:
                    self._fill(row)
                    row += 1
            end = max(row, int(np.searchsorted(down.ends, last, "right")))
            yield _Piece(first, planes, row, end)
            row = end
            if self._begun(row, last) and not self._begun(row, first):
                self._add(row, first, planes)

    def fill_within(self, piece: _Piece) -> sky_fourier.Part:
        """Fill the rows that lie within a piece, and return the coefficients of the piece's; on any thread."""
        within, (begins, ends, shares) = slice(piece.begin, piece.end), self._down
        rows = begins[within] - piece.first, ends[within] - piece.first, shares[within]
        if self._in_strips:
            own = self._own, self.image[within], self._coefficients[within]
            waves = sky_strips.waves_and_means(piece.planes, self._strips, self._degree, *rows, *own)
        else:
            across = self._across.begins, self._across.shares
            sky_sums.mean_rows(piece.planes, *rows, *across, self.image[within])
            waves = sky_sums.row_waves(piece.planes, self._azimuth)
        return piece.first, waves

    def _fill(self, row: int) -> None:
        """Fill a row from its sums, which are then 0 again."""
        if self._in_strips:
            own = self.image[row], self._coefficients[row : row + 1]
            sky_strips.shrink_line(self._sums, len(self._azimuth[0]), self._own, self._degree, *own)
        else:
            sky_sums.mean_columns(self._sums, self._across.begins, self._across.shares, self.image[row])
        self._sums[:] = 0.0

    def _begun(self, row: int, place: int) -> bool:
        return row < len(self.image) and bool(self._down.begins[row] < place)

    def _add(self, row: int, first: int, planes: sky_sums.Planes) -> None:
        """What a row of the copy takes from the picture's rows from `first` on."""
        begins, ends, shares = self._down
        begin, end = max(int(begins[row]), first), min(int(ends[row]), first + planes.rows)
        sky_sums.add_rows(planes, begin - first, shares[row, begin - begins[row] : end - begins[row]], self._sums)
