"""PNG and JPEG, 8 bits a channel, with the sRGB curve of IEC 61966-2-1 between their values and linear radiance."""

import os
from typing import Any

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
    return to_linear(_pixels(path, "PNG", "RGB") / 255.0).astype(np.float32)


def read_png_alpha(path: str | os.PathLike[str]) -> NDArray[np.float32] | None:
    """Read the alpha of a PNG, float32 [H,W] from 0 to 1; None where it is opaque.

    Raises:
        ImageError: the file is no PNG, or truncated.
    """
    stored = _pixels(path, "PNG", "RGBA")[..., 3]
    return None if stored.min(initial=255) == 255 else (stored / 255.0).astype(np.float32)


def read_jpeg(path: str | os.PathLike[str]) -> NDArray[np.float32]:
    """Read a JPEG as linear float32 [H,W,3]; grey is repeated over the channels.

    Raises:
        ImageError: the file is no JPEG, or truncated.
    """
    return to_linear(_pixels(path, "JPEG", "RGB") / 255.0).astype(np.float32)


def read_png_levels(path: str | os.PathLike[str]) -> NDArray[np.float64]:
    """Read the first channel of a PNG as it is stored, without the sRGB curve: float64 [H,W] from 0 to 1.

    Raises:
        ImageError: the file is no PNG, or truncated.
    """
    stored = _pixels(path, "PNG", None)
    first = stored if stored.ndim == 2 else stored[..., 0]
    return first / (255.0 if stored.dtype == np.uint8 else 65535.0)


def _pixels(path: str | os.PathLike[str], kind: str, mode: str | None) -> NDArray[Any]:
    """Read the stored values of a picture in Pillow's `mode`, of 0 to 255; None keeps the channels and depth of the
    file.
    """
    from PIL import Image

    try:
        with Image.open(path, formats=[kind]) as picture:
            if mode is None:
                mode = {"1": "L", "P": "RGB", "PA": "RGB"}.get(picture.mode, picture.mode)
            elif mode == "RGB" and picture.mode.startswith("I"):
                # Grey of 16 bits: Pillow would cut it off at 255.
                return np.repeat(np.asarray(picture)[..., None] / 257.0, 3, axis=2)
            return np.asarray(picture.convert(mode))
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as cause:
        raise ImageError(f"{path}: cannot be read as {kind}, it is truncated, damaged or of another kind") from cause


def write_png(
    path: str | os.PathLike[str],
    image: NDArray[np.floating],
    exposure: float,
    alpha: NDArray[np.floating] | None = None,
) -> None:
    """Write linear [H,W,3] as sRGB after multiplication by 2^exposure; the exposure is kept in a text chunk.

    With `alpha` [H,W] the image is weighted by it, as pictures without background are, and written beside it.
    """
    from PIL import Image, PngImagePlugin

    note = PngImagePlugin.PngInfo()
    note.add_text("exposure", f"{exposure:g} EV")
    with open(path, "wb") as file:
        Image.fromarray(encoded(image, exposure, alpha)).save(file, format="PNG", pnginfo=note)


def encoded(
    image: NDArray[np.floating], exposure: float, alpha: NDArray[np.floating] | None = None
) -> NDArray[np.uint8]:
    """Linear radiance [H,W,3] in 8 bits of sRGB after multiplication by 2^exposure, [H,W,4] with `alpha`, by which the
    image is then weighted.
    """
    linear = np.asarray(image, np.float64)
    if alpha is not None:
        share = np.asarray(alpha, np.float64)[..., None]
        linear = np.divide(linear, share, out=np.zeros_like(linear), where=share > 0.0)
    # Bounded before the curve: a peak times 2^exposure may exceed float64.
    exposed = np.minimum(linear, 2.0 ** min(-exposure, 1000.0)) * 2.0**exposure
    shown = to_srgb(exposed)
    if alpha is not None:
        shown = np.concatenate([shown, np.clip(share, 0.0, 1.0)], axis=2)
    return np.rint(255.0 * shown).astype(np.uint8)
