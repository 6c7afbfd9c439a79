"""What an assessment comes to: the bars that a model is held to, and a few sentences."""

from typing import Any

import numpy as np

from formats.scene import Scene
from prt_bake.mathematics.noise_free import Interval
from prt_bake.tracer.prepared import interface_kind
from prt_bake.tracer.surface.interface import MATCHED

COEFFICIENTS_PLAIN, COEFFICIENTS = 0.05, 0.10
"""Relative RMSE of a_lm asked of a homogeneous, index-matched object, and of any other."""
WHITE_SKY = 0.03
_FEW = 30.0


def criteria(found: dict[str, Any], scene: Scene) -> list[dict[str, Any]]:
    """Each bar with the figure beside it, and "met", "not met" or "undecided" where the interval holds both."""
    plain = interface_kind(scene) == MATCHED and is_homogeneous(scene)
    bar = COEFFICIENTS_PLAIN if plain else COEFFICIENTS
    kind = "homogeneous, index-matched" if plain else "grids or an interface that bends light"
    white, coefficients = found["white_sky"], found["coefficients"]
    rows = [
        (f"relative RMSE of the coefficients over the surface ({kind})", bar, coefficients["surface"]["network"]),
        (
            f"relative RMSE of the coefficients over vertices and views ({kind})",
            bar,
            coefficients["vertices"]["network"],
        ),
        ("√(4π) a₀₀, error of the object's mean", WHITE_SKY, white["object"]),
        ("√(4π) a₀₀, 95th percentile over vertices of the error, mean of the views", WHITE_SKY, white["percentile_95"]),
        (
            "√(4π) a₀₀, 95th percentile over vertices of the error, rms over the views",
            WHITE_SKY,
            white["percentile_95_of_views"],
        ),
    ]
    told = [
        {"name": name, "bound": bound, **figure, "verdict": Interval(**figure).within(bound)}
        for name, bound, figure in rows
    ]
    return [*told, _seam_verdict(found["seams"])]


def _seam_verdict(found: dict[str, Any]) -> dict[str, Any]:
    jumps, near = found["jumps"], found["errors_near"]
    seen = [name for name, jump in jumps.items() if jump["visible"]]
    seen += [f"{name} (errors near it)" for name, row in near.items() if row["stands_out"]]
    return {
        "name": "no seam or pole of spherical coordinates stands out" + (f": {', '.join(seen)}" if seen else ""),
        "verdict": "not met" if seen else "met",
    }


def is_homogeneous(scene: Scene) -> bool:
    """Whether the object is of one part, and of one medium throughout."""
    medium = scene.parts[0].medium
    if len(scene.parts) > 1 or medium is None:
        return False
    return max(np.asarray(medium.sigma_t).ndim, np.asarray(medium.albedo).ndim) < 2


def percent(figure: dict[str, float]) -> str:
    """A figure with its interval, as text."""
    if not np.isfinite(figure["low"]):
        return f"{figure['value']:.2%} (too few positions for an interval)"
    if figure["value"] == 0.0 and figure["high"] > 0.0:
        return f"below {figure['high']:.2%}"
    return f"{figure['value']:.2%} ({figure['low']:.2%} to {figure['high']:.2%})"


def criterion(row: dict[str, Any]) -> str:
    """A bar's line: the verdict, what was asked, the bound and the figure, in percent but for those of another unit."""
    if "bound" not in row:
        return f"{row['verdict']:10} {row['name']}"
    told = ("{:g}", "{:.4f}") if row.get("unit") else ("{:.0%}", "{:.2%}")
    bound, figure = (form.format(row[name]) for form, name in zip(told, ("bound", "value"), strict=True))
    return f"{row['verdict']:10} {row['name']} (at most {bound}): {figure}"


def sentences(found: dict[str, Any]) -> list[str]:
    """What there is to say, in order of weight; intervals are 95 %."""
    told = []
    if found["transport"] is not None:
        told.append(f"Relative RMSE of Ŝ on fresh queries: {_told(found['transport'])}")
    else:
        told.append(
            "Behind a smooth interface Ŝ has no values that could be estimated: coefficients alone are assessed."
        )
    coefficients = found["coefficients"]
    told.append(f"Relative RMSE of the coefficients over the surface: {_told(coefficients['surface'])}")
    told.append(
        f"Over vertices and views, as a bake asks: {_told(coefficients['vertices'])} "
        f"95 % of the vertices stay below {percent(coefficients['percentile_95'])}."
    )
    white = found["white_sky"]
    told.append(
        f"Under a white sky the object as a whole is {percent(white['object'])} off, 95 % of the vertices less than "
        f"{percent(white['percentile_95'])} (mean of the views) and {percent(white['percentile_95_of_views'])} "
        "(rms over the views)."
    )
    told.append(_told_prediction(found["prediction"]))
    told += [
        f"The path tracing of the {name} ended with the time given, before its noise was a third of the error: "
        "intervals are wider than they need be; give more seconds."
        for name in ("transport", "coefficients", "coefficients at vertices")
        if found["reference"].get(name, {}).get("ended_by") == "time"
    ]
    return told


def _told(part: dict[str, Any]) -> str:
    text = f"{percent(part['network'])}; the reference's own noise, {part['noise']:.2%}, is taken out."
    if part["rests_on"] < min(_FEW, 0.5 * part["of"]):
        text += (
            f" It rests on few of the {part['of']} queries or positions, as if on {part['rests_on']:.0f} that weigh "
        )
        text += "alike: the interval may be too narrow."
    return text


def _told_prediction(part: dict[str, Any]) -> str:
    name = "Ŝ" if part["of"] == "transport" else "the coefficients"
    v = f"One walk tells {name} with a relative variance of {part['v']['value']:.3g}"
    if not part["walks"] or not part["weights"]:
        return f"{v}; the model does not say on how many walks it was trained."
    return (
        f"{v}: {part['weights']:,} weights learnt from {part['walks']:,.0f} walks let expect "
        f"sqrt(weights · v / walks) = {part['predicted']['value']:.2%}; reached was {percent(part['reached'])}."
    )
