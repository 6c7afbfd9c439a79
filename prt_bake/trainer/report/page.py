"""The training report as two files: JSON for programs, and a self-contained HTML page for people."""

from html import escape
from pathlib import Path
from typing import Any

from formats.atomic import replacing
from formats.json_report import as_text
from prt_bake.trainer.report.picture import error_is_known, sun_text
from prt_bake.trainer.report.plots import draw

_STYLE = """
:root { color-scheme: light dark; --ground: #ffffff; --ink: #1c1f24; --soft: #5c6470; --line: #d9dde3; --panel: #f5f6f8;
  --met: #1d7a3e; --missed: #b3261e; --open: #8a6100 }
@media (prefers-color-scheme: dark) { :root { --ground: #16181c; --ink: #e4e6ea; --soft: #9aa2ae; --line: #363b44;
  --panel: #1e2126; --met: #6fcf8f; --missed: #ff8a80; --open: #e6b450 } }
body { background: var(--ground); color: var(--ink); font: 16px/1.5 system-ui, sans-serif; margin: 0 auto;
  max-width: 62rem; padding: 1.5rem }
h1 { font-size: 1.5rem; margin: 0 0 .2rem } h2 { font-size: 1.15rem; margin: 2.2rem 0 .5rem }
p.under { color: var(--soft); margin: .2rem 0 1rem }
table { border-collapse: collapse; font-size: .9rem; width: 100% }
th, td { border-bottom: 1px solid var(--line); padding: .3rem .6rem .3rem 0; text-align: left; vertical-align: top }
td.n, th.n { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap }
div.wide { overflow-x: auto } ul { padding-left: 1.2rem } li { margin: .35rem 0 }
img { display: block; height: auto; width: 100%; image-rendering: pixelated }
svg { display: block; height: auto; max-width: 100%; width: 100%; margin: .6rem 0 }
svg text { font-family: system-ui, sans-serif !important }
.met { color: var(--met) } .not { color: var(--missed) } .undecided { color: var(--open) }
b.result { white-space: nowrap } p.quality { font-size: 1.1rem; font-weight: 600 }
"""


def write_training_report(report: dict[str, Any], json_path: str | Path, page_path: str | Path) -> None:
    """Write a report (`assess`) as JSON, then as a page, each atomically.

    Raises StorageError if a file cannot be written, PrtbakeError if matplotlib is not installed (the JSON is written by
    then).
    """
    with replacing(json_path) as part:
        part.write_text(as_text(report) + "\n", encoding="utf-8")
    page = training_page(report)
    with replacing(page_path) as part:
        part.write_text(page, encoding="utf-8")


def training_page(report: dict[str, Any]) -> str:
    """The page as HTML, plots included."""
    plots = draw(report)
    model, reference = report["model"], report["reference"]
    sections = [
        f"<h1>Accuracy of the model of {escape(model['scene'])}</h1>",
        f'<p class="under">{_trained(model)} Intervals are 95 % confidence intervals.</p>',
        f"<p class='quality'>{escape(report['summary'][0])}</p>",
        _criteria(report["criteria"]),
        f"<ul>{''.join(f'<li>{escape(sentence)}</li>' for sentence in report['summary'][1:])}</ul>",
        _section("The network's error and the reference's noise", plots["split"], _split_table(report)),
        *(_picture(part) for part in report.get("pictures", [])),
        _section("Error over time", plots.get("history", "<p>The model has no history.</p>"), _prediction(report)),
        _section(
            f"Error of {'Ŝ' if report['angles']['of'] == 'transport' else 'the coefficients'} by angle",
            plots["angles"],
            "<p class='under'>n is the normal of the face. Bins with few queries have wide intervals.</p>",
        ),
        _section("Error by position", plots["positions"], _regions(report["regions"])),
        _section("Predicted and measured values", plots["predicted"], _white_sky(report["white_sky"])),
        _section("Worst queries", _worst(report["worst"]), ""),
        _section("Seams and poles of spherical coordinates", plots["seams"], _seams(report["seams"])),
        _section("Path-traced reference", _reference(reference), ""),
    ]
    body = "\n".join(sections)
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(model['scene'])}: training report</title><style>{_STYLE}</style></head>\n"
        f"<body>\n{body}\n</body></html>\n"
    )


def _section(title: str, *parts: str) -> str:
    return "\n".join([f"<h2>{escape(title)}</h2>", *parts])


def _table(head: list[str], rows: list[list[str]], numbers_from: int = 1) -> str:
    """A table of HTML cells; columns from `numbers_from` on are numbers."""

    def line(tag: str, cells: list[str]) -> str:
        marks = [' class="n"' if column >= numbers_from else "" for column in range(len(cells))]
        return "".join(f"<{tag}{mark}>{cell}</{tag}>" for mark, cell in zip(marks, cells, strict=True))

    body = "".join(f"<tr>{line('td', row)}</tr>" for row in rows)
    return f'<div class="wide"><table><thead><tr>{line("th", head)}</tr></thead><tbody>{body}</tbody></table></div>'


def _percent(figure: dict[str, Any]) -> str:
    value = f"{100 * figure['value']:.2f} %"
    if figure["low"] is None or figure["low"] != figure["low"]:
        return value
    return f"{value} ({100 * figure['low']:.2f} to {100 * figure['high']:.2f})"


def _trained(model: dict[str, Any]) -> str:
    if not model["walks"]:
        return f"{model['weights']:,} weights."
    return (
        f"{model['weights']:,} weights, trained for {model['training_seconds'] / 60:.1f} minutes: "
        f"{model['steps']:,} steps on {model['walks']:,} paths, {model['walks_per_second']:,.0f} paths per second."
    )


def _criteria(rows: list[dict[str, Any]]) -> str:
    cells = []
    for row in rows:
        result = f'<b class="result {row["result"].split()[0]}">{escape(row["result"])}</b>'
        if "unit" in row:
            bound, figure = f"{row['bound']:g}", f"{row['value']:.4f} ({row['low']:.4f} to {row['high']:.4f})"
        else:
            bound, figure = (f"{100 * row['bound']:g} %", _percent(row)) if "bound" in row else ("", "")
        cells.append([escape(row["name"]), bound, figure, result])
    return _table(["criterion", "at most", "measured", "result"], cells)


def _split_table(report: dict[str, Any]) -> str:
    coefficients = report["coefficients"]
    parts = [
        ("Ŝ on fresh queries", report["transport"]),
        ("coefficients a_lm over the surface", coefficients["surface"]),
        ("coefficients a_lm over vertices and views", coefficients["vertices"]),
    ]
    rows = [
        [name, _percent(p["network"]), f"{p['noise']:.2%}", f"{p['together']:.2%}", f"{p['rests_on']:.0f} of {p['of']}"]
        for name, p in parts
        if p is not None
    ]
    return (
        _table(
            ["relative RMSE", "of the network", "of the reference's noise", "both together", "effective number"], rows
        )
        + "<p class='under'>Noise is subtracted in squares, without bias. Effective number: how many queries or "
        "positions of equal weight would give the same certainty; figures with a small number are uncertain. "
        f"95th percentile over vertices of a vertex's relative RMSE: {_percent(coefficients['percentile_95'])}; "
        f"{coefficients['percentile_95_uncorrected']:.2%} before the scatter of views and paths is subtracted.</p>"
    )


def _picture(part: dict[str, Any]) -> str:
    strip = (
        f'<img src="data:image/webp;base64,{part["webp"]}" width="{3 * part["size"]}" height="{part["size"]}" '
        "alt=\"The network's picture, the path tracer's picture and the FLIP map\">"
    )
    error = f"{part['error']:.2%}" if error_is_known(part) else "hidden by noise"
    return _section(
        f"A picture, sun {sun_text(part)}",
        strip,
        f"<p class='under'>Left to right: the network's picture, the path tracer's ({part['walks']} paths per pixel, "
        f"{part['seconds']:.0f} s) and the map of their difference FLIP (white is 1), under {escape(part['light'])}. "
        "Subsurface light only.</p>",
        _table(
            ["difference of the pictures", "measured", "without the reference's noise", "of noise alone"],
            [
                ["mean FLIP of the picture", *_flips(part)],
                ["mean FLIP of the object's pixels", *_flips(part["on_object"])],
                ["relative RMSE of the object's radiance", "", error, f"{part['noise']:.2%}"],
            ],
        ),
    )


def _flips(part: dict[str, Any]) -> list[str]:
    return [f"{part[name]:.4f}" for name in ("flip", "flip_without_noise", "flip_of_noise")]


def _prediction(report: dict[str, Any]) -> str:
    part = report["prediction"]
    v = part["v"]
    interval = "" if v["low"] is None or v["low"] != v["low"] else f" ({v['low']:.3g} to {v['high']:.3g})"
    rows = [
        ["v, relative variance of one path", f"{v['value']:.3g}{interval}"],
        ["weights", f"{part['weights']:,}"],
        ["paths", f"{part['walks']:,.0f}"],
        ["paths per second in training", f"{report['model']['walks_per_second']:,.0f}"],
    ]
    if part["walks"] and part["weights"]:
        rows.append(["expected error sqrt(weights · v / paths)", _percent(part["predicted"])])
    rows.append(["measured error", _percent(part["reached"])])
    return _table([f"error of {'Ŝ' if part['of'] == 'transport' else 'the coefficients'}", "value"], rows)


def _regions(regions: list[dict[str, Any]]) -> str:
    rows = [[_box(region), str(region["vertices"]), _percent(region)] for region in regions]
    return _table(["part of the object: box, in scene units", "vertices", "relative RMSE of a_lm"], rows)


def _box(region: dict[str, Any]) -> str:
    ends = zip("xyz", region["box_low"], region["box_high"], strict=True)
    return ", ".join(f"{axis} {low:.3g} … {high:.3g}" for axis, low, high in ends)


def _white_sky(part: dict[str, Any]) -> str:
    rows = [
        ["object's mean, signed", _percent(part["object"])],
        *(
            [f"its {name} channel", _percent(figure)]
            for name, figure in zip(("red", "green", "blue"), part["object_by_channel"], strict=True)
        ),
        ["95th percentile over vertices, mean of the views", _percent(part["percentile_95"])],
        ["95th percentile over vertices, rms over the views", _percent(part["percentile_95_of_views"])],
    ]
    mean = ", ".join(f"{value:.3f}" for value in part["mean"])
    return _table(["√(4π) a₀₀: radiance under a white sky", "error"], rows) + (
        f"<p class='under'>Measured mean over vertices and views: {mean} (RGB). Noise and the scatter of views "
        f"are subtracted from the percentiles; without that they are {part['percentile_95_uncorrected']:.2%} and "
        f"{part['percentile_95_of_views_uncorrected']:.2%}.</p>"
    )


def _worst(part: dict[str, Any]) -> str:
    transport = part["of"] == "transport"
    rows = []
    for row in part["rows"]:
        incident = [_vector(row["incident"])] if transport else []
        rows.append(
            [
                _vector(row["position"]),
                *incident,
                _vector(row["outgoing"]),
                f"{row['predicted']:.4g}",
                f"{row['measured']:.4g} ± {row['standard_error']:.2g}",
                f"{row['z']:.1f}",
            ]
        )
    quantity = "Ŝ [1/sr]" if transport else "√(4π) a₀₀"
    head = [
        "position",
        *(["direction to the light ωi"] if transport else []),
        "direction to the eye ωo",
        f"{quantity} of the network",
        "of the path tracer, ± one standard error",
        "difference in standard errors",
    ]
    return _table(head, rows, numbers_from=len(head) - 3) + (
        "<p class='under'>Mean over RGB. The queries are selected from the first paths and measured again with other "
        "paths, so that the selection does not bias these figures.</p>"
    )


def _vector(values: list[float]) -> str:
    return "(" + ", ".join(f"{value:.3f}" for value in values) + ")"


def _seams(part: dict[str, Any]) -> str:
    jumps = [
        [
            name,
            f"{row['there']:.4%}",
            f"{row['elsewhere']:.4%}",
            f"{row['z']:.1f}",
            "yes" if row["visible"] else "no",
        ]
        for name, row in part["jumps"].items()
    ]
    near = [
        [
            name,
            f"{row['there']:.2%}",
            f"{row['elsewhere']:.2%}",
            f"{row['z']:.1f}",
            "yes" if row["stands_out"] else "no",
        ]
        for name, row in part["errors_near"].items()
    ]
    return (
        _table(
            [
                "jump of the network, over the rms of Ŝ",
                "there",
                "elsewhere",
                "difference in standard errors",
                "visible",
            ],
            jumps,
        )
        + _table(
            [
                "relative RMSE within 10° of the seam, 15° of a pole",
                "there",
                "elsewhere",
                "difference in standard errors",
                "significant",
            ],
            near,
        )
        + "<p class='under'>Ŝ is continuous, so jumps of a network are its own error, measured without noise. More "
        "than 4 standard errors are significant; jumps below 1 % are invisible.</p>"
    )


def _reference(part: dict[str, Any]) -> str:
    reasons = {"noise": "noise a third of the error", "time": "time used up", "size": "largest number of paths"}
    rows = [
        [
            escape(name),
            f"{row['queries']:,}",
            f"{row['walks']:,}",
            f"{row['walks_per_second']:,.0f}",
            f"{row['seconds']:.1f}",
            reasons[row["ended_by"]],
        ]
        for name, row in part.items()
        if isinstance(row, dict)
    ]
    return _table(["path traced", "queries", "paths per query", "paths per second", "seconds", "ended by"], rows) + (
        f"<p class='under'>{part['directions']} directions of incidence per query, {part['vertices']} vertices "
        f"of {part['views']} views, seed {part['seed']}; the model did not learn from them.</p>"
    )
