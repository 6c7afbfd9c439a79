"""The error picture: each pixel's standard error over its radiance, in false colours."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from formats.atomic import replacing
from formats.extras import require
from prt_bake.shading.picture import Picture

Array = NDArray[np.float64]

_PERCENTILE = 99.0
"""Percentile of the pixels on the object at the end of the colour scale."""
_FLOOR = 1e-2
"""Share of the object's mean radiance that replaces the radiance of darker pixels."""


def relative_errors(picture: Picture, radiance: Array) -> Array:
    """Standard error over the `radiance` [H,W,3] of the object, [H,W], rms over channels; NaN off the object."""
    inside = picture.coverage > 0.0
    error, signal = (np.sqrt((np.asarray(part, np.float64) ** 2).mean(axis=2)) for part in (picture.error, radiance))
    share = np.maximum(picture.coverage, 1e-6)
    mean = float((signal[inside] / share[inside]).mean()) if inside.any() else 0.0
    relative = np.full(inside.shape, np.nan)
    divisor = np.maximum(signal, _FLOOR * mean * share)[inside]
    relative[inside] = np.divide(error[inside], divisor, out=np.zeros_like(divisor), where=divisor > 0.0)
    return relative


def write_error_picture(path: str | Path, picture: Picture) -> float:
    """Write the relative error of each pixel of a picture with the layer `radiance`, as .png of the picture's size.

    Colours run from 0 (dark blue) to the returned error (yellow); pixels off the object are transparent. Raises
    PrtbakeError if the extra `evaluate` is not installed, StorageError if the file cannot be written.
    """
    colours, largest = error_colours(picture)
    with replacing(path) as part:
        Image.fromarray(colours).save(part, format="PNG", optimize=True)
    return largest


def error_colours(picture: Picture) -> tuple[NDArray[np.uint8], float]:
    """The RGBA [H,W,4] that `write_error_picture` writes, and the end of its scale.

    Raises PrtbakeError without matplotlib.
    """
    require("error picture", "matplotlib")
    from matplotlib import colormaps

    relative = relative_errors(picture, np.asarray(picture.layers["radiance"], np.float64))
    outside = np.isnan(relative)
    largest = 0.0 if outside.all() else float(np.nanpercentile(relative, _PERCENTILE))
    colours = colormaps["viridis"](np.where(outside, 0.0, relative) / (largest or 1.0), bytes=True)
    colours[outside] = 0
    return colours, largest
