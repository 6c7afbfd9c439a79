"""PNG (https://www.w3.org/TR/png-3/) and JPEG (https://www.w3.org/Graphics/JPEG/itu-t81.pdf), read with Pillow.

Images are written with 8 bits per channel. The sRGB curve of IEC 61966-2-1 relates their values to linear radiance.
"""

import os
from typing import Any

import numpy as np
from numpy.typing import NDArray

from formats.errors import ImageError


def to_srgb(linear: NDArray[np.floating]) -> NDArray[np.float64]:
    """Apply the sRGB curve to linear values, clipped to [0,1]."""
    clipped = np.clip(np.asarray(linear, np.float64), 0.0, 1.0)
    return np.where(clipped <= 0.0031308, 12.92 * clipped, 1.055 * clipped ** (1 / 2.4) - 0.055)


def to_linear(encoded: NDArray[np.floating]) -> NDArray[np.float64]:
    """Invert the sRGB curve for values in [0,1]."""
    values = np.asarray(encoded, np.float64)
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def read_png(path: str | os.PathLike[str]) -> NDArray[np.float32]:
    """Read a PNG as linear float32 [H,W,3], without its alpha; grey is repeated over the channels.

    Raises:
        ImageError: the file is not PNG, or is truncated.
    """
    return to_linear(_pixels(path, "PNG", "RGB") / 255.0).astype(np.float32)


def read_png_alpha(path: str | os.PathLike[str]) -> NDArray[np.float32] | None:
    """Read the alpha of a PNG, float32 [H,W] from 0 to 1, or None if it is opaque.

    Raises:
        ImageError: the file is not PNG, or is truncated.
    """
    stored = _pixels(path, "PNG", "RGBA")[..., 3]
    return None if stored.min(initial=255) == 255 else (stored / 255.0).astype(np.float32)


def read_jpeg(path: str | os.PathLike[str]) -> NDArray[np.float32]:
    """Read a JPEG as linear float32 [H,W,3]; grey is repeated over the channels.

    Raises:
        ImageError: the file is not JPEG, or is truncated.
    """
    return to_linear(_pixels(path, "JPEG", "RGB") / 255.0).astype(np.float32)


def read_png_levels(path: str | os.PathLike[str]) -> NDArray[np.float64]:
    """Read the first channel of a PNG without the sRGB curve, float64 [H,W] from 0 to 1.

    Raises:
        ImageError: the file is not PNG, or is truncated.
    """
    stored = _pixels(path, "PNG", None)
    first = stored if stored.ndim == 2 else stored[..., 0]
    return first / (255.0 if stored.dtype == np.uint8 else 65535.0)


def _pixels(path: str | os.PathLike[str], kind: str, mode: str | None) -> NDArray[Any]:
    """Read the stored values in a mode of Pillow, 0 to 255; None keeps the channels and bit depth of the file."""
    from PIL import Image

    try:
        with Image.open(path, formats=[kind]) as picture:
            if mode is None:
                mode = {"1": "L", "P": "RGB", "PA": "RGB"}.get(picture.mode, picture.mode)
            elif mode == "RGB" and picture.mode.startswith("I"):
                # 16-bit grey: Pillow would clip it at 255.
                return np.repeat(np.asarray(picture)[..., None] / 257.0, 3, axis=2)
            return np.asarray(picture.convert(mode))
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as cause:
        raise ImageError(
            f"{path}: cannot be read as {kind}: it is truncated, damaged or of another kind; copy or save it again"
        ) from cause


def write_png(
    path: str | os.PathLike[str],
    image: NDArray[np.floating],
    exposure: float,
    alpha: NDArray[np.floating] | None = None,
) -> None:
    """Write linear radiance [H,W,3] times 2^exposure as sRGB, and the exposure in a text chunk.

    If `alpha` [H,W] is given, the image is premultiplied by it.
    """
    from PIL import Image, PngImagePlugin

    texts = PngImagePlugin.PngInfo()
    texts.add_text("exposure", f"{exposure:g} EV")
    with open(path, "wb") as file:
        Image.fromarray(encode_srgb(image, exposure, alpha)).save(file, format="PNG", pnginfo=texts)


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
