"""The tables as Markdown, with the paper's columns and figures."""

import math
from collections.abc import Iterable, Sequence
from typing import Any

from prt_bake.paper.results import (
    BARS,
    METHODS,
    PAPER_MEANS,
    PRIMARY_SAMPLING,
    TITLES,
    Line,
    Result,
    mean_flip,
    paper_row,
    paper_scene,
)
from prt_bake.paper.scenes import LEAST_SHARE, SCENES, PaperRow

_EXPLANATION = """Pictures are {size}² and show subsurface light alone: no reflection, a black background, and no
unscattered transmission. Figures are means over the pixels that the object covers completely. The exposure gives the
reference's object a median luminance of 0.18. MSE is computed on linear radiance after that exposure; SSIM and FLIP (67
pixels per degree) on sRGB values clamped to [0,1].

The row of the path tracer shows the effect of the reference's noise: the figures of an exact picture with noise of the
same strength. (Half the difference of the reference's two half buffers has the variance of its error. It is added to
the noise-free picture by SH, and the two are compared.) *no noise* estimates FLIP against a noise-free reference: the
same half difference, added to the reference, doubles its variance, and FLIP² is extrapolated linearly to zero variance.
The estimate is too high if noise dominates. *error* is the relative RMSE of linear radiance without the noise of both
pictures: the error that remains however long one renders.

*complete* adds reflection, sky and unscattered light to both pictures, with independent random numbers. Seconds are
rendering times, on {cores} CPU cores here and on a GPU in the paper. MB is the size of the model, with *lobe* and *mis*
also of the importance module, and for SH of the asset. The paper has one row for Net, repeated beside each of ours.

A dash is a figure that is unknown. SSIM needs pictures of at least 11² pixels, at quarter size of 44². *error* is known
if the noise of both pictures does not hide it."""

_COLUMNS = (
    "Scene",
    "Model",
    "SPP",
    "s",
    "MB",
    "MSE",
    "SSIM",
    "FLIP",
    "no noise",
    "error",
    "complete: MSE",
    "SSIM",
    "FLIP",
)
_PAPER_COLUMNS = ("paper: SPP", "s", "MB", "MSE", "SSIM", "FLIP")


def markdown(results: list[Result], settings: dict[str, Any]) -> str:
    """Return both tables, the means with their targets, and the method."""
    skies = list(dict.fromkeys(result.sky for result in results))
    parts = ["# The paper's tables", _EXPLANATION.format(size=settings["size"], cores=settings["cores"])]
    if settings.get("quick"):
        parts.append("**Made with --quick, as a test of the report: its figures mean nothing.**")
    for sky in skies:
        under_sky = [result for result in results if result.sky == sky]
        parts += [f"## Performance and accuracy, {sky} sky", first_table(under_sky)]
    parts += ["## Mean FLIP over the scenes", means_table(results, skies)]
    parts += ["## Net under two skies", second_table(results), _MISSING]
    parts += ["## What was compared", _remarks(results)]
    return "\n\n".join(parts) + "\n"


def first_table(results: Iterable[Result]) -> str:
    """Return the paper's first table for results under one sky."""
    rows = []
    for result in results:
        scene = paper_scene(result.scene)
        title = scene.title + (" (stand-in)" if result.stand_in else "")
        reference, noise = result.reference, result.noise
        figures = [f"noise {_figure(metric, noise[metric])}" for metric in ("mse", "ssim", "flip")]
        cost = [str(reference["spp"]), _seconds(reference["seconds"]), ""]
        rows.append([title, "Path tracing", *cost, *figures, *[""] * 5, *_paper(scene.path_tracing)])
        rows += [
            ["", TITLES[line.method], *_line(line), *_paper(paper_row(scene, line.method))] for line in result.lines
        ]
    return markdown_table((*_COLUMNS, *_PAPER_COLUMNS), rows)


def second_table(results: Iterable[Result]) -> str:
    """Return the paper's second table: Net under each sky, for the paper's scenes."""
    rows = []
    for result in results:
        scene, line = paper_scene(result.scene), result.line(PRIMARY_SAMPLING)
        if not scene.published or line is None:
            continue
        published = scene.published["net"].get(result.sky)
        name = f"{scene.title} ({result.sky})"
        for metric in ("mse", "ssim", "ssim_quarter", "flip"):
            paper = "" if published is None else _figure(metric, getattr(published, metric))
            measured = _figure(metric, line.alone[metric])
            noise = _figure(metric, result.noise[metric])
            rows.append([name, _METRICS[metric], measured, noise, paper])
            name = ""
    return markdown_table(
        ("Experiment", "Metric", f"Net ({PRIMARY_SAMPLING})", "noise of the reference", "paper: Net"), rows
    )


def means_table(results: list[Result], skies: Sequence[str]) -> str:
    """Return the mean FLIP of every method under every sky, with the targets and the paper's means."""
    rows = []
    for sky in skies:
        for method in METHODS:
            mean, count = mean_flip(results, sky, method)
            if not count:
                continue
            whole, whole_count = mean_flip(results, sky, method, "whole")
            kind = "sh" if method == "sh" else "net"
            target = f"≤ {BARS[kind]:.2f}" if method in (PRIMARY_SAMPLING, "sh") else ""
            reached = ("yes" if mean <= BARS[kind] else "no") if target and count == len(SCENES) else ""
            noiseless = mean_flip(results, sky, method, figure="flip_without_noise")[0]
            complete = shown(whole, ".4f") if whole_count else ""
            scenes = f"{count} of {len(SCENES)}"
            row = [sky, TITLES[method], scenes, shown(mean, ".4f"), target, reached]
            error = mean_flip(results, sky, method, figure="error")[0]
            row += [shown(noiseless, ".4f"), shown(error, ".1%"), complete, f"{PAPER_MEANS[kind]:.3f}"]
            rows.append(row)
    columns = ("Sky", "Model", "Scenes", "mean FLIP", "target", "reached", "no noise", "error", "complete", "paper")
    return markdown_table(columns, rows)


_METRICS = {"mse": "MSE", "ssim": "SSIM", "ssim_quarter": "SSIM, quarter size", "flip": "FLIP"}
_MISSING = (
    "NeRFactor and NeuMIP, the paper's other columns, are measured by `prtbake report paper --baselines`. The paper's "
    "pictures are 1920²; its SSIM at quarter size is computed at 480²."
)


def _remarks(results: Iterable[Result]) -> str:
    """Return a line per scene and sky: file, framing with a warning if too small, exposure, paths, model, asset."""
    lines = []
    for result in results:
        share = result.framing["object_share"]
        small = f" (**less than {LEAST_SHARE:.0%}**)" if share < LEAST_SHARE else ""
        asset = result.asset
        baked = (
            f"; asset of {asset['vertices']:,} vertices × {asset['bins']} bins, baked in {asset['seconds']:.0f} s"
            if asset
            else ""
        )
        lines.append(
            f"- {result.scene}, {result.sky}: {result.source}; the object fills {share:.1%} of the picture{small}, "
            f"{result.framing['object_pixels']:,} pixels are compared; exposure {result.stops:+.2f} stops; reference "
            f"of {result.reference['walks']:,} paths{_training(result.model)}{baked}{_projection(result)}"
        )
    return "\n".join(lines)


def _projection(result: Result) -> str:
    """Return the difference between SH and Net, which is due to the projection and the bake alone."""
    line = result.line("sh")
    flip = None if line is None else line.alone.get("flip_to_net")
    return "" if flip is None else f"; FLIP of SH against Net ({PRIMARY_SAMPLING}) {flip:.4f}"


def _training(model: dict[str, Any]) -> str:
    if "seconds" not in model or "walks" not in model:
        return ""
    rmse = model.get("relative_rmse", {}).get("coefficients")
    error = "" if rmse is None else f", error of the coefficients {rmse:.1%}"
    return f"; network trained {model['seconds'] / 60.0:.1f} minutes on {model['walks']:,} paths{error}"


def _line(line: Line) -> list[str]:
    cost = [str(line.spp), _seconds(line.seconds), f"{line.megabytes:.2f}"]
    noiseless = [shown(line.alone["flip_without_noise"], ".4f"), shown(line.alone["error"], ".1%")]
    return [*cost, *_figures(line.alone), *noiseless] + (_figures(line.whole) if line.whole else [""] * 3)


def _figures(figures: dict[str, float | None]) -> list[str]:
    return [_figure(metric, figures[metric]) for metric in ("mse", "ssim", "flip")]


def _figure(metric: str, value: float | None) -> str:
    return shown(value, ".1e" if metric == "mse" else ".4f")


def _paper(row: PaperRow) -> list[str]:
    megabytes = "" if row.megabytes is None else f"{row.megabytes:g}"
    figures = [
        "" if row.mse is None else f"{row.mse:.1e}",
        "" if row.ssim is None else f"{row.ssim:.3f}",
        "" if row.flip is None else f"{row.flip:.3f}",
    ]
    return [str(row.spp), _seconds(row.seconds), megabytes, *figures]


def _seconds(value: float) -> str:
    return f"{value:.1e}" if 0.0 < value < 0.01 else f"{value:.3g}" if value < 1000.0 else f"{value:.0f}"


def shown(figure: float | None, form: str) -> str:
    """Return a figure in a format, and a dash for an unknown one, which is None or nan.

    >>> shown(0.125, ".1%"), shown(None, ".1%")
    ('12.5%', '–')
    """
    return "–" if figure is None or math.isnan(figure) else f"{figure:{form}}"


def markdown_table(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table.

    >>> print(markdown_table(("a", "b"), [("1", "2")]))
    | a | b |
    |---|---|
    | 1 | 2 |
    """
    head = [f"| {' | '.join(columns)} |", f"|{'|'.join('---' for _ in columns)}|"]
    return "\n".join(head + [f"| {' | '.join(row)} |" for row in rows])
