"""What a comparison shows: maps of the difference and of FLIP as pictures, and one sheet with everything on it.

Maps are written as their suffix says: .exr holds the numbers, .png shows them in colours. Signed differences run from
blue (the image is darker) over white to red (it is brighter); FLIP is in magma, from black (equal) to bright.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from formats.atomic import replacing
from formats.errors import PrtbakeError
from formats.image import write_image
from formats.image.png import to_linear, to_srgb
from prt_bake.comparison.flip import PIXELS_PER_DEGREE
from prt_bake.comparison.metrics import Comparison
from prt_bake.mathematics.noise_free import Interval

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

_PANEL, _GAP, _HEAD, _SCALE, _LINE = 2.6, 0.1, 0.28, 0.4, 0.165
"""Inches: a panel's width, between panels, above them for titles, below them for scales, a line of the table."""
_DOTS = 150
"""An inch."""
_SHARE = 99.0
"""Percentile of the differences that the colours of the sheet reach to."""
_TITLES = {
    "mse": "MSE",
    "relative_mse": "relative MSE",
    "relative_rmse": "relative RMSE",
    "ssim": "SSIM",
    "ssim_quarter": "SSIM, quarter size",
    "flip": "FLIP",
    "hdr_flip": "HDR-FLIP",
}


def write_difference_map(path: str | Path, difference: Array) -> None:
    """Write the signed difference [H,W,3] of radiance: as it is, or its mean over channels in colours."""
    if Path(path).suffix.lower() == ".png":
        grey = difference.mean(axis=2)
        write_image(path, _linear(_coloured(grey / _reach(grey) / 2.0 + 0.5, "RdBu_r")))
    else:
        write_image(path, difference)


def write_flip_map(path: str | Path, values: NDArray[np.float32]) -> None:
    """Write a map [H,W] of FLIP or HDR-FLIP: as it is, or in colours from 0 to 1."""
    if Path(path).suffix.lower() == ".png":
        write_image(path, _linear(_coloured(values, "magma")))
    else:
        write_image(path, np.repeat(values[..., None], 3, axis=2))


def write_sheet(
    path: str | Path,
    image: NDArray[np.floating],
    reference: NDArray[np.floating],
    found: Comparison,
    names: tuple[str, str],
    exposure: float = 0.0,
    mask: NDArray[np.bool_] | None = None,
    without_noise: Mapping[str, Interval] | None = None,
) -> None:
    """Write image, reference, signed difference, FLIP and, where it is there, HDR-FLIP beside one another as PNG.

    Each panel has its title, maps have their scale of colours, and the figures stand below, with noise and without.
    Pixels outside the mask [H,W] are dimmed in the maps. The difference is of radiance after exposure.

    Raises PrtbakeError where the extra `evaluate` is not installed, StorageError if the place cannot be written.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise PrtbakeError("compare: matplotlib is not installed; install prt-bake[evaluate]") from None

    lifted = [np.asarray(part, np.float64) * 2.0**exposure for part in (image, reference)]
    difference = (lifted[0] - lifted[1]).mean(axis=2)
    maps = [found.flip_map] + ([] if found.hdr_flip_map is None else [found.hdr_flip_map])
    titles = ["FLIP", "HDR-FLIP"]
    if found.hdr_exposures is not None:
        titles[1] += f", {found.hdr_exposures.start:.1f} to {found.hdr_exposures.stop:.1f} EV"
    rows = [name for name in _TITLES if getattr(found, name) is not None]
    layout = _Layout(3 + len(maps), difference.shape, len(rows))
    figure = Figure(figsize=layout.size, dpi=_DOTS)
    for number, (picture, name) in enumerate(zip(lifted, names, strict=True)):
        _plain(layout.panel(figure, number), name).imshow(to_srgb(picture), interpolation=layout.interpolation)
    counts = np.ones(difference.shape, np.bool_) if mask is None else mask
    reach = _reach(difference[counts])
    _mapped(layout, figure, 2, difference, "RdBu_r", (-reach, reach), "difference, image − reference", mask)
    most = _round_up(max(float(np.percentile(each[counts], 99.9)) for each in maps))
    for number, (values, title) in enumerate(zip(maps, titles, strict=False), start=3):
        axes = _mapped(layout, figure, number, values, "magma", (0.0, most), title, mask)
        _one_degree(axes, values.shape[1])
    _figures(layout.table(figure), found, rows, without_noise or {}, exposure)
    with replacing(path) as part:
        figure.savefig(part, dpi=_DOTS, format="png", facecolor="white")


class _Layout:
    """Where panels, their scales and the table of figures lie, in inches."""

    def __init__(self, panels: int, shape: tuple[int, ...], rows: int) -> None:
        self.tall = _PANEL * min(max(shape[0] / shape[1], 0.25), 3.0)
        self.below = _LINE * (rows + 1)
        self.size = panels * (_PANEL + _GAP) + _GAP, _HEAD + self.tall + _SCALE + self.below + _GAP
        self.interpolation = "nearest" if shape[1] <= 2 * _PANEL * _DOTS else "antialiased"

    def panel(self, figure: "Figure", number: int) -> "Axes":
        """The axes of a panel, counted from the left."""
        return self._axes(figure, _GAP + number * (_PANEL + _GAP), _HEAD, _PANEL, self.tall)

    def scale(self, figure: "Figure", number: int) -> "Axes":
        """The axes of a panel's scale of colours."""
        left = _GAP + number * (_PANEL + _GAP) + 0.05 * _PANEL
        return self._axes(figure, left, _HEAD + self.tall + 0.06, 0.9 * _PANEL, 0.09)

    def table(self, figure: "Figure") -> "Axes":
        """The axes of the table below."""
        return self._axes(figure, _GAP, _HEAD + self.tall + _SCALE, self.size[0] - 2.0 * _GAP, self.below)

    def _axes(self, figure: "Figure", left: float, top: float, width: float, height: float) -> "Axes":
        wide, high = self.size
        return figure.add_axes((left / wide, 1.0 - (top + height) / high, width / wide, height / high))


def _plain(axes: "Axes", title: str) -> "Axes":
    axes.set_title(title if len(title) <= 34 else f"…{title[-33:]}", fontsize=9)
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_linewidth(0.4)
    return axes


def _mapped(
    layout: _Layout,
    figure: "Figure",
    number: int,
    values: NDArray[np.floating],
    colours: str,
    limits: tuple[float, float],
    title: str,
    mask: NDArray[np.bool_] | None,
) -> "Axes":
    axes, strength = _plain(layout.panel(figure, number), title), None if mask is None else np.where(mask, 1.0, 0.25)
    axes.set_facecolor("0.5")
    low, high = limits
    shown: dict[str, Any] = {"cmap": colours, "vmin": low, "vmax": high, "interpolation": layout.interpolation}
    drawn = axes.imshow(values, alpha=strength, **shown)
    bar = figure.colorbar(drawn, cax=layout.scale(figure, number), orientation="horizontal")
    bar.ax.locator_params(nbins=5)
    bar.ax.tick_params(labelsize=7, width=0.4)
    bar.outline.set_linewidth(0.4)
    return axes


def _one_degree(axes: "Axes", width: int) -> None:
    """A bar as long as a degree of the eye's view, at which FLIP looks, where the picture is wide enough for it."""
    if width < 1.5 * PIXELS_PER_DEGREE:
        return
    down = axes.get_xaxis_transform()
    left = 0.04 * width
    axes.plot([left, left + PIXELS_PER_DEGREE], [0.06, 0.06], color="white", linewidth=1.5, transform=down)
    axes.text(left, 0.08, "1°", color="white", fontsize=7, transform=down, verticalalignment="bottom")


def _figures(
    axes: "Axes", found: Comparison, rows: list[str], without_noise: Mapping[str, Interval], exposure: float
) -> None:
    """The figures in columns: name, value, and without noise."""
    axes.set_axis_off()
    columns = [(0.0, "", [_TITLES[name] for name in rows])]
    columns.append((1.4, "as it is", [f"{getattr(found, name):.4g}" for name in rows]))
    if without_noise:
        columns.append((2.4, "without noise (95 %)", [_between(without_noise.get(name)) for name in rows]))
    figure: Any = axes.figure
    wide, high = figure.get_size_inches() * axes.get_position().size
    axes.set(xlim=(0.0, wide), ylim=(high, 0.0))
    style: dict[str, Any] = {"fontsize": 8, "verticalalignment": "center"}
    for left, head, cells in columns:
        axes.text(left, 0.5 * _LINE, head, fontweight="bold", **style)
        for row, cell in enumerate(cells, start=1):
            axes.text(left, (row + 0.5) * _LINE, cell, **style)
    if exposure:
        axes.text(wide, 0.5 * _LINE, f"exposure {exposure:+g} EV", horizontalalignment="right", **style)


def _between(interval: Interval | None) -> str:
    if interval is None:
        return "–"
    if not math.isfinite(interval.low):
        return f"{interval.value:.4g} (cannot be told)"
    return f"{interval.value:.4g} ({interval.low:.4g} to {interval.high:.4g})"


def _reach(difference: Array) -> float:
    """Up to where the colours of a difference go."""
    size = np.abs(difference)
    reach = float(np.percentile(size, _SHARE)) or float(size.max())
    return reach if reach > 0.0 else 1.0


def _round_up(value: float) -> float:
    """The next of 0.05, 0.1, 0.2, 0.5 and 1."""
    return next(step for step in (0.05, 0.1, 0.2, 0.5, 1.0) if value <= step or step == 1.0)


def _coloured(values: NDArray[np.floating], name: str) -> Array:
    try:
        from matplotlib import colormaps
    except ImportError:
        raise PrtbakeError("compare: matplotlib is not installed; install prt-bake[evaluate]") from None

    return np.asarray(colormaps[name](np.clip(values, 0.0, 1.0))[..., :3], np.float64)


def _linear(shown: Array) -> Array:
    return to_linear(shown)
