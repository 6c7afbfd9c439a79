"""The error picture: each pixel's standard error over its radiance, in false colours with a scale."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from formats.atomic import replacing
from formats.errors import requires_matplotlib
from prt_bake.shading.picture import Picture

Array = NDArray[np.float64]

_PERCENTILE = 99.0
"""Percentile of the pixels on the object at the end of the colour scale."""
_FLOOR = 1e-2
"""Share of the object's mean radiance that replaces the radiance of darker pixels."""
_DPI = 100
_BESIDE, _ABOVE = 130, 40
"""Pixels for the scale and the title."""
_MIN_WIDTH, _MIN_HEIGHT = 390, 270
"""Pixels that the text needs; small pictures are enlarged."""


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


def write_error_picture(path: str | Path, picture: Picture) -> None:
    """Write the relative error of each pixel of a picture with the layer `radiance`, as .png.

    Raises PrtbakeError if the extra `evaluate` is not installed, StorageError if the file cannot be written.
    """
    figure = error_figure(picture)
    with replacing(path) as part:
        figure.savefig(part, dpi=_DPI, format="png")


def error_figure(picture: Picture) -> Any:
    """The matplotlib figure that `write_error_picture` writes. Raises PrtbakeError without matplotlib."""
    with requires_matplotlib("error picture"):
        from matplotlib.figure import Figure
    percent = 100.0 * relative_errors(picture, np.asarray(picture.layers["radiance"], np.float64))
    height, width = percent.shape
    total_width, total_height = max(width + _BESIDE, _MIN_WIDTH), max(height + _ABOVE, _MIN_HEIGHT)
    figure = Figure(figsize=(total_width / _DPI, total_height / _DPI), dpi=_DPI, layout="constrained")
    axes = figure.add_subplot()
    largest = float(np.nanpercentile(percent, _PERCENTILE)) or 1.0
    shown = axes.imshow(percent, cmap="viridis", vmin=0.0, vmax=largest, interpolation="nearest")
    axes.set_axis_off()
    figure.colorbar(shown, ax=axes, extend="max", label="standard error, % of the radiance")
    figure.suptitle(f"total: {100.0 * picture.relative_error:.2g} % of the object's radiance", fontsize=9)
    return figure
