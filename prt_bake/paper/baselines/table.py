"""The table of baselines as Markdown."""

import math
from collections.abc import Iterator, Sequence
from typing import Any

from prt_bake.mathematics.noise_free import Interval
from prt_bake.paper.baselines.contenders import CONTENDERS, EQUAL, FIGURES, Comparison, Contender, Entry
from prt_bake.paper.results import paper_scene
from prt_bake.paper.tables import markdown_table, shown

_EXPLANATION = """Pictures are {size}² and show subsurface light alone. Figures are means over the pixels that the
object covers completely. The exposure gives the reference's object a median luminance of 0.18. MSE is that of linear
radiance; SSIM, SSIM at quarter size and FLIP (67 pixels per degree) are those of sRGB values. Each figure is corrected
for the noise of picture and reference and has its 95 % interval. The row *noise* has the figures of two equal pictures
with such noise.

All models but *Net* learned for {minutes:g} minutes on the same machine, from walks of the same path tracer. *Net* is
the scene's own network. *× MSE* and *× FLIP* are the errors relative to those of *Net, same minutes*; above 1, that
network is ahead. *Best of class* is fitted to Ŝ itself. The other NeRFactors learned from pictures under a third sky,
*own sky* under that of the compared picture, which it knows. *512 lights* is how a NeRFactor relights as published, by
a sky of 16×32 pixels; all other rows have the whole sky.

Ŝ and a_lm are relative errors on fresh queries. *Best Lambert albedo* is the least error of a surface whose albedo is
free at every position and view: no BRDF without a glossy lobe does better. MB is the size of the model's file, s the
rendering time at {spp} samples per pixel. Directions are drawn by the importance module of *Net*.

A dash is a figure that is unknown. SSIM needs pictures of at least 11² pixels, at quarter size of 44². Behind a smooth
interface Ŝ has no values, and after a short training noise hides its error and that of a_lm. Factors need a picture by
*Net, same minutes* with an error above its noise.

The paper's figures are those of its second table, for pictures of 1920² under its own skies, with their noise. It has
one NeRFactor, one NeuMIP and one network, repeated beside each of ours."""

_COLUMNS = ("Model", "MSE", "SSIM", "SSIM ¼", "FLIP", "× MSE", "× FLIP", "Ŝ", "a_lm", "MB", "s")
_PAPER_COLUMNS = ("paper: MSE", "SSIM", "SSIM ¼", "FLIP", "× MSE", "× FLIP")
_COMPARED = ("nerfactor-unknown", "neumip")
"""The rows that stand for the paper's in the sentences below a table."""


def markdown(comparisons: Sequence[Comparison], settings: dict[str, Any]) -> str:
    """Return a table for each scene and sky, and what was compared."""
    minutes, size, spp = (settings[name] for name in ("train_minutes", "size", "spp"))
    parts = ["# Net, NeuMIP and NeRFactor", _EXPLANATION.format(size=size, minutes=minutes, spp=spp)]
    if settings.get("quick"):
        parts.append("**Made with --quick, as a test of the report: its figures mean nothing.**")
    for comparison in comparisons:
        parts += [f"## {_title(comparison)}, {comparison.sky} sky", _table(comparison)]
        parts.append("\n".join(f"- {sentence}" for sentence in _sentences(comparison)))
    return "\n\n".join(parts) + "\n"


def standing(comparison: Comparison, contender: Contender) -> str:
    """Return how far the network that learned as long is ahead of a contender, beside the paper's figures.

    "" if one of them has no picture, or if the contender is that network.
    """
    entry = comparison.entry(contender.name)
    factors = {} if entry is None else {name: comparison.factor(entry, name) for name in ("mse", "flip")}
    known = {name: factor for name, factor in factors.items() if factor is not None}
    if not known or contender.name == EQUAL:
        return ""
    parts = []
    for name, factor in known.items():
        published = comparison.published_factor(contender, name)
        beside = "" if published is None else f" (paper {_factor(published)})"
        parts.append(f"{name.upper()} is {_factor(factor)} times{beside}")
    return f"{contender.title}: its {' and its '.join(parts)} that of Net after the same minutes"


def _title(comparison: Comparison) -> str:
    return paper_scene(comparison.scene).title + (" (stand-in)" if comparison.stand_in else "")


def _table(comparison: Comparison) -> str:
    published = any(comparison.published(contender) for contender in CONTENDERS)
    columns = (*_COLUMNS, *(_PAPER_COLUMNS if published else ()))
    rows = [row + [""] * (len(columns) - len(row)) for row in _rows(comparison, published)]
    return markdown_table(columns, rows)


def _rows(comparison: Comparison, published: bool) -> Iterator[list[str]]:
    for contender, entry in zip(CONTENDERS, comparison.entries, strict=True):
        if entry.figures:
            yield [
                contender.title,
                *(_interval(name, entry.figures[name]) for name in FIGURES),
                *(_factor(comparison.factor(entry, name)) for name in ("mse", "flip")),
                *_errors(entry),
                f"{entry.megabytes:.2f}",
                f"{entry.seconds:.3g}",
                *(_published(comparison, contender) if published else []),
            ]
    noise = [shown(comparison.noise[name], ".2g") for name in FIGURES]
    yield ["*noise*", *noise]
    ceiling = [comparison.ceiling[name] for name in ("transport", "coefficients")]
    yield ["*Best Lambert albedo*", *[""] * 6, *(shown(part and part["value"], ".0%") for part in ceiling)]


def _errors(entry: Entry) -> list[str]:
    """Return the relative errors of Ŝ and of a_lm."""
    rmse = entry.training.get("relative_rmse") or {}
    values = (rmse.get(name) for name in ("transport", "coefficients"))
    return [shown(value, ".1%") for value in values]


def _published(comparison: Comparison, contender: Contender) -> list[str]:
    row = comparison.published(contender)
    if row is None:
        return []
    pairs = (comparison.published_factor(contender, name) for name in ("mse", "flip"))
    factors = ["" if factor is None else _factor(factor) for factor in pairs]
    return [f"{row.mse:.1e}", f"{row.ssim:.3f}", f"{row.ssim_quarter:.3f}", f"{row.flip:.3f}", *factors]


def _sentences(comparison: Comparison) -> Iterator[str]:
    """Yield what is compared, how far the network is ahead, and why a row is missing."""
    reference = comparison.reference
    yield (
        f"{comparison.source}; {comparison.pixels:,} pixels; exposure {comparison.stops:+.2f} stops; reference of "
        f"{reference['spp']} paths per pixel"
    )
    behind = comparison.ceiling["behind"]
    if behind is not None:
        yield f"{behind['value']:.0%} of Ŝ comes from behind the tangent plane, where a BRDF reflects nothing"
    equal = comparison.entry(EQUAL)
    if equal is not None and "walks" in equal.training:
        yield f"Net after the same minutes has learned from {equal.training['walks']:,} paths"
    for contender, entry in zip(CONTENDERS, comparison.entries, strict=True):
        if entry.missing:
            yield f"{contender.title} is left out: {entry.missing}"
        elif contender.name in _COMPARED and (sentence := standing(comparison, contender)):
            yield sentence


def _interval(figure: str, interval: Interval) -> str:
    digits = ".2g" if figure == "mse" else ".3f"
    bounds = "" if math.isnan(interval.low) else f" ({interval.low:{digits}}–{interval.high:{digits}})"
    return f"{shown(interval.value, digits)}{bounds}"


def _factor(value: float | None) -> str:
    return shown(value, ",.0f" if value is not None and value >= 10.0 else ".2g")
