"""PNG, 8 bits a channel, with the sRGB curve of IEC 61966-2-1 between the file's values and linear radiance."""

import os

import numpy as np
from numpy.typing import NDArray

from formats.errors import ImageError


def to_srgb(linear: NDArray[np.floating]) -> NDArray[np.float64]:
    """Apply the sRGB curve to linear values in [0,1]; outside they are clipped."""
    clipped = np.clip(np.asarray(linear, np.float64), 0.0, 1.0)
    return np.where(clipped <= 0.0031308, 12.92 * clipped, 1.055 * clipped ** (1 / 2.4) - 0.055)


def to_linear(encoded: NDArray[np.floating]) -> NDArray[np.float64]:
    """Undo the sRGB curve for values in [0,1]."""
    values = np.asarray(encoded, np.float64)
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def read_png(path: str | os.PathLike[str]) -> NDArray[np.float32]:
    """Read a PNG as linear float32 [H,W,3]; grey is repeated over the channels, alpha is left out.

    Raises:
        ImageError: the file is no PNG, or truncated.
    """
    from PIL import Image

    try:
        with Image.open(path, formats=["PNG"]) as picture:
            pixels = np.asarray(picture.convert("RGB"))
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as cause:
        raise ImageError(f"{path}: cannot be read as PNG, it is truncated, damaged or of another kind") from cause
    return to_linear(pixels / 255.0).astype(np.float32)


def write_png(path: str | os.PathLike[str], image: NDArray[np.floating], exposure: float) -> None:
    """Write linear [H,W,3] as sRGB after multiplication by 2^exposure; the exposure is kept in a text chunk."""
    from PIL import Image, PngImagePlugin

    note = PngImagePlugin.PngInfo()
    note.add_text("exposure", f"{exposure:g} EV")
    # Bounded before the curve: a peak times 2^exposure may exceed float64.
    exposed = np.minimum(np.asarray(image, np.float64), 2.0 ** min(-exposure, 1000.0)) * 2.0**exposure
    pixels = np.rint(255.0 * to_srgb(exposed)).astype(np.uint8)
    with open(path, "wb") as file:
        Image.fromarray(pixels).save(file, format="PNG", pnginfo=note)
