"""The error of a baked picture, shown: each pixel's one sigma over its own radiance, in colours with a scale."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from formats.atomic import replacing
from formats.errors import PrtbakeError
from prt_bake.shading.picture import Picture

Array = NDArray[np.float64]

_PERCENTILE = 99.0
"""Of the pixels on the object, that the colours reach to."""
_FLOOR = 1e-2
"""Of the object's mean radiance: darker pixels are held against that, their own ratio being of nothing."""
_DOTS = 100
_BESIDE, _ABOVE = 130, 40
"""Pixels for the scale and the title."""
_LEAST_ACROSS, _LEAST_DOWN = 390, 270
"""Pixels that the words take: pixels of a small picture are drawn larger."""


def relative_errors(picture: Picture, radiance: Array) -> Array:
    """One sigma over `radiance` [H,W,3] of the object alone, [H,W], root mean squares over channels; NaN off it."""
    seen = picture.coverage > 0.0
    error, signal = (np.sqrt((np.asarray(part, np.float64) ** 2).mean(axis=2)) for part in (picture.error, radiance))
    share = np.maximum(picture.coverage, 1e-6)
    mean = float((signal[seen] / share[seen]).mean()) if seen.any() else 0.0
    relative = np.full(seen.shape, np.nan)
    held = np.maximum(signal, _FLOOR * mean * share)[seen]
    relative[seen] = np.divide(error[seen], held, out=np.zeros_like(held), where=held > 0.0)
    return relative


def write_error_picture(path: str | Path, picture: Picture) -> None:
    """Write the relative error of each pixel of a picture that has the layer `radiance`, as .png.

    Raises PrtbakeError where the extra `evaluate` is not installed, StorageError if the place cannot be written.
    """
    figure = error_figure(picture)
    with replacing(path) as part:
        figure.savefig(part, dpi=_DOTS, format="png")


def error_figure(picture: Picture) -> Any:
    """The figure that `write_error_picture` writes, of matplotlib's; raises PrtbakeError where that is missing."""
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise PrtbakeError("error picture: matplotlib is not installed; install prt-bake[evaluate]") from None

    percent = 100.0 * relative_errors(picture, np.asarray(picture.layers["radiance"], np.float64))
    height, width = percent.shape
    across, down = max(width + _BESIDE, _LEAST_ACROSS), max(height + _ABOVE, _LEAST_DOWN)
    figure = Figure(figsize=(across / _DOTS, down / _DOTS), dpi=_DOTS, layout="constrained")
    axes = figure.add_subplot()
    largest = float(np.nanpercentile(percent, _PERCENTILE)) or 1.0
    shown = axes.imshow(percent, cmap="viridis", vmin=0.0, vmax=largest, interpolation="nearest")
    axes.set_axis_off()
    figure.colorbar(shown, ax=axes, extend="max", label="one sigma, % of the radiance")
    figure.suptitle(f"{100.0 * picture.relative_error:.2g} % of the object's radiance in all", fontsize=9)
    return figure
