"""Reports of what a command did, as JSON texts and as a plot."""

import json
import math
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from formats.asset import Asset
from formats.atomic import replacing
from formats.errors import PrtbakeError
from formats.image import write_image
from prt_bake.rendering.state import relative_noise

if TYPE_CHECKING:
    from prt_bake.geometry.camera import Camera

REACHED = 1.02
"""Times the error asked for, that is told as reached."""
_NUMBERS = re.compile(r"\[\n[^\[\]{}\"]*\]")
"""A list without lists, objects or texts in indented JSON, whose texts hold no line breaks."""


def bake_report(asset: Asset) -> dict[str, Any]:
    """What a bake did and how exact it is, as plain JSON values: provenance, completeness and error against time.

    `model_error` is what the baked network itself said of its coefficients when it was trained, where it did.
    `error_reached` is whether an error that was asked for was, of the object and of 95 % of its vertices.
    """
    trained = asset.provenance.get("model", {}).get("training", {}).get("relative_rmse", {})
    asked, told = asset.provenance["settings"].get("error"), asset.provenance["estimated_relative_rmse"]
    worst = max(told["total"], told["percentile_95_over_vertices"])
    return {
        **({"model_error": trained["coefficients"]} if "coefficients" in trained else {}),
        **({} if asked is None else {"error_reached": asset.complete and worst <= REACHED * asked}),
        "complete": asset.complete,
        "vertices": len(asset.mesh.positions),
        "left_out": asset.left_out,
        "error_vs_time": {
            "columns": ["seconds", "evaluations", "estimated relative RMSE"],
            "rows": asset.error_vs_time.tolist(),
        },
        **asset.provenance,
    }


def rendering_report(
    camera: "Camera",
    image: NDArray[np.float32],
    standard_error: NDArray[np.float32],
    coverage: NDArray[np.float32],
    history: NDArray[np.float64],
) -> dict[str, Any]:
    """From where a path-traced picture [H,W,3] was seen and how noisy it is, as plain JSON values.

    The noise is over the pixels that the object covers wholly: `noise_mse` the mean squared standard error of radiance,
    `relative_noise` its root over the mean of the radiance, `error_vs_time` how that fell: the rows of `history`
    [rows,3].
    """
    noise = np.asarray(standard_error[coverage >= 1.0], np.float64)
    return {
        "width": camera.width,
        "height": camera.height,
        "eye": camera.eye.tolist(),
        "target": camera.target.tolist(),
        "up": camera.up.tolist(),
        "fov": camera.fov,
        "noise_mse": float(np.mean(noise**2)) if noise.size else 0.0,
        "relative_noise": relative_noise(image, standard_error, coverage),
        "error_vs_time": {"columns": ["seconds", "walks", "relative noise"], "rows": history.tolist()},
    }


def as_text(report: dict[str, Any]) -> str:
    """The report as indented JSON, each list of numbers on a line; numbers that are not finite, which JSON does not
    know, become null.
    """
    return _NUMBERS.sub(_on_a_line, json.dumps(_finite(report), indent=2, allow_nan=False))


def write_report(report: dict[str, Any], path: str | Path) -> None:
    """Write a report as JSON, whole or not at all; raises StorageError if the place cannot be written."""
    with replacing(path) as part:
        part.write_text(as_text(report) + "\n", encoding="utf-8")


def write_side_by_side(
    image: NDArray[np.float32],
    reference: NDArray[np.float32],
    flip_map: NDArray[np.float32],
    path: str | Path,
    exposure: float = 0.0,
) -> None:
    """Write image [H,W,3], reference [H,W,3] and the map of FLIP [H,W] (black 0, white 1) beside one another."""
    error = np.repeat(flip_map[..., None] * 2.0**-exposure, 3, axis=2)
    write_image(path, np.concatenate([image, reference, error], axis=1, dtype=np.float32), exposure=exposure)


def plot_error(ladder: NDArray[np.float64], baked: NDArray[np.float64], path: str | Path) -> None:
    """Draw the estimated relative error of bakes against their run time, both on logarithmic axes.

    ladder: rows of (seconds, evaluations, error) [rows,3], one a number of directions; baked: those of the bake itself.

    Raises PrtbakeError where the extra `evaluate` is not installed, StorageError if the place cannot be written.
    """
    try:
        from matplotlib.figure import Figure
        from matplotlib.ticker import LogLocator, NullFormatter
    except ImportError:
        raise PrtbakeError("report: matplotlib is not installed; install prt-bake[evaluate]") from None

    figure = Figure(figsize=(6.0, 4.0), layout="constrained")
    axes = figure.add_subplot()
    axes.loglog(ladder[:, 0], ladder[:, 2], marker="o", label="as many directions at every bin, from a few vertices")
    axes.loglog(baked[:, 0], baked[:, 2], marker="*", markersize=12, label="this bake")
    for time, count, level in [*ladder, *baked]:
        # Below the curves, which fall.
        axes.annotate(
            f"{float(f'{count / 1e6:.3g}'):g} M",
            (time, level),
            xytext=(-4, -9),
            textcoords="offset points",
            horizontalalignment="right",
            verticalalignment="top",
            fontsize=8,
        )
    axes.margins(0.15)
    for axis, form in ((axes.xaxis, "{x:g}"), (axes.yaxis, "{x:.2%}")):
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter(form)
        axis.set_minor_formatter(NullFormatter())
    axes.set(xlabel="seconds", ylabel="estimated relative RMSE of the coefficients")
    axes.set_title("network evaluations at each point, in millions (M)")
    figure.legend(loc="outside lower center", ncols=2)
    axes.grid(alpha=0.3, which="both")
    with replacing(path) as part:
        figure.savefig(part, dpi=150, format="png")


def _on_a_line(found: re.Match[str]) -> str:
    return "[" + " ".join(found.group()[1:-1].split()) + "]"


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _finite(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
