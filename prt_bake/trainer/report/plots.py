"""Plots of a training report as SVG in the page's text colour, for light and dark pages."""

import io
import re
from collections.abc import Callable
from typing import Any

import numpy as np

from formats.extras import require

_INK = "#010203"
"""Placeholder that the page replaces by its text colour."""
_NETWORK, _REFERENCE, _SHARE = "#3b82c4", "#d97a1e", "#8a8f98"
_STYLE: dict[Any, Any] = {
    "svg.fonttype": "none",
    "font.size": 10.0,
    "font.family": "sans-serif",
    "text.color": _INK,
    "axes.labelcolor": _INK,
    "axes.edgecolor": _INK,
    "axes.titlesize": 10.5,
    "xtick.color": _INK,
    "ytick.color": _INK,
    "grid.color": _INK,
    "grid.alpha": 0.15,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "legend.fontsize": 9.0,
}


def draw(report: dict[str, Any]) -> dict[str, str]:
    """Inline SVG by name, of every plot for which the report has figures.

    Raises PrtbakeError if the extra `evaluate` is not installed.
    """
    require("report", "matplotlib")
    import matplotlib
    from matplotlib.figure import Figure

    plots: dict[str, tuple[tuple[float, float], Callable[[Any, dict[str, Any]], None]]] = {
        "split": ((7.2, 2.9), _draw_split),
        "angles": ((9.6, 3.1), _draw_angles),
        "positions": ((9.6, 4.2), _draw_positions),
        "predicted": ((9.6, 4.2), _draw_predicted),
        "seams": ((7.2, 3.0), _draw_seams),
    }
    if report["history"]["rows"]:
        plots["history"] = ((7.2, 3.2), _draw_history)
    drawn = {}
    for name, (size, fill) in plots.items():
        with matplotlib.rc_context({**_STYLE, "svg.hashsalt": name}):
            figure = Figure(figsize=size, layout="constrained")
            fill(figure, report)
            content = io.StringIO()
            figure.savefig(content, format="svg", transparent=True, dpi=130, metadata={"Date": None, "Creator": None})
        drawn[name] = _inline(content.getvalue(), name)
    return drawn


def _inline(text: str, name: str) -> str:
    """The <svg> element alone, as wide as the page allows, in the page's text colour, with ids unique to the plot."""
    text = text[text.index("<svg") :].replace(_INK, "currentColor")
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r' id="([^"]+)"', rf' id="{name}-\1"', text)
    text = re.sub(r'"#([^"]+)"', rf'"#{name}-\1"', text)
    text = re.sub(r"url\(#([^)]+)\)", rf"url(#{name}-\1)", text)
    return re.sub(r'<svg([^>]*?) width="[^"]*"([^>]*?) height="[^"]*"|$^', r"<svg\1\2", text, count=1)


def _draw_history(figure: Any, report: dict[str, Any]) -> None:
    rows = np.asarray(report["history"]["rows"], np.float64)
    axes = figure.add_subplot()
    minutes = rows[:, 0] / 60.0
    of = report["history"]["of"]
    words = "Ŝ" if of == "transport" else "a_lm over the surface"
    axes.plot(minutes, 100.0 * rows[:, 2], color=_NETWORK, label=f"validation error of {words} during training")
    part = report["prediction"]
    if part["of"] == of == "transport" and part["weights"] and (rows[:, 1] > 0).all():
        expected = 100.0 * np.sqrt(part["weights"] * part["v"]["value"] / rows[:, 1])
        shown = expected < 200.0
        label = "sqrt(weights · v / paths)"
        axes.plot(minutes[shown], expected[shown], color=_REFERENCE, linestyle="--", label=label)
    measured = report["transport"] if of == "transport" else report["coefficients"]["surface"]
    if measured is not None:
        last = report["model"]["training_seconds"] / 60.0 or minutes[-1]
        _with_interval(axes, [last], [measured["network"]], "o", "on fresh queries, 95 % interval", _NETWORK)
    axes.set(xlabel="minutes of training", ylabel="relative RMSE [%]", yscale="log")
    _plain_ticks(axes.yaxis)
    axes.legend()


def _draw_split(figure: Any, report: dict[str, Any]) -> None:
    parts = [
        ("Ŝ on fresh queries", report["transport"]),
        ("a_lm over the surface", report["coefficients"]["surface"]),
        ("a_lm over vertices and views", report["coefficients"]["vertices"]),
    ]
    parts = [(name, part) for name, part in parts if part is not None][::-1]
    axes = figure.add_subplot()
    for height, (_name, part) in enumerate(parts):
        network = part["network"]
        first = height == 0
        axes.barh(height + 0.18, 100 * network["value"], 0.34, color=_NETWORK, label="the network" if first else None)
        axes.plot([100 * network["low"], 100 * network["high"]], [height + 0.18] * 2, color=_INK, linewidth=1.4)
        label = "the reference's noise, subtracted" if first else None
        axes.barh(height - 0.18, 100 * part["noise"], 0.34, color=_REFERENCE, label=label)
    axes.set_yticks(range(len(parts)), [name for name, _ in parts])
    axes.set(xlabel="relative RMSE [%]; line: 95 % interval")
    axes.grid(visible=False, axis="y")
    axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2)


def _draw_angles(figure: Any, report: dict[str, Any]) -> None:
    names = {"incident": "cosine ωi · n", "outgoing": "cosine ωo · n", "between": "angle of ωi and ωo [degrees]"}
    present = [name for name in names if name in report["angles"]]
    for place, name in enumerate(present, start=1):
        axes = figure.add_subplot(1, len(present), place)
        edges = np.asarray(report["angles"][name]["edges"])
        bins = report["angles"][name]["bins"]
        middles, widths = 0.5 * (edges[1:] + edges[:-1]), np.diff(edges)
        share = [100.0 * max(0.0, cell["share"]) for cell in bins]
        axes.bar(middles, share, 0.92 * widths, color=_SHARE, alpha=0.45, label="share of the squared error")
        known = [(m, cell) for m, cell in zip(middles, bins, strict=True) if np.isfinite(_number(cell["low"]))]
        _with_interval(axes, [m for m, _ in known], [cell for _, cell in known], "o-", "relative RMSE", _NETWORK)
        tops = [cell["value"] for _, cell in known]
        axes.set(xlabel=names[name], ylim=(0.0, max([*share, *(140.0 * top for top in tops), 1.0]) * 1.1))
        axes.set_xlim(edges[0], edges[-1])
        if place == 1:
            axes.set_ylabel("[%]")
            axes.legend(loc="upper left" if share[0] < share[-1] else "upper right")


def _draw_positions(figure: Any, report: dict[str, Any]) -> None:
    rows, outline = np.asarray(report["vertices"]["rows"]), np.asarray(report["outline"])
    up, sides = (1, [0, 2]) if report["up"] == "y" else (2, [0, 1])
    depth, across = sorted(sides, key=lambda axis: float(np.ptp(outline[:, axis])))
    error = 100.0 * rows[:, 6]
    top = float(np.quantile(error, 0.98))
    panels = figure.subplots(1, 2, sharey=True)
    drawn = None
    letters = "xyz"
    for axes, side in zip(panels, (1.0, -1.0), strict=True):
        behind, facing = outline[:, 3 + depth] * side > 0.0, rows[:, 3 + depth] * side > 0.0
        axes.scatter(
            outline[behind, across], outline[behind, up], s=5, color=_SHARE, alpha=0.5, linewidths=0, rasterized=True
        )
        order = np.flatnonzero(facing)[np.argsort(error[facing])]
        drawn = axes.scatter(
            rows[order, across],
            rows[order, up],
            c=error[order],
            s=42,
            cmap="viridis",
            vmin=0.0,
            vmax=top,
            edgecolors=_INK,
            linewidths=0.5,
        )
        axes.set(xlabel=f"{letters[across]} [scene units]", aspect="equal")
        axes.set_title(f"from {'+' if side > 0 else '−'}{letters[depth]}")
        # For a viewer looking along −d, right is −(d × up).
        if (side > 0.0) == (up == (depth + 1) % 3):
            axes.invert_xaxis()
    panels[0].set_ylabel(f"{letters[up]} [scene units]")
    figure.colorbar(drawn, ax=panels, label="relative RMSE of the coefficients of a vertex [%]", shrink=0.9)


def _draw_predicted(figure: Any, report: dict[str, Any]) -> None:
    part = report["predicted_measured"]
    columns = 2 if "transport" in part else 1
    if "transport" in part:
        axes = figure.add_subplot(1, columns, 1)
        edges = 10.0 ** np.asarray(part["transport"]["log10_edges"])
        counts = np.asarray(part["transport"]["counts"], np.float64)
        drawn = axes.pcolormesh(
            edges,
            edges,
            np.ma.masked_equal(counts.T, 0.0),
            cmap="viridis",
            norm="log",
            rasterized=True,
        )
        axes.plot(edges[[0, -1]], edges[[0, -1]], color=_INK, linewidth=0.8)
        axes.set(xscale="log", yscale="log", aspect="equal", xlabel="measured [1/sr]", ylabel="predicted [1/sr]")
        axes.set_title("values of Ŝ, mean over RGB")
        figure.colorbar(drawn, ax=axes, label="values", shrink=0.8)
    axes = figure.add_subplot(1, columns, columns)
    rows = np.asarray(part["white_sky"]["rows"], np.float64)
    axes.scatter(rows[:, 0], rows[:, 1], s=5, color=_NETWORK, alpha=0.5, linewidths=0, rasterized=True)
    top = float(rows.max()) * 1.05
    axes.plot([0, top], [0, top], color=_INK, linewidth=0.8)
    axes.set(xlim=(0, top), ylim=(0, top), aspect="equal", xlabel="measured", ylabel="predicted")
    axes.errorbar(
        [0.75 * top],
        [0.12 * top],
        xerr=part["white_sky"]["standard_error"],
        color=_REFERENCE,
        capsize=3,
        fmt="none",
        label="noise of the measurement, ± 1 σ",
    )
    axes.legend(loc="upper left")
    axes.set_title("√(4π) a₀₀ of vertices and views, mean over RGB")


def _draw_seams(figure: Any, report: dict[str, Any]) -> None:
    jumps = report["seams"]["jumps"]
    axes = figure.add_subplot()
    names = list(jumps)[::-1]
    for height, name in enumerate(names):
        there, elsewhere = (max(100.0 * jumps[name][key], 1e-5) for key in ("there", "elsewhere"))
        axes.barh(height + 0.18, there, 0.34, color=_NETWORK, label="there" if height == 0 else None)
        axes.barh(height - 0.18, elsewhere, 0.34, color=_SHARE, label="elsewhere" if height == 0 else None)
    axes.axvline(1.0, color=_REFERENCE, linestyle="--", label="least visible contrast, about")
    axes.set_yticks(range(len(names)), names)
    axes.set(xscale="log", xlabel="rms jump over 2·10⁻⁴ radians [% of the rms of Ŝ]")
    axes.grid(visible=False, axis="y")
    axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3)


def _with_interval(axes: Any, places: Any, figures: list[dict[str, Any]], style: str, label: str, color: str) -> None:
    """Plots figures in percent, with their confidence intervals if these are finite."""
    values = np.asarray([100.0 * figure["value"] for figure in figures])
    low, high = (np.asarray([100.0 * _number(figure[end]) for figure in figures]) for end in ("low", "high"))
    bars = np.nan_to_num(np.maximum(0.0, [values - low, high - values]))
    axes.errorbar(
        places,
        values,
        yerr=bars,
        fmt=style,
        color=color,
        ecolor=color,
        markersize=4,
        capsize=2,
        linewidth=1,
        label=label,
    )


def _number(value: float | None) -> float:
    """A number of the report; JSON stores NaN as null."""
    return float("nan") if value is None else float(value)


def _plain_ticks(axis: Any) -> None:
    from matplotlib.ticker import LogLocator, StrMethodFormatter

    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axis.set_minor_formatter("")
