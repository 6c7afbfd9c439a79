"""Pictures of a comparison: maps of the difference and of FLIP, and a sheet with both pictures, maps and metrics.

Maps in .exr files hold the numbers, in .png files false colours. Signed differences range from blue (the image is
darker) over white to red (it is brighter). FLIP uses magma, from black (equal) to bright.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from formats.atomic import replacing
from formats.extras import require
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
"""Inches: width of a panel, gap between panels, height of titles, of colour scales and of a line of the table."""
_DPI = 150
_PERCENTILE = 99.0
"""Percentile of the differences at the ends of the colour scale."""
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
    """Write the signed difference [H,W,3] of radiance, or its mean over channels in false colours."""
    if Path(path).suffix.lower() == ".png":
        grey = difference.mean(axis=2)
        write_image(path, to_linear(_false_colours(grey / _range(grey) / 2.0 + 0.5, "RdBu_r")))
    else:
        write_image(path, difference)


def write_flip_map(path: str | Path, values: NDArray[np.float32]) -> None:
    """Write a map [H,W] of FLIP or HDR-FLIP, or its false colours from 0 to 1."""
    if Path(path).suffix.lower() == ".png":
        write_image(path, to_linear(_false_colours(values, "magma")))
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
    """Write image, reference, signed difference, FLIP and, if computed, HDR-FLIP side by side as PNG.

    Panels have titles, maps have colour scales, and a table below lists the metrics, with and without correction for
    noise. Maps are dimmed outside the mask [H,W]. The difference is of radiance after exposure.

    Raises PrtbakeError if the extra `evaluate` is not installed, StorageError if the file cannot be written.
    """
    require("compare", "matplotlib")
    from matplotlib.figure import Figure

    exposed = [np.asarray(part, np.float64) * 2.0**exposure for part in (image, reference)]
    difference = (exposed[0] - exposed[1]).mean(axis=2)
    maps = [found.flip_map] + ([] if found.hdr_flip_map is None else [found.hdr_flip_map])
    titles = ["FLIP", "HDR-FLIP"]
    if found.hdr_exposures is not None:
        titles[1] += f", {found.hdr_exposures.start:.1f} to {found.hdr_exposures.stop:.1f} EV"
    rows = [name for name in _TITLES if getattr(found, name) is not None]
    layout = _Layout(3 + len(maps), difference.shape, len(rows))
    figure = Figure(figsize=layout.size, dpi=_DPI)
    for number, (picture, name) in enumerate(zip(exposed, names, strict=True)):
        _titled(layout.panel(figure, number), name).imshow(to_srgb(picture), interpolation=layout.interpolation)
    chosen = np.ones(difference.shape, np.bool_) if mask is None else mask
    limit = _range(difference[chosen])
    _draw_map(layout, figure, 2, difference, "RdBu_r", (-limit, limit), "difference, image − reference", mask)
    flip_limit = _round_up(max(float(np.percentile(each[chosen], 99.9)) for each in maps))
    for number, (values, title) in enumerate(zip(maps, titles, strict=False), start=3):
        axes = _draw_map(layout, figure, number, values, "magma", (0.0, flip_limit), title, mask)
        _draw_scale_bar(axes, values.shape[1])
    _draw_table(layout.table(figure), found, rows, without_noise or {}, exposure)
    with replacing(path) as part:
        figure.savefig(part, dpi=_DPI, format="png", facecolor="white")


class _Layout:
    """Positions of panels, colour scales and table, in inches."""

    def __init__(self, panels: int, shape: tuple[int, ...], rows: int) -> None:
        self.panel_height = _PANEL * min(max(shape[0] / shape[1], 0.25), 3.0)
        self.table_height = _LINE * (rows + 1)
        height = _HEAD + self.panel_height + _SCALE + self.table_height + _GAP
        self.size = panels * (_PANEL + _GAP) + _GAP, height
        self.interpolation = "nearest" if shape[1] <= 2 * _PANEL * _DPI else "antialiased"

    def panel(self, figure: "Figure", number: int) -> "Axes":
        """The axes of a panel, counted from the left."""
        return self._axes(figure, _GAP + number * (_PANEL + _GAP), _HEAD, _PANEL, self.panel_height)

    def scale(self, figure: "Figure", number: int) -> "Axes":
        """The axes of a panel's colour scale."""
        left = _GAP + number * (_PANEL + _GAP) + 0.05 * _PANEL
        return self._axes(figure, left, _HEAD + self.panel_height + 0.06, 0.9 * _PANEL, 0.09)

    def table(self, figure: "Figure") -> "Axes":
        """The axes of the table."""
        top = _HEAD + self.panel_height + _SCALE
        return self._axes(figure, _GAP, top, self.size[0] - 2.0 * _GAP, self.table_height)

    def _axes(self, figure: "Figure", left: float, top: float, width: float, height: float) -> "Axes":
        total_width, total_height = self.size
        bottom = 1.0 - (top + height) / total_height
        return figure.add_axes((left / total_width, bottom, width / total_width, height / total_height))


def _titled(axes: "Axes", title: str) -> "Axes":
    axes.set_title(title if len(title) <= 34 else f"…{title[-33:]}", fontsize=9)
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_linewidth(0.4)
    return axes


def _draw_map(
    layout: _Layout,
    figure: "Figure",
    number: int,
    values: NDArray[np.floating],
    colours: str,
    limits: tuple[float, float],
    title: str,
    mask: NDArray[np.bool_] | None,
) -> "Axes":
    axes, alpha = _titled(layout.panel(figure, number), title), None if mask is None else np.where(mask, 1.0, 0.25)
    axes.set_facecolor("0.5")
    low, high = limits
    style: dict[str, Any] = {"cmap": colours, "vmin": low, "vmax": high, "interpolation": layout.interpolation}
    drawn = axes.imshow(values, alpha=alpha, **style)
    bar = figure.colorbar(drawn, cax=layout.scale(figure, number), orientation="horizontal")
    bar.ax.locator_params(nbins=5)
    bar.ax.tick_params(labelsize=7, width=0.4)
    bar.outline.set_linewidth(0.4)
    return axes


def _draw_scale_bar(axes: "Axes", width: int) -> None:
    """Draw a bar of one degree of the viewing angle in FLIP, if the picture is wide enough."""
    if width < 1.5 * PIXELS_PER_DEGREE:
        return
    down = axes.get_xaxis_transform()
    left = 0.04 * width
    axes.plot([left, left + PIXELS_PER_DEGREE], [0.06, 0.06], color="white", linewidth=1.5, transform=down)
    axes.text(left, 0.08, "1°", color="white", fontsize=7, transform=down, verticalalignment="bottom")


def _draw_table(
    axes: "Axes", found: Comparison, rows: list[str], without_noise: Mapping[str, Interval], exposure: float
) -> None:
    """Draw the metrics in columns: name, measured value, and value corrected for noise."""
    axes.set_axis_off()
    columns = [(0.0, "", [_TITLES[name] for name in rows])]
    columns.append((1.4, "measured", [f"{getattr(found, name):.4g}" for name in rows]))
    if without_noise:
        columns.append((2.4, "without noise (95 %)", [_interval_text(without_noise.get(name)) for name in rows]))
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


def _interval_text(interval: Interval | None) -> str:
    if interval is None:
        return "–"
    if not math.isfinite(interval.low):
        return f"{interval.value:.4g} (no interval)"
    return f"{interval.value:.4g} ({interval.low:.4g} to {interval.high:.4g})"


def _range(difference: Array) -> float:
    """The difference at the end of the colour scale."""
    size = np.abs(difference)
    limit = float(np.percentile(size, _PERCENTILE)) or float(size.max())
    return limit if limit > 0.0 else 1.0


def _round_up(value: float) -> float:
    """The next of 0.05, 0.1, 0.2, 0.5 and 1."""
    return next(step for step in (0.05, 0.1, 0.2, 0.5, 1.0) if value <= step or step == 1.0)


def _false_colours(values: NDArray[np.floating], name: str) -> Array:
    require("compare", "matplotlib")
    from matplotlib import colormaps

    return np.asarray(colormaps[name](np.clip(values, 0.0, 1.0))[..., :3], np.float64)
