"""Summary of a bake as plain values, and a plot of its error against time."""

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from formats.asset import Asset
from formats.atomic import replacing
from formats.extras import require
from prt_bake.baking.job.sample_pilot import EXACT

REACHED = 1.02
"""Times the requested error that still counts as reached."""


def bake_report(asset: Asset) -> dict[str, Any]:
    """The asset's provenance, all keys of it, and seven more, as plain JSON values.

    docs/reference/bake_report.md explains every key.

    `model_error`: error of the coefficients of the baked network after its training, if it is known.
    `error_reached`: whether the object and 95 % of its vertices have the requested error, if one was requested.
    `transport_error`: of Ŝ, without and with lobes, if it was measured what lies beyond the harmonics.
    `complete`, `vertices`, `left_out` and `error_vs_time` are those of the asset.
    """
    trained = asset.provenance.get("model", {}).get("training", {}).get("relative_rmse", {})
    requested, rmse = asset.provenance["settings"].get("error"), asset.provenance["estimated_relative_rmse"]
    known = rmse["total"] is not None
    reached = known and max(rmse["total"], rmse["percentile_95_over_vertices"]) <= REACHED * (requested or 0.0)
    return {
        **({} if trained.get("coefficients") is None else {"model_error": trained["coefficients"]}),
        **({} if requested is None else {"error_reached": asset.complete and reached}),
        **_transport_error(asset.provenance.get("lobes", {}), rmse["total"]),
        "complete": asset.complete,
        "vertices": len(asset.mesh.positions),
        "left_out": asset.left_out,
        "error_vs_time": {
            "columns": ["seconds", "evaluations", "estimated relative RMSE"],
            "rows": asset.error_vs_time.tolist(),
        },
        **asset.provenance,
    }


def _transport_error(lobes: dict[str, Any], harmonics: float | None) -> dict[str, Any]:
    """Relative RMSE of Ŝ: the error of its harmonics, and what lies beyond them or beyond the lobes."""
    beyond = lobes.get("beyond_harmonics")
    if beyond is None or harmonics is None:
        return {}
    within, left = harmonics * math.sqrt(max(1.0 - beyond**2, 0.0)), [beyond, *lobes["left_by_lobes"]][-1]
    with_lobes = left if lobes["lobes_in_a_view"] else beyond
    return {"transport_error": {"harmonics": math.hypot(within, beyond), "with_lobes": math.hypot(within, with_lobes)}}


def plot_error(ladder: NDArray[np.float64], baked: NDArray[np.float64], path: str | Path) -> None:
    """Plots the estimated relative error of bakes against their run time, both on logarithmic axes.

    ladder: rows (seconds, evaluations, error) [rows,3], one for each number of directions; an exact one is drawn as a
    line at its time. baked: rows of the bake.

    Raises PrtbakeError if the extra `evaluate` is not installed, StorageError if `path` cannot be written.
    """
    require("report", "matplotlib")
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator, NullFormatter

    figure = Figure(figsize=(6.0, 4.0), layout="constrained")
    axes = figure.add_subplot()
    axes.loglog(baked[:, 0], baked[:, 2], marker="*", markersize=12, label="this bake")
    exact = ladder[:, 2] < EXACT
    if not exact.all():
        label = "equal directions at every bin, estimated at a few vertices"
        axes.loglog(ladder[~exact, 0], ladder[~exact, 2], marker="o", label=label)
    for time in ladder[exact, 0]:
        axes.axvline(time, linestyle="--", color="gray", label="every bin: exact")
    for time, count, level in [*ladder[~exact], *baked]:
        # Labels are below the curves, which fall.
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
