"""The report of `prtbake report bases` as a table, as JSON and as a plot."""

from pathlib import Path
from typing import Any

from formats.atomic import replacing
from formats.extras import require
from prt_bake.bases.rows import Estimate, Row


def as_markdown(title: str, rows: list[Row], lights: list[str], flips: dict[Row, Estimate], settings: Any) -> str:
    """A table with a row for each basis: numbers for a view bin, errors with their 95 % intervals, FLIP."""
    heads = ["basis", "numbers", "Ŝ", *lights, *([f"FLIP, {lights[0]}"] if flips else [])]
    lines = [f"# {title}", "", *_remarks(settings, bool(flips)), "", "| " + " | ".join(heads) + " |"]
    lines.append("|---" * len(heads) + "|")
    for row in rows:
        figures = [_with_interval(estimate) for estimate in (row.transport, *row.radiance)]
        own = flips.get(row)
        found = [] if own is None else [f"{own.value:.3f} ({own.low:.3f}–{own.high:.3f})"]
        lines.append("| " + " | ".join([row.name, str(row.numbers), *figures, *found]) + " |")
    return "\n".join(lines) + "\n"


def as_json(rows: list[Row], lights: list[str], flips: dict[Row, Estimate], settings: Any) -> dict[str, Any]:
    """The same as plain values; errors as fractions with `low` and `high`, the ends of their 95 % intervals."""
    return {
        "settings": settings,
        "rows": [
            {
                "basis": row.name,
                "numbers": row.numbers,
                "transport": row.transport and row.transport._asdict(),
                "radiance": {name: part._asdict() for name, part in zip(lights, row.radiance, strict=True)},
                "flip": flips[row]._asdict() if row in flips else None,
            }
            for row in rows
        ],
    }


def _remarks(settings: Any, pictures: bool) -> list[str]:
    remarks = [
        f"Relative errors at {settings['points']} points and views with 95 % intervals, in {settings['cells']} cells "
        "of directions. Numbers are those of a view bin, three channels together. Lights count in four rotations.",
    ]
    if settings["path_traced"]:
        remarks.append("Ŝ is path traced, and errors contain the noise of what is fitted to it.")
    if pictures:
        remarks.append("FLIP is the mean over the object in a small picture, and its range over the rotations.")
    return remarks


def plot(rows: list[Row], lights: list[str], path: Path) -> None:
    """Plot the errors over the numbers for a view bin, for Ŝ and for each light, a line for each kind of basis.

    Raises PrtbakeError if the extra `evaluate` is not installed, StorageError if `path` cannot be written.
    """
    require("report", "matplotlib")
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator, NullFormatter

    figure = Figure(figsize=(2.5 + 5.0 * (1 + len(lights)), 5.0), layout="constrained")
    for number, name in enumerate(["Ŝ", *lights]):
        axes = figure.add_subplot(1, 1 + len(lights), number + 1)
        for order, (kind, own) in enumerate(_by_kind(rows).items()):
            all_found = [(row.numbers, (row.transport, *row.radiance)[number]) for row in own]
            found = [(count, estimate) for count, estimate in all_found if estimate is not None]
            if not found:
                continue
            numbers, values = [count for count, _ in found], [100.0 * part.value for _, part in found]
            below = [max(0.0, 100.0 * (part.value - part.low)) for _, part in found]
            above = [max(0.0, 100.0 * (part.high - part.value)) for _, part in found]
            axes.errorbar(
                numbers, values, [below, above], marker="o", markersize=4, capsize=2, color=f"C{order}", label=kind
            )
        axes.set(xscale="log", yscale="log", xlabel="numbers for a view bin", title=name)
        axes.grid(alpha=0.3, which="both")
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axis.set_major_formatter("{x:g}")
            axis.set_minor_formatter(NullFormatter())
        if number == 0:
            axes.set_ylabel("relative error, %")
    figure.legend(*axes.get_legend_handles_labels(), loc="outside right upper", fontsize=8)
    with replacing(path) as part:
        figure.savefig(part, dpi=120, format="png")


def _by_kind(rows: list[Row]) -> dict[str, list[Row]]:
    kinds: dict[str, list[Row]] = {}
    for row in rows:
        kind = row.name.split(" degree ")[0]
        if "Gaussian" in row.name:
            kind = f"{'SH degree 2' if kind == 'SH' else 'a constant'} and Gaussians"
        elif "lobes" in row.name:
            kind = row.name
        kinds.setdefault(kind, []).append(row)
    return kinds


def _with_interval(estimate: Estimate | None) -> str:
    if estimate is None:
        return ""
    return f"{estimate.value:.1%} ({100 * estimate.low:.1f}–{100 * estimate.high:.1f})"
