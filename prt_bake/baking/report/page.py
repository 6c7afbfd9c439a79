"""The report of a bake as a table and a plot."""

import math
from pathlib import Path
from typing import Any

from formats.atomic import replacing
from formats.errors import PrtbakeError
from prt_bake.baking.report.budget import Part
from prt_bake.baking.report.methods import Row, seconds_for, slope

MARKED = 0.01, 0.001


def by_way(rows: list[Row]) -> dict[str, list[Row]]:
    """Rows of each way, in the order in which they came."""
    ways: dict[str, list[Row]] = {}
    for row in rows:
        ways.setdefault(row.way, []).append(row)
    return ways


def as_json(rows: list[Row], parts: list[Part], bins: int) -> dict[str, Any]:
    """Plain values; `bins` in the whole asset."""
    ways = by_way(rows)
    return {
        "bins_in_the_asset": bins,
        "rows": [vars(row) | {"efficiency": row.efficiency} for row in rows],
        "slopes": {way: slope(some)[0] for way, some in ways.items()},
        "seconds_a_bin_for": {
            way: {f"{error:g}": seconds_for(some, error)[0] for error in MARKED} for way, some in ways.items()
        },
        "error_budget": [vars(part) for part in parts],
    }


def as_markdown(title: str, rows: list[Row], parts: list[Part], bins: int, remarks: list[str]) -> str:
    """Tables of error against time, of what an error takes, and of the parts of the error."""
    ways = by_way(rows)
    uniform = max((row.efficiency for row in rows if row.way.startswith("uniform")), default=math.nan)
    lines = [
        f"# {title}",
        "",
        *remarks,
        "",
        "| way | evaluations a bin | µs a bin | error | told | efficiency, uniform = 1 |",
        "|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {row.way} | {row.evaluations:,.4g} | {1e6 * row.seconds:,.4g} | {row.error:.3%} | {row.told:.3%} "
        f"| {row.efficiency / uniform:,.3g} |"
        for row in rows
    ]
    lines += ["", "| way | slope of error over time | 1 % takes | 0.1 % takes |", "|---|---|---|---|"]
    for way, some in ways.items():
        lines.append(f"| {way} | {slope(some)[0]:.2f} | {_told(some, 0.01, bins)} | {_told(some, 0.001, bins)} |")
    if parts:
        lines += ["", "| what errs in the picture | relative RMSE of its radiance | measured |", "|---|---|---|"]
        lines += [f"| {part.name} | {part.radiance:.3%} | {part.how} |" for part in parts]
    return "\n".join(lines) + "\n"


def _told(rows: list[Row], error: float, bins: int) -> str:
    seconds, carried = seconds_for(rows, error)
    if not math.isfinite(seconds):
        return "not known"
    whole = seconds * bins
    unit, name = next((u, n) for u, n in ((86400.0, "d"), (3600.0, "h"), (60.0, "min"), (0.0, "s")) if whole >= u)
    return f"{whole / (unit or 1.0):,.3g} {name}{' (by the slope)' if carried else ''}"


def plot(rows: list[Row], path: str | Path) -> None:
    """Error over seconds a view bin of every way, on logarithmic axes, with the fitted laws.

    Raises PrtbakeError where the extra `evaluate` is not installed, StorageError if the place cannot be written.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise PrtbakeError("report: matplotlib is not installed; install prt-bake[evaluate]") from None

    figure = Figure(figsize=(7.0, 5.0), layout="constrained")
    axes = figure.add_subplot()
    for way, some in by_way(rows).items():
        seconds, errors = [row.seconds for row in some], [row.error for row in some]
        steepness, at_one = slope(some)
        (line,) = axes.loglog(seconds, errors, marker="o", linestyle="", label=f"{way} ({steepness:.2f})")
        if math.isfinite(steepness):
            ends = [min(seconds), max(seconds)]
            axes.loglog(ends, [math.exp(at_one) * s**steepness for s in ends], color=line.get_color(), alpha=0.6)
    axes.set(xlabel="seconds a view bin, one core", ylabel="relative RMSE of the coefficients")
    axes.set_title("error against run time (slope of the fitted law)")
    axes.legend()
    axes.grid(alpha=0.3, which="both")
    with replacing(path) as part:
        figure.savefig(part, dpi=150, format="png")
