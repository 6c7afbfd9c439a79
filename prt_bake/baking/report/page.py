"""The report of `prtbake report bake` as JSON, as tables and as a plot."""

import math
from pathlib import Path
from typing import Any

from formats.atomic import replacing
from formats.extras import require
from prt_bake.baking.report.budget import Part
from prt_bake.baking.report.methods import Row, seconds_for, slope

ERRORS = 0.01, 0.001


def rows_by_method(rows: list[Row]) -> dict[str, list[Row]]:
    """The rows of each method, in their order."""
    methods: dict[str, list[Row]] = {}
    for row in rows:
        methods.setdefault(row.method, []).append(row)
    return methods


def as_json(rows: list[Row], parts: list[Part], bins: int) -> dict[str, Any]:
    """The report as plain values; `bins`: view bins of the asset."""
    methods = rows_by_method(rows)
    return {
        "bins_in_the_asset": bins,
        "rows": [
            {
                "method": row.method,
                "evaluations": row.evaluations,
                "seconds": row.seconds,
                "error": row.error,
                "reported": row.reported,
                "efficiency": row.efficiency,
            }
            for row in rows
        ],
        "slopes": {method: slope(own)[0] for method, own in methods.items()},
        "seconds_a_bin_for": {
            method: {f"{error:g}": seconds_for(own, error)[0] for error in ERRORS} for method, own in methods.items()
        },
        "error_budget": [vars(part) for part in parts],
    }


def as_markdown(title: str, rows: list[Row], parts: list[Part], bins: int, remarks: list[str]) -> str:
    """Tables of error against time, of the time for an error, and of the parts of the error of a picture."""
    methods = rows_by_method(rows)
    uniform = max((row.efficiency for row in rows if row.method.startswith("uniform")), default=math.nan)
    lines = [
        f"# {title}",
        "",
        *remarks,
        "",
        "| method | evaluations per bin | µs per bin | error | reported error | efficiency, uniform = 1 |",
        "|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {row.method} | {row.evaluations:,.4g} | {1e6 * row.seconds:,.4g} | {row.error:.3%} | {row.reported:.3%} "
        f"| {row.efficiency / uniform:,.3g} |"
        for row in rows
    ]
    lines += ["", "| method | slope of error over time | 1 % takes | 0.1 % takes |", "|---|---|---|---|"]
    for method, own in methods.items():
        lines.append(f"| {method} | {_slope(own)} | {_time(own, 0.01, bins)} | {_time(own, 0.001, bins)} |")
    if parts:
        lines += ["", "| source of error in the picture | relative RMSE of its radiance | measured |", "|---|---|---|"]
        lines += [f"| {part.name} | {part.radiance:.3%} | {part.how} |" for part in parts]
    return "\n".join(lines) + "\n"


def _slope(rows: list[Row]) -> str:
    steepness = slope(rows)[0]
    return "unknown" if math.isnan(steepness) else f"{steepness:.2f}"


def _time(rows: list[Row], error: float, bins: int) -> str:
    """Time of the whole bake for an error."""
    per_bin, extrapolated = seconds_for(rows, error)
    if not math.isfinite(per_bin):
        return "unknown"
    seconds = per_bin * bins
    unit, name = next((u, n) for u, n in ((86400.0, "d"), (3600.0, "h"), (60.0, "min"), (0.0, "s")) if seconds >= u)
    return f"{seconds / (unit or 1.0):,.3g} {name}{' (extrapolated)' if extrapolated else ''}"


def plot(rows: list[Row], path: str | Path) -> None:
    """Plots error over seconds per view bin for every method, on logarithmic axes, with the fitted power laws.

    Raises PrtbakeError if the extra `evaluate` is not installed, StorageError if `path` cannot be written.
    """
    require("report", "matplotlib")
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 5.0), layout="constrained")
    axes = figure.add_subplot()
    for method, own in rows_by_method(rows).items():
        seconds, errors = [row.seconds for row in own], [row.error for row in own]
        steepness, at_one = slope(own)
        (line,) = axes.loglog(seconds, errors, marker="o", linestyle="", label=f"{method} ({_slope(own)})")
        if math.isfinite(steepness):
            ends = [min(seconds), max(seconds)]
            axes.loglog(ends, [math.exp(at_one) * s**steepness for s in ends], color=line.get_color(), alpha=0.6)
    axes.set(xlabel="seconds per view bin, one core", ylabel="relative RMSE of the coefficients")
    axes.set_title("error against run time (slope of the fitted power law)")
    axes.legend()
    axes.grid(alpha=0.3, which="both")
    with replacing(path) as part:
        figure.savefig(part, dpi=150, format="png")
