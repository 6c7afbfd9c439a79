"""PNG (https://www.w3.org/TR/png-3/) and JPEG (https://www.w3.org/Graphics/JPEG/itu-t81.pdf), as colours or as data.

Images are written with 8 bits per channel. The sRGB curve of IEC 61966-2-1 relates their values to linear radiance.
"""

import os

import numpy as np
from numpy.typing import ArrayLike, NDArray

from formats.errors import ImageError
from formats.image.encoding import encoding_of
from formats.image.gamut import Primaries
from formats.image.stored import Stored, read_stored

COMMAND = "prtbake.command"
"""Name of the text that holds the command of a picture."""
_ROWS = 64
"""Rows that are looked up at a time: NumPy widens the indices."""


def to_srgb(linear: NDArray[np.floating]) -> NDArray[np.float64]:
    """Apply the sRGB curve to linear values, clipped to [0,1]."""
    clipped = np.clip(np.asarray(linear, np.float64), 0.0, 1.0)
    return np.where(clipped <= 0.0031308, 12.92 * clipped, 1.055 * clipped ** (1 / 2.4) - 0.055)


def to_linear(encoded: NDArray[np.floating]) -> NDArray[np.float64]:
    """Invert the sRGB curve for values in [0,1]."""
    values = np.asarray(encoded, np.float64)
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def read_png(path: str | os.PathLike[str]) -> tuple[NDArray[np.float32], Primaries | None]:
    """Read a PNG as linear float32 [H,W,3], and what it says about its primaries.

    Its alpha is not returned; grey is repeated over the channels. The curve is that of sRGB, unless a chunk names
    another (`formats.image.encoding`).

    Raises:
        ImageError: the file is not PNG, is truncated, or has a curve that is not read (PQ, HLG).
    """
    return _colours(path, read_stored(path, "PNG"))


def read_jpeg(path: str | os.PathLike[str]) -> tuple[NDArray[np.float32], Primaries | None]:
    """Read a JPEG as linear float32 [H,W,3]; grey is repeated over the channels. No primaries.

    Raises:
        ImageError: the file is not JPEG, or is truncated.
    """
    return _colours(path, read_stored(path, "JPEG"))


def read_png_alpha(path: str | os.PathLike[str]) -> NDArray[np.float32] | None:
    """Read the alpha of a PNG, float32 [H,W] from 0 to 1, or None if it is opaque.

    Raises:
        ImageError: the file is not PNG, or is truncated.
    """
    return _alpha(read_stored(path, "PNG"))


def read_png_and_alpha(
    path: str | os.PathLike[str],
) -> tuple[NDArray[np.float32], Primaries | None, NDArray[np.float32] | None]:
    """Read what `read_png` and `read_png_alpha` return, and decode the file once; raises as `read_png`."""
    stored = read_stored(path, "PNG")
    return *_colours(path, stored), _alpha(stored)


def read_png_data(path: str | os.PathLike[str]) -> NDArray[np.float64]:
    """Read a PNG as data, float64 [H,W,3] from 0 to 1: no curve applies to it. Grey is repeated over the channels.

    Raises:
        ImageError: the file is not PNG, or is truncated.
    """
    return _read_data(path, "PNG")


def read_jpeg_data(path: str | os.PathLike[str]) -> NDArray[np.float64]:
    """Read a JPEG as data, as `read_png_data`.

    Raises:
        ImageError: the file is not JPEG, is truncated, or is CMYK.
    """
    return _read_data(path, "JPEG")


def _colours(path: str | os.PathLike[str], stored: Stored) -> tuple[NDArray[np.float32], Primaries | None]:
    encoding = encoding_of(path, stored)
    levels = np.arange(stored.highest + 1) / (stored.highest // 255) / 255.0
    decoded = to_linear(levels) if encoding.gamma is None else levels ** (1.0 / encoding.gamma)
    linear = decoded.astype(np.float32)
    grey = stored.values.shape[2] < 3
    colours = stored.values[..., : 1 if grey else 3]
    image = np.empty((*colours.shape[:2], 3), np.float32)
    for first in range(0, len(image), _ROWS):
        image[first : first + _ROWS] = linear[colours[first : first + _ROWS]]
    return image, None if grey else encoding.primaries


def _alpha(stored: Stored) -> NDArray[np.float32] | None:
    if stored.values.shape[2] in (1, 3):
        return None
    alpha = stored.values[..., -1]
    return None if alpha.min() == stored.highest else (alpha / float(stored.highest)).astype(np.float32)


def _read_data(path: str | os.PathLike[str], kind: str) -> NDArray[np.float64]:
    stored = read_stored(path, kind)
    if stored.cmyk:
        raise ImageError(f"{path}: stores CMYK, of which no channel is data; save it in grey")
    channels = stored.values[..., : 1 if stored.values.shape[2] < 3 else 3]
    return np.broadcast_to(channels / float(stored.highest), (*channels.shape[:2], 3))


def write_png(
    path: str | os.PathLike[str],
    image: NDArray[np.floating],
    exposure: float,
    alpha: NDArray[np.floating] | None = None,
    command: str = "",
) -> None:
    """Write linear radiance [H,W,3] times 2^exposure as sRGB, and in text chunks the exposure and the command.

    If `alpha` [H,W] is given, the image is premultiplied by it.
    """
    from PIL import Image, PngImagePlugin

    texts = PngImagePlugin.PngInfo()
    texts.add_text("exposure", f"{exposure:g} EV")
    if command:
        texts.add_itxt(COMMAND, command)
    with open(path, "wb") as file:
        Image.fromarray(encode_srgb(image, exposure, alpha)).save(file, format="PNG", pnginfo=texts)


def srgb(image: ArrayLike, exposure: float = 0.0) -> NDArray[np.uint8]:
    """8-bit sRGB [..., 3] of linear radiance [..., 3] times 2^exposure: of a picture, or of vertices.

    >>> import prt_bake as prt
    >>> prt.srgb([[0.0, 0.5, 1.0]]).tolist(), prt.srgb([[0.0, 0.5, 1.0]], exposure=-1.0).tolist()
    ([[0, 188, 255]], [[0, 137, 188]])
    """
    return encode_srgb(np.asarray(image, np.float64), exposure)


def encode_srgb(
    image: NDArray[np.floating], exposure: float, alpha: NDArray[np.floating] | None = None
) -> NDArray[np.uint8]:
    """Return linear radiance [H,W,3] times 2^exposure as 8-bit sRGB.

    If `alpha` [H,W] is given, the image is premultiplied by it and the result is [H,W,4], not premultiplied.
    """
    linear = np.asarray(image, np.float64)
    if alpha is not None:
        coverage = np.asarray(alpha, np.float64)[..., None]
        linear = np.divide(linear, coverage, out=np.zeros_like(linear), where=coverage > 0.0)
    # Clipped before the exposure: a peak times 2^exposure may exceed float64.
    exposed = np.minimum(linear, 2.0 ** min(-exposure, 1000.0)) * 2.0**exposure
    srgb = to_srgb(exposed)
    if alpha is not None:
        srgb = np.concatenate([srgb, np.clip(coverage, 0.0, 1.0)], axis=2)
    return np.rint(255.0 * srgb).astype(np.uint8)
