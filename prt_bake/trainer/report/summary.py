"""Summary of an assessment: the criteria that a model must meet, and a few sentences."""

from typing import Any

import numpy as np

from formats.scene import Scene
from prt_bake.mathematics.noise_free import Interval
from prt_bake.tracer.prepared import interface_kind
from prt_bake.tracer.surface.interface import MATCHED
from prt_bake.trainer.report.quality import learning_minutes, quality

COEFFICIENTS_PLAIN, COEFFICIENTS = 0.05, 0.10
"""Largest relative RMSE of a_lm for a homogeneous, index-matched object, and for any other."""
WHITE_SKY = 0.03
_FEW = 30.0


def criteria(found: dict[str, Any], scene: Scene) -> list[dict[str, Any]]:
    """The criteria with figures and results: "met", "not met", or "undecided" if the interval contains the bound."""
    plain = interface_kind(scene) == MATCHED and is_homogeneous(scene)
    bound = COEFFICIENTS_PLAIN if plain else COEFFICIENTS
    kind = "homogeneous, index-matched" if plain else "heterogeneous or with an interface"
    white, coefficients = found["white_sky"], found["coefficients"]
    rows = [
        (f"relative RMSE of the coefficients over the surface ({kind})", bound, surface_error(found).as_json()),
        (
            f"relative RMSE of the coefficients over vertices and views ({kind})",
            bound,
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
    criteria = [
        {"name": name, "bound": most, **figure, "result": Interval(**figure).within(most)}
        for name, most, figure in rows
    ]
    return [*criteria, _seam_criterion(found["seams"])]


def _seam_criterion(seams: dict[str, Any]) -> dict[str, Any]:
    visible = [name for name, jump in seams["jumps"].items() if jump["visible"]]
    visible += [f"{name} (errors near it)" for name, row in seams["errors_near"].items() if row["stands_out"]]
    return {
        "name": "no visible seam or pole of spherical coordinates" + (f": {', '.join(visible)}" if visible else ""),
        "result": "not met" if visible else "met",
    }


def is_homogeneous(scene: Scene) -> bool:
    """Whether the object is a single part with a constant medium."""
    medium = scene.parts[0].medium
    if len(scene.parts) > 1 or medium is None:
        return False
    return max(np.asarray(medium.sigma_t).ndim, np.asarray(medium.albedo).ndim) < 2


def percent(figure: dict[str, float]) -> str:
    """A figure with its interval as text, in percent."""
    if not np.isfinite(figure["value"]):
        return "unknown (the reference is no brighter than its noise)"
    if not np.isfinite(figure["low"]):
        return f"{figure['value']:.2%} (too few positions for an interval)"
    if figure["value"] == 0.0 and figure["high"] > 0.0:
        return f"below {figure['high']:.2%}"
    return f"{figure['value']:.2%} ({figure['low']:.2%} to {figure['high']:.2%})"


def criterion_line(row: dict[str, Any]) -> str:
    """A criterion as a line of text: result, name, bound and figure, in percent unless the row has a unit."""
    if "bound" not in row:
        return f"{row['result']:10} {row['name']}"
    formats = ("{:g}", "{:.4f}") if row.get("unit") else ("{:.0%}", "{:.2%}")
    bound, figure = (form.format(row[name]) for form, name in zip(formats, ("bound", "value"), strict=True))
    return f"{row['result']:10} {row['name']} (at most {bound}): {figure}"


def sentences(found: dict[str, Any]) -> list[str]:
    """The assessment in sentences, the most important first; intervals are 95 % confidence intervals."""
    model, surface = found["model"], surface_error(found)
    minutes = learning_minutes(model["training_seconds"], model.get("started_from", ""))
    summary = [quality(surface, minutes, model["walks"], model.get("kind", ""))]
    if found["transport"] is not None:
        summary.append(f"Relative RMSE of Ŝ on fresh queries: {_error_text(found['transport'])}")
    else:
        summary.append("Ŝ has no values in this scene; only the coefficients are assessed.")
    coefficients = found["coefficients"]
    text = _error_text(coefficients["surface"])
    if _ends_better(found):
        text = f"{percent(surface.as_json())}, measured at the end of the training."
    summary.append(f"Relative RMSE of the coefficients over the surface: {text}")
    summary.append(
        f"Relative RMSE of the coefficients over vertices and views, as in a bake: "
        f"{_error_text(coefficients['vertices'])} 95 % of the vertices are below "
        f"{percent(coefficients['percentile_95'])}."
    )
    white = found["white_sky"]
    summary.append(
        f"Under a white sky the error of the object's mean is {percent(white['object'])}. 95 % of the vertices are "
        f"below {percent(white['percentile_95'])} (mean of the views) and below "
        f"{percent(white['percentile_95_of_views'])} (rms over the views)."
    )
    summary.append(_prediction_text(found["prediction"]))
    summary += [
        f"Path tracing of the {name} used up its time before its noise was a third of the error; "
        "more seconds make the intervals narrower."
        for name in ("transport", "coefficients", "coefficients at vertices")
        if found["reference"].get(name, {}).get("ended_by") == "time"
    ]
    return summary


def surface_error(found: dict[str, Any]) -> Interval:
    """The error of a_lm over the surface: that of the end of the training, unless this assessment has more queries."""
    if _ends_better(found):
        return final_error(found["model"]["final_errors"])
    return Interval(**found["coefficients"]["surface"]["network"])


def _ends_better(found: dict[str, Any]) -> bool:
    errors = found["model"]["final_errors"]
    final = final_error(errors)
    known = np.isfinite(final.value) and not final.is_bound
    return bool(known and errors.get("queries", 0) >= found["coefficients"]["surface"]["of"])


def final_error(errors: dict[str, Any] | None) -> Interval:
    """The error of a_lm at the end of a training with its interval, NaN where they are unknown."""
    if errors is None or errors["coefficients"] is None:
        return Interval(np.nan, np.nan, np.nan)
    return Interval(errors["coefficients"], *(errors.get("coefficients_interval") or (np.nan, np.nan)))


def _error_text(part: dict[str, Any]) -> str:
    text = f"{percent(part['network'])}; the reference's noise, {part['noise']:.2%}, is subtracted."
    if part["rests_on"] < min(_FEW, 0.5 * part["of"]):
        text += (
            f" Few of the {part['of']} queries or positions dominate the error (effective number "
            f"{part['rests_on']:.0f}): the interval may be too narrow."
        )
    return text


def _prediction_text(part: dict[str, Any]) -> str:
    name = "Ŝ" if part["of"] == "transport" else "the coefficients"
    v = f"A single path estimates {name} with a relative variance of {part['v']['value']:.3g}"
    if not part["walks"] or not part["weights"]:
        return f"{v}; the model does not state on how many paths it was trained."
    return (
        f"{v}. For {part['weights']:,} weights and {part['walks']:,.0f} paths the expected error is "
        f"sqrt(weights · v / paths) = {part['predicted']['value']:.2%}; the measured error is "
        f"{percent(part['reached'])}."
    )
