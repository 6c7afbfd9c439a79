"""Plots of the report: error against training time, and the ablations of layers and training time."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from formats.atomic import replacing
from formats.extras import require
from prt_bake.paper.results import BARS
from prt_bake.paper.times import Trained, power_law

_AHEAD, _FAR_AHEAD = 8.0, 100.0
"""Factors on the training time up to which the curves of one and of several trainings are extrapolated."""


def plot_training(curves: Mapping[str, Sequence[Sequence[float]]], path: Path) -> None:
    """Plot the relative RMSE on held-out queries (of Ŝ, or of a_lm if Ŝ has no values) against seconds of training.

    The dashed line extrapolates the power law of the second half of a training to eight times its time. It is
    optimistic, because the learning rate falls to zero at the end.

    Args:
        curves: by scene, rows (seconds, walks, validation error).
        path: PNG to write.
    """
    figure, axes = _figure()
    for name, rows in curves.items():
        seconds, _walks, error = np.array(rows, np.float64).reshape(-1, 3).T
        positive = (seconds > 0.0) & (error > 0.0)
        seconds, error = seconds[positive], error[positive]
        if not len(seconds):
            continue
        (line,) = axes.loglog(seconds, error, label=name)
        half = seconds >= seconds[-1] / 2.0
        if half.sum() >= 3:
            slope, level = np.polyfit(np.log(seconds[half]), np.log(error[half]), 1)
            ahead = np.geomspace(seconds[-1], _AHEAD * seconds[-1], 16)
            axes.loglog(ahead, np.exp(level + slope * np.log(ahead)), "--", color=line.get_color(), alpha=0.5)
    axes.set(xlabel="seconds of training", ylabel="relative RMSE on held-out queries")
    axes.grid(alpha=0.3, which="both")
    if curves:
        axes.legend()
    _save(figure, path)


def plot_layers(relative_mse: Mapping[str, Mapping[str, float]], path: Path) -> None:
    """Plot the MSE relative to 7 layers with skips as bars, grouped by network.

    Args:
        relative_mse: by scene, by network ("5" with skips, "5*" without).
        path: PNG to write.
    """
    figure, axes = _figure()
    names = list(dict.fromkeys(network for row in relative_mse.values() for network in row))
    width = 0.8 / max(1, len(relative_mse))
    for i, (scene, row) in enumerate(relative_mse.items()):
        positions = [names.index(network) + (i - (len(relative_mse) - 1) / 2.0) * width for network in row]
        axes.bar(positions, list(row.values()), width, label=scene)
    axes.axhline(1.0, color="black", linewidth=0.8)
    axes.set_xticks(range(len(names)), names)
    axes.set(xlabel="hidden layers (* without skips)", ylabel="MSE of Ŝ relative to 7 layers with skips")
    axes.legend()
    _save(figure, path)


def plot_times(scenes: Mapping[str, Sequence[Trained]], path: Path) -> None:
    """Plot the errors of a_lm and of pictures, and FLIP without noise, against minutes of training.

    The dashed line extrapolates the power law of FLIP to the target, or to a hundred times the longest training.
    """
    figure, axes = _figure()
    for name, rows in scenes.items():
        minutes = np.array([row.minutes for row in rows])
        (line,) = axes.loglog(
            minutes, [row.flip_without_noise for row in rows], "o-", label=f"{name}: FLIP without noise"
        )
        for style, attribute, label in (("s:", "coefficients", "a_lm"), ("^:", "error", "picture")):
            values = [getattr(row, attribute) for row in rows]
            axes.loglog(minutes, values, style, color=line.get_color(), alpha=0.6, label=f"{name}: {label}, rel. RMSE")
        law = power_law(rows, "flip_without_noise")
        last = min(_FAR_AHEAD * minutes[-1], max(2.0 * minutes[-1], law.minutes_to(BARS["net"])))
        ahead = np.geomspace(minutes[-1], last, 16)
        axes.loglog(ahead, law.level * ahead**law.slope, "--", color=line.get_color(), alpha=0.6)
    axes.axhline(BARS["net"], color="black", linewidth=0.8)
    axes.set(xlabel="minutes of training", ylabel="error")
    axes.grid(alpha=0.3, which="both")
    axes.legend(fontsize="small")
    _save(figure, path)


def _figure() -> tuple[Any, Any]:
    require("report", "matplotlib")
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 4.5), layout="constrained")
    return figure, figure.add_subplot()


def _save(figure: Any, path: Path) -> None:
    with replacing(path) as part:
        figure.savefig(part, dpi=150, format="png")
