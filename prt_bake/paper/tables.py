"""The tables as Markdown: the paper's columns, and the paper's own figures beside ours."""

import math
from collections.abc import Iterable, Sequence
from typing import Any

from prt_bake.paper.results import (
    BARS,
    PRIMARY_SAMPLING,
    METHODS,
    PAPER_MEANS,
    TITLES,
    Line,
    Result,
    mean_flip,
    paper_row,
    paper_scene,
)
from prt_bake.paper.scenes import LEAST_SHARE, SCENES, PaperRow

_LAW = """Pictures of {size}², light from under the surface alone: nothing reflected, black behind the object, none of
the light that crosses it without scattering. Figures are means over the pixels that the object covers wholly. The
exposure gives the reference's object a median luminance of 0.18; MSE is of linear radiance after that exposure, SSIM
and FLIP (67 pixels a degree) of the sRGB curve cut to [0,1].

The line of the path tracer holds what its own noise does to each figure: a picture that is exact but for noise as
strong as the reference's would have them. (Half the difference between the two halves of the reference's passes has
the variance of its error; it is added to the picture by SH, which has no noise, and the two are compared.) *noise out*
is an estimate of FLIP against a reference without noise: the same half difference added to the reference doubles its
variance, and FLIP² is drawn on in a straight line to none. Where noise is most of it, that is too high. *error* is the
relative RMSE of linear radiance with the noise of both pictures taken out: what is wrong however long one renders.

In *all in*, reflection, sky and the light that crosses unscattered are in both pictures, from other random numbers in
each. Seconds are of rendering alone,
on {cores} CPU cores here, on a GPU in the paper. MB: the model; with *lobe* and *mis* the importance module too; of SH
the asset. The paper has one line for Net; it stands beside each of ours."""

_COLUMNS = (
    "Scene",
    "Model",
    "SPP",
    "s",
    "MB",
    "MSE",
    "SSIM",
    "FLIP",
    "noise out",
    "error",
    "all in: MSE",
    "SSIM",
    "FLIP",
)
_PAPER_COLUMNS = ("paper: SPP", "s", "MB", "MSE", "SSIM", "FLIP")


def markdown(results: list[Result], settings: dict[str, Any]) -> str:
    """Both tables, the means against the bars, and how they were measured."""
    skies = list(dict.fromkeys(result.sky for result in results))
    parts = ["# The paper's tables", _LAW.format(size=settings["size"], cores=settings["cores"])]
    if settings.get("quick"):
        parts.append("**Made with --quick: it shows the form of the tables alone; its figures say nothing.**")
    for sky in skies:
        chosen = [result for result in results if result.sky == sky]
        parts += [f"## Performance and accuracy, {sky} sky", first_table(chosen)]
    parts += ["## Mean FLIP over the scenes", means_table(results, skies)]
    parts += ["## Net under two skies", second_table(results), _NOT_THERE]
    parts += ["## What was compared", _remarks(results)]
    return "\n\n".join(parts) + "\n"


def first_table(results: Iterable[Result]) -> str:
    """The paper's first table for results under one sky."""
    rows = []
    for result in results:
        scene = paper_scene(result.scene)
        title = scene.title + (" (stand-in)" if result.stand_in else "")
        reference, noise = result.reference, result.noise
        figures = [f"noise {_small(noise['mse'])}", f"noise {noise['ssim']:.4f}", f"noise {noise['flip']:.4f}"]
        cost = [str(reference["spp"]), _seconds(reference["seconds"]), ""]
        rows.append([title, "Path tracing", *cost, *figures, *[""] * 5, *_paper(scene.path_tracing)])
        rows += [
            ["", TITLES[line.method], *_line(line), *_paper(paper_row(scene, line.method))] for line in result.lines
        ]
    return _table((*_COLUMNS, *_PAPER_COLUMNS), rows)


def second_table(results: Iterable[Result]) -> str:
    """The paper's second table: Net under each sky, for the scenes that the paper has there."""
    rows = []
    for result in results:
        scene, line = paper_scene(result.scene), result.line(PRIMARY_SAMPLING)
        if scene.net_by_sky is None or line is None:
            continue
        theirs = scene.net_by_sky.get(result.sky)
        name = f"{scene.title} ({result.sky})"
        for metric in ("mse", "ssim", "ssim_quarter", "flip"):
            paper = "" if theirs is None else _figure(metric, getattr(theirs, metric))
            ours = _figure(metric, line.alone[metric])
            noise = _figure(metric, result.noise[metric])
            rows.append([name, _METRICS[metric], ours, noise, paper])
            name = ""
    return _table(("Experiment", "Metric", f"Net ({PRIMARY_SAMPLING})", "the reference's noise", "paper: Net"), rows)


def means_table(results: list[Result], skies: Sequence[str]) -> str:
    """Mean FLIP of every method under every sky against the bars and the paper."""
    rows = []
    for sky in skies:
        for method in METHODS:
            mean, count = mean_flip(results, sky, method)
            if not count:
                continue
            whole, with_all = mean_flip(results, sky, method, "whole")
            kind = "sh" if method == "sh" else "net"
            bar = f"≤ {BARS[kind]:.2f}" if method in (PRIMARY_SAMPLING, "sh") else ""
            reached = ("yes" if mean <= BARS[kind] else "no") if bar and count == len(SCENES) else ""
            noiseless = mean_flip(results, sky, method, figure="flip_without_noise")[0]
            all_in = f"{whole:.4f}" if with_all else ""
            scenes = f"{count} of {len(SCENES)}"
            row = [sky, TITLES[method], scenes, f"{mean:.4f}", bar, reached]
            error = mean_flip(results, sky, method, figure="error")[0]
            row += [f"{noiseless:.4f}", f"{error:.1%}", all_in, f"{PAPER_MEANS[kind]:.3f}"]
            rows.append(row)
    return _table(
        ("Sky", "Model", "Scenes", "mean FLIP", "bar", "reached", "noise out", "error", "all in", "paper"), rows
    )


_METRICS = {"mse": "MSE", "ssim": "SSIM", "ssim_quarter": "SSIM, quarter size", "flip": "FLIP"}
_NOT_THERE = (
    "NeRFactor and NeuMIP, the paper's other columns, are not there yet. The paper's pictures are of 1920², SSIM at "
    "quarter size of 480²."
)


def _remarks(results: Iterable[Result]) -> str:
    """A line a scene and sky: file, framing, exposure, walks; a warning where the object fills too little."""
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
            f"{result.framing['object_pixels']:,} pixels count; exposure {result.stops:+.2f} stops; reference of "
            f"{result.reference['walks']:,} walks{_trained(result.model)}{baked}{_of_degree_two(result)}"
        )
    return "\n".join(lines)


def _of_degree_two(result: Result) -> str:
    """What SH and Net differ by: degree 2 and the bake, whatever the network has learnt."""
    line = result.line("sh")
    flip = None if line is None else line.alone.get("flip_to_net")
    return "" if flip is None else f"; FLIP of SH against Net ({PRIMARY_SAMPLING}) {flip:.4f}"


def _trained(model: dict[str, Any]) -> str:
    if "seconds" not in model or "walks" not in model:
        return ""
    rmse = model.get("relative_rmse", {}).get("coefficients")
    error = "" if rmse is None else f", error of its coefficients {rmse:.1%}"
    return f"; network trained {model['seconds'] / 60.0:.1f} minutes on {model['walks']:,} walks{error}"


def _line(line: Line) -> list[str]:
    cost = [str(line.spp), _seconds(line.seconds), f"{line.megabytes:.2f}"]
    noiseless = [f"{line.alone['flip_without_noise']:.4f}", f"{line.alone['error']:.1%}"]
    return [*cost, *_figures(line.alone), *noiseless] + (_figures(line.whole) if line.whole else [""] * 3)


def _figures(figures: dict[str, float]) -> list[str]:
    return [_figure(metric, figures[metric]) for metric in ("mse", "ssim", "flip")]


def _figure(metric: str, value: float) -> str:
    return _small(value) if metric == "mse" else f"{value:.4f}"


def _paper(row: PaperRow) -> list[str]:
    megabytes = "" if row.megabytes is None else f"{row.megabytes:g}"
    figures = [
        "" if row.mse is None else _small(row.mse),
        "" if row.ssim is None else f"{row.ssim:.3f}",
        "" if row.flip is None else f"{row.flip:.3f}",
    ]
    return [str(row.spp), _seconds(row.seconds), megabytes, *figures]


def _small(value: float) -> str:
    return "nan" if math.isnan(value) else f"{value:.1e}"


def _seconds(value: float) -> str:
    return f"{value:.1e}" if 0.0 < value < 0.01 else f"{value:.3g}" if value < 1000.0 else f"{value:.0f}"


def _table(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    head = [f"| {' | '.join(columns)} |", f"|{'|'.join('---' for _ in columns)}|"]
    return "\n".join(head + [f"| {' | '.join(row)} |" for row in rows])
