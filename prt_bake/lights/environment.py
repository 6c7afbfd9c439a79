"""Distant light from lat-long pictures: its harmonics, its radiance in a direction, its rotation.

Convention: row 0 of a picture is up. With `up = "y"` the place (u, v), u from the left edge and v from the top edge,
both in [0, 1], stands for d = (cosφ sinθ, cosθ, sinφ sinθ), φ = 2π(u − ½), θ = πv: the middle of the picture looks
along +x, and +z lies to its right. With `up = "z"` the same after (x, y, z) → (x, −z, y). Radiance is linear,
Rec.709, channels RGB. Turning the light by R means L'(d) = L(R⁻¹ d), on its coefficients b' = M(R) b.
"""

import math
import warnings
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from formats.errors import ImageError, QueryError
from formats.image import rows as image_rows
from prt_bake.lights import sky_fourier, sky_pixels, sky_shape
from prt_bake.mathematics import sh

BLOCK_BYTES = 8 << 20  # float64 copies of rows stay below about this size

# From the frame whose +z is up and whose azimuth is φ, x toward y, to object space.
FROM_POLAR = {
    "y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]]),
    "z": np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]]),
}


def project(image: ArrayLike | image_rows.ImageRows, degree: int = 2, up: str = "y") -> NDArray[np.float64]:
    """Coefficients b_lm = ∫ L Y_lm dω [K, 3] of the light of a lat-long picture `image` [H, W, 3], K = (degree + 1)².

    The picture is taken as constant over each pixel, and every harmonic is integrated over the pixel's exact extent,
    to rounding: ∫ cos mφ dφ and ∫ sin mφ dφ in closed form, ∫ P̂_l^m(cosθ) sinθ dθ by Gauss–Legendre with enough
    nodes for each row. Sums are float64; the picture is read in blocks of rows, and may be one that is open
    (`open_environment`), of which no more than a block is held. Any width and height from 1 will do, and negative
    radiance is summed like any other. Nothing is convolved with a cosine. Raises ImageError if the shape is not [H,
    W, 3] or a pixel is not finite (their count and the first one's place), QueryError if `up` is neither "y" nor "z"
    or the degree is negative.
    """
    to_object = sh.rotation(from_polar(up), degree)
    opened = image if isinstance(image, image_rows.ImageRows) else _in_blocks(_picture(image))
    return to_object @ sky_fourier.harmonics(sky_fourier.of_picture(opened, degree))


def from_polar(up: str) -> NDArray[np.float64]:
    """The matrix [3, 3] of `FROM_POLAR` for an up axis. Raises QueryError if `up` is neither "y" nor "z"."""
    if up not in FROM_POLAR:
        raise QueryError(f'up: expected "y" or "z", found {up!r}')
    return FROM_POLAR[up]


def rotation(degrees: float, up: str = "y") -> NDArray[np.float64]:
    """Rotation matrix R [3, 3] by `degrees` about the up axis, right-handed: counter-clockwise seen from above."""
    angle = math.radians(degrees)
    c, s = math.cos(angle), math.sin(angle)
    from_polar(up)
    if up == "y":
        return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def rotate_light(coefficients: ArrayLike, degrees: float, up: str = "y") -> NDArray[np.float64]:
    """Coefficients M(R) b [K, 3] of the light b = `coefficients` [K, 3] turned by `degrees` about up.

    Raises QueryError if K is not a square (whole degrees).
    """
    light = np.asarray(coefficients, dtype=np.float64)
    return sh.rotation(rotation(degrees, up), sh.degree_of(len(light))) @ light


def direction_of(u: ArrayLike, v: ArrayLike, up: str = "y") -> NDArray[np.float64]:
    """Unit directions [..., 3] that the places (u, v) of a picture stand for; u and v broadcast."""
    phi, theta = np.broadcast_arrays(2 * math.pi * (np.asarray(u) - 0.5), math.pi * np.asarray(v))
    sin_theta = np.sin(theta)
    polar = np.stack([np.cos(phi) * sin_theta, np.sin(phi) * sin_theta, np.cos(theta)], axis=-1)
    return np.asarray(polar @ from_polar(up).T)


def pixel_of(directions: ArrayLike, up: str = "y") -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Places (u, v), u [...] in [0, 1) and v [...] in [0, 1], that stand for `directions` [..., 3] of any length."""
    x, y, z = np.moveaxis(np.asarray(directions, dtype=np.float64) @ from_polar(up), -1, 0)
    u = np.arctan2(y, x) / (2 * math.pi) + 0.5
    v = np.arctan2(np.hypot(x, y), z) / math.pi
    return np.where(u >= 1, 0.0, u), v


def lookup(image: ArrayLike, directions: ArrayLike, up: str = "y") -> NDArray[np.float64]:
    """Radiance [..., 3] of the picture `image` [H, W, 3] in `directions` [..., 3], bilinear between pixel centres.

    Columns wrap around; above the centres of the first row and below those of the last the value stays. Raises
    ImageError if the shape is not [H, W, 3], QueryError if `up` is neither "y" nor "z".
    """
    return radiance_at(_picture(image), *pixel_of(directions, up))


def radiance_at(image: ArrayLike, u: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
    """Values [..., C] of the picture `image` [H, W, C] at places (u, v) [...], bilinear as `lookup` says."""
    pixels = np.asarray(image)
    height, width = pixels.shape[:2]
    row = np.clip(v * height - 0.5, 0, height - 1)
    top = np.floor(row).astype(np.int64)
    bottom = np.minimum(top + 1, height - 1)
    column = u * width - 0.5
    left = np.floor(column).astype(np.int64)
    down, right_share = (row - top)[..., None], (column - left)[..., None]
    left, right = left % width, (left + 1) % width
    above = (1 - right_share) * pixels[top, left] + right_share * pixels[top, right]
    below = (1 - right_share) * pixels[bottom, left] + right_share * pixels[bottom, right]
    return np.asarray((1 - down) * above + down * below)


def read_environment(
    path: str | Path, mend: bool = False, say: Callable[[str], None] = warnings.warn
) -> NDArray[np.float32]:
    """Read a lat-long picture: radiance, float32 [H, W, 3], finite and not negative.

    With `mend` bad pixels are repaired (see the function of that name) and `say` is told what was done; without it
    they are refused. Raises ImageError as `open_environment` and `formats.image.read_image` do.
    """
    return open_environment(path, mend, say).whole()


def open_environment(
    path: str | Path,
    mend: bool = False,
    say: Callable[[str], None] = warnings.warn,
    remedy: str = sky_pixels.REMEDY,
) -> image_rows.ImageRows:
    """Open a lat-long picture to be read in blocks of rows, as radiance: what `read_environment` reads, of which memory
    need not hold more than a block.

    `say` is told of a shape other than 2:1 at once, and of what was mended and of a black picture once the last block
    is through. Raises ImageError for cube maps; blocks raise it for bad pixels, and say that `remedy` mends them.
    """

    @cache  # a picture that is read twice has one story
    def tell(sentence: str) -> None:
        say(f"{path}: {sentence}")

    rows = image_rows.open_image(path)
    sky_shape.refuse_cube_maps(rows)
    sky_shape.tell_stretching(rows, tell)
    fit = sky_pixels.mended(rows, tell) if mend else sky_pixels.checked(rows, remedy)
    return sky_pixels.telling_black(fit, tell)


def check(image: NDArray[np.floating], path: str | Path) -> None:
    """Raise ImageError (count, first place) if a pixel of `image` [H, W, 3], read from `path`, is not radiance."""
    for _ in sky_pixels.checked(image_rows.rows_of(_picture(image, path), path)).blocks():
        pass


def mend(image: NDArray[np.floating]) -> tuple[NDArray[np.float32], str]:
    """A copy of `image` [H, W, 3] that is radiance, and a sentence that says what was changed ("" where nothing was).

    NaN, negative and −∞ become 0; +∞ becomes the largest finite value of the picture (0 if there is none).
    """
    told: list[str] = []
    return sky_pixels.mended(image_rows.rows_of(_picture(image)), told.append).whole(), "".join(told)


def _picture(image: ArrayLike, source: str | Path = "image") -> NDArray[np.floating]:
    pixels = np.asarray(image)
    if pixels.ndim != 3 or pixels.shape[2] != 3 or 0 in pixels.shape or pixels.dtype.kind not in "fiu":
        raise ImageError(f"{source}: expected numbers [H, W, 3], found {pixels.dtype} of shape {list(pixels.shape)}")
    return pixels


def _in_blocks(pixels: NDArray[np.floating]) -> image_rows.ImageRows:
    """A picture in memory, in blocks of whose size the projection's arrays stay below BLOCK_BYTES."""
    return image_rows.rows_of(pixels, rows=max(1, BLOCK_BYTES // (8 * 3 * pixels.shape[1])))
