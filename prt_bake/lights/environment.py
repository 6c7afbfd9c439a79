"""Distant light from lat-long pictures: its harmonics, its radiance in a direction, its rotation.

Convention: row 0 of a picture is up. u runs from the left edge and v from the top edge, both in [0, 1]. With `up = "y"`
(u, v) is the direction d = (cosφ sinθ, cosθ, sinφ sinθ), φ = 2π(u − ½), θ = πv: the centre of the picture is +x, and +z
is to its right. `up = "z"` applies (x, y, z) → (x, −z, y) to that. Radiance is linear, Rec.709, channels RGB. Rotating
a light by R means L'(d) = L(R⁻¹ d), and b' = M(R) b for its coefficients.
"""

import math
import warnings
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from formats.arguments import finite_number
from formats.errors import ImageError, QueryError
from formats.image import rows as image_rows
from prt_bake.lights.skies import fourier, pixels, shape
from prt_bake.mathematics import sh

BLOCK_BYTES = 8 << 20  # float64 copies of rows stay below about this size

# From the polar frame, whose +z is up and whose azimuth is φ from x towards y, to object space.
FROM_POLAR = {
    "y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]]),
    "z": np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]]),
}


def project(image: ArrayLike | image_rows.ImageRows, degree: int = 2, up: str = "y") -> NDArray[np.float64]:
    """Coefficients b_lm = ∫ L Y_lm dω [K, 3] of the light of a lat-long picture `image` [H, W, 3], K = (degree + 1)².

    Radiance is constant over each pixel, and every harmonic is integrated exactly over the pixel: ∫ cos mφ dφ and
    ∫ sin mφ dφ in closed form, ∫ P̂_l^m(cosθ) sinθ dθ by Gauss–Legendre with enough nodes for each row. Sums are
    float64. There is no convolution with a cosine. The picture may have any size and negative radiance. It is read in
    blocks of rows, so that an open one (`open_environment`) needs the memory of one block.

    Raises ImageError if the shape is not [H, W, 3] or that of a cube map, or if a pixel is not finite, with the number
    of such pixels and the first one. Raises QueryError if `up` is neither "y" nor "z" or the degree is negative.

    >>> import numpy as np
    >>> import prt_bake as prt
    >>> (prt.project_environment(np.ones((4, 8, 3)), degree=1).round(6)[:, 0] + 0.0).tolist()  # √(4π) of Y_00
    [3.544908, 0.0, 0.0, 0.0]
    """
    to_object = sh.rotation(from_polar(up), degree)
    opened = image if isinstance(image, image_rows.ImageRows) else _in_blocks(_lat_long(image))
    return to_object @ fourier.harmonics(fourier.row_waves(opened, degree))


def from_polar(up: str) -> NDArray[np.float64]:
    """The rotation [3, 3] from the polar frame to object space. Raises QueryError if `up` is neither "y" nor "z"."""
    if up not in FROM_POLAR:
        raise QueryError(f'up: expected "y" or "z", found {up!r}')
    return FROM_POLAR[up]


def rotation(degrees: float, up: str = "y") -> NDArray[np.float64]:
    """Rotation matrix R [3, 3] by `degrees` about the up axis, right-handed: counter-clockwise seen from above."""
    angle = math.radians(finite_number("degrees", degrees))
    c, s = math.cos(angle), math.sin(angle)
    from_polar(up)
    if up == "y":
        return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def rotate_light(coefficients: ArrayLike, degrees: float, up: str = "y") -> NDArray[np.float64]:
    """Coefficients M(R) b [K, 3] of the light b = `coefficients` [K, 3] rotated by `degrees` about the up axis.

    The rotation is counter-clockwise seen from above. Raises QueryError if K is not a square.

    >>> import numpy as np
    >>> import prt_bake as prt
    >>> light = np.repeat([[1.0], [0.0], [0.0], [0.5]], 3, axis=1)  # brighter towards +x
    >>> prt.rotate_light(light, 90.0)[:, 0].round(6).tolist()  # with y up, brighter towards −z
    [1.0, 0.0, -0.5, 0.0]
    """
    light = np.asarray(coefficients, dtype=np.float64)
    return sh.rotation(rotation(degrees, up), sh.degree_of(len(light))) @ light


def direction_of(u: ArrayLike, v: ArrayLike, up: str = "y") -> NDArray[np.float64]:
    """Unit directions [..., 3] of points (u, v) of a picture; u and v broadcast."""
    phi, theta = np.broadcast_arrays(2 * math.pi * (np.asarray(u) - 0.5), math.pi * np.asarray(v))
    sin_theta = np.sin(theta)
    polar = np.stack([np.cos(phi) * sin_theta, np.sin(phi) * sin_theta, np.cos(theta)], axis=-1)
    return np.asarray(polar @ from_polar(up).T)


def pixel_of(directions: ArrayLike, up: str = "y") -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The (u, v), u [...] in [0, 1) and v [...] in [0, 1], of `directions` [..., 3] of any length."""
    x, y, z = np.moveaxis(np.asarray(directions, dtype=np.float64) @ from_polar(up), -1, 0)
    u = np.arctan2(y, x) / (2 * math.pi) + 0.5
    v = np.arctan2(np.hypot(x, y), z) / math.pi
    return np.where(u >= 1, 0.0, u), v


def lookup(image: ArrayLike, directions: ArrayLike, up: str = "y") -> NDArray[np.float64]:
    """Radiance [..., 3] of the picture `image` [H, W, 3] in `directions` [..., 3], bilinear between pixel centres.

    Columns wrap around; radiance is constant above the centres of the first row and below those of the last. Raises
    ImageError if the shape is not [H, W, 3], QueryError if `up` is neither "y" nor "z".
    """
    return radiance_at(_picture(image), *pixel_of(directions, up))


def radiance_at(image: ArrayLike, u: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
    """Values [..., C] of the picture `image` [H, W, C] at (u, v) [...], bilinear as in `lookup`."""
    values = np.asarray(image)
    height, width = values.shape[:2]
    row = np.clip(v * height - 0.5, 0, height - 1)
    top = np.floor(row).astype(np.int64)
    bottom = np.minimum(top + 1, height - 1)
    column = u * width - 0.5
    left = np.floor(column).astype(np.int64)
    down, right_share = (row - top)[..., None], (column - left)[..., None]
    left, right = left % width, (left + 1) % width
    above = (1 - right_share) * values[top, left] + right_share * values[top, right]
    below = (1 - right_share) * values[bottom, left] + right_share * values[bottom, right]
    return np.asarray((1 - down) * above + down * below)


def read_environment(
    path: str | Path, mend: bool = False, say: Callable[[str], None] = warnings.warn
) -> NDArray[np.float32]:
    """Read a lat-long picture: radiance, float32 [H, W, 3], finite and not negative.

    Args:
        path: the picture, `.exr`, `.hdr`, `.png` or `.jpg`.
        mend: repairs bad pixels: NaN, negative values and −∞ become 0, +∞ becomes the largest finite value of the
            picture (0 if there is none). Without it bad pixels raise ImageError.
        say: called with the changes.

    Negative values that are tiny beside the median become 0, which `say` is called with, and those of colours outside
    Rec.709, with a warning. Raises as `open_environment` and `formats.image.read_image`.

    >>> import prt_bake as prt
    >>> prt.read_environment(prt.example("sky.hdr")).shape
    (256, 512, 3)
    """
    return open_environment(path, mend, say, clip=True).read()


def open_environment(
    path: str | Path,
    mend: bool = False,
    say: Callable[[str], None] = warnings.warn,
    remedy: str = pixels.REMEDY,
    clip: bool = False,
) -> image_rows.ImageRows:
    """Open a lat-long picture that is read in blocks of rows, with the same radiance as `read_environment`.

    Colours outside Rec.709 keep their negative channels unless `clip` is set, so that the light is exact. `say` is
    called at once for a shape other than 2:1, and after the last block for repaired pixels, tiny negative values and a
    black picture. Raises ImageError for cube maps. Blocks raise it for bad pixels, with `remedy` as advice.
    """

    @cache  # a picture that is read twice is reported once
    def report(sentence: str) -> None:
        say(f"{path}: {sentence}")

    rows, primaries = image_rows.open_linear(path)
    shape.refuse_cube_maps(rows)
    shape.report_stretching(rows, report)
    # Pixels are judged as they are stored: the conversion of colours may make a sound channel negative.
    usable = pixels.repaired(rows, report) if mend else pixels.checked(rows, remedy, report)
    return pixels.reporting_black(image_rows.to_rec709(usable, primaries, clip), report)


def check(image: NDArray[np.floating], path: str | Path) -> None:
    """Raise ImageError (number of bad pixels, first one) if `image` [H, W, 3], read from `path`, has bad pixels.

    A cube map is refused too.
    """
    for _ in pixels.checked(image_rows.rows_of(_lat_long(image, path), path)).blocks():
        pass


def _picture(image: ArrayLike, source: str | Path = "image") -> NDArray[np.floating]:
    values = np.asarray(image)
    if values.ndim != 3 or values.shape[2] != 3 or 0 in values.shape or values.dtype.kind not in "fiu":
        raise ImageError(f"{source}: expected numbers [H, W, 3], found {values.dtype} of shape {list(values.shape)}")
    return values


def _lat_long(image: ArrayLike, source: str | Path = "image") -> NDArray[np.floating]:
    values = _picture(image, source)
    shape.refuse_cube_maps(image_rows.rows_of(values, source))
    return values


def _in_blocks(values: NDArray[np.floating]) -> image_rows.ImageRows:
    """A picture in memory, in blocks small enough for the projection's arrays to stay below BLOCK_BYTES."""
    return image_rows.rows_of(values, rows=max(1, BLOCK_BYTES // (8 * 3 * values.shape[1])))
