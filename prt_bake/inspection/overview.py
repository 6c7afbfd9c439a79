"""The first screen of `prtbake info`: what a file is, its object, its size and its error, in words."""

from collections.abc import Callable, Mapping
from typing import Any

from formats.asset.total_error import ErrorInterval
from formats.scene.units import MILLIMETRES, NO_UNIT, millimetres

Figures = Mapping[str, Any]
"""What `describe` of a file returns."""

_WHAT = {
    "mesh": "mesh",
    "picture": "picture",
    "scene": "scene: an object and what it is made of",
    "model": "model: a network that was trained on one object",
    "neumip": "model: NeuMIP, a baseline, trained on one object",
    "nerfactor": "model: NeRFactor, a baseline, trained on one object",
    "function": "function: a network of another program, for `prtbake bake --convention`",
    "lights": "lights file, for --light",
    "importance": "importance module of a model; `prtbake render` finds it by its name",
    "asset": "asset: a baked object that can be shown under any light",
    "samples": "training samples: path-traced values for `prtbake train --samples`",
}


def overview(figures: Figures) -> dict[str, str]:
    """Return the lines that a user needs first, by name, from what `prt_bake.inspection.describe` returns."""
    kind = figures["kind"]
    lines = _LINES.get(kind, _others)(figures)
    shown = {name: text for name, text in lines.items() if text}
    return {"kind": _WHAT[kind], "file": in_bytes(figures["bytes"]), **shown}


def _asset(figures: Figures) -> dict[str, str]:
    settings = {name.removeprefix("provenance: "): value for name, value in figures.items()}
    unfinished = "no; `prtbake bake --resume` goes on where the bake stopped"
    under = "" if figures["quantity"] == "transfer" else "asset: a baked object under one light, which cannot change"
    seconds, compression = settings.get("seconds"), figures.get("compact: added relative RMSE")
    eye = settings.get("settings", {}).get("for_eye")
    return {
        **({"kind": under} if under else {}),
        "object": _object(figures, settings.get("mesh")),
        "longest side": _longest_side(figures["bounds"], figures["unit"]),
        "error of the coefficients": figures["error of the coefficients"],
        "complete": "yes" if figures["complete"] else unfinished,
        "vertices baked": f"{figures['vertices baked']:,}",
        "view bins": f"{figures['rings']} rings of {figures['sectors']}" if eye is None else f"none, one eye at {eye}",
        "harmonics": f"degree {figures['degree']}",
        "lobes": figures["lobes"],
        "compressed": "" if compression is None else f"adds {compression:.2%} error",
        "pruned": ", ".join(str(item.get("item")) for item in figures["pruned"]),
        "material": str(settings.get("model", {}).get("material", "")),
        "surface": _surface(settings),
        "up": figures["up"],
        "baked from": str(settings.get("source", "")),
        "baked in": "" if seconds is None else _time(seconds),
        "command": str(settings.get("command", "")),
    }


def _model(figures: Figures) -> dict[str, str]:
    training = figures.get("training", {})
    errors = training.get("relative_rmse") or {}
    error, interval = errors.get("coefficients"), errors.get("coefficients_interval")
    trained = [
        _time(training["seconds"]) if "seconds" in training else "",
        f"{training['walks']:,} paths" if "walks" in training else "",
        f"{training['steps']:,} steps" if "steps" in training else "",
    ]
    return {
        "kind": _WHAT.get(figures["model"], _WHAT["model"]),
        "object": f"that of {figures['scene']}" if figures.get("scene") else "",
        "longest side": _length(figures["box side"], figures.get("unit", NO_UNIT)),
        "error of the coefficients": "" if error is None else str(ErrorInterval(error, *(interval or ()))),
        "glossy lobe": f"{training['lobe_share']:.1%} of Ŝ" if "lobe_share" in training else "",
        "material": str(figures.get("material", "")),
        "surface": _surface(figures),
        "up": str(figures.get("up", "")),
        "trained": ", ".join(filter(None, trained)),
        "started from": str(figures.get("started_from", "")),
        "network": f"{figures['weights']:,} weights",
    }


def _scene(figures: Figures) -> dict[str, str]:
    names = (
        *("material", "mixed with", "sigma_t", "albedo", "phase_g", "reflectance", "eta", "roughness", "normals"),
        *("longest side", "mean free path", "transport mean free path"),
    )
    thin, crossing = figures.get("thin parts"), figures.get("diffuse light through thin parts")
    thickness = figures.get("longest side in transport mean free paths")
    inside = [name.removesuffix(": in") for name in figures if name.endswith(": in")]
    return {
        "object": _object(figures, figures["mesh"]),
        **{name: str(figures[name]) for name in names if name in figures},
        "thickness": f"{thickness} transport mean free paths; 5 to 50 look translucent" if thickness else "",
        "light through thin parts": f"{crossing}, of diffuse light through {thin}" if thin else "",
        "up": figures["up"],
        "inside": "; ".join(_part(figures, name) for name in inside),
    }


def _part(figures: Figures, name: str) -> str:
    """Return the name of an inner part and what it is made of."""
    opaque, eta = f"{name}: reflectance" in figures, figures.get(f"{name}: eta")
    return f"{name}, " + str(figures.get(f"{name}: material", "opaque" if opaque else f"eta {eta:g}"))


def _mesh(figures: Figures) -> dict[str, str]:
    low, high = figures["bounds"]
    sides = " × ".join(f"{b - a:.4g}" for a, b in zip(low, high, strict=True))
    unit = "m, the unit of glTF" if figures["unit"] == "m" else "in a unit that the format does not name"
    open_edges, volume = figures["open edges"], figures["volume"]
    repairs = ("faces without area", "vertices merged")
    return {
        "object": _object(figures, None),
        "size": f"{sides} {unit}",
        "closed": f"yes, volume {volume:.4g}" if not open_edges else f"no, {open_edges} open edges",
        **{name: f"{figures[name]:,}" for name in repairs if figures[name]},
        "texture coordinates": "yes" if figures["texture coordinates"] else "no",
        **_exported(figures.get("exported", {})),
    }


def _exported(extras: Figures) -> dict[str, str]:
    """Return the lines of an exported asset; none of a plain mesh."""
    if not extras:
        return {}
    error, light = extras.get("error"), extras.get("light_degree")
    added = error.get("coefficients") if isinstance(error, Mapping) else None
    under_any = extras.get("quantity") != "radiance"
    return {
        "kind": "exported asset: a mesh with baked light for engines and browsers, "
        + ("under any light" if under_any else "under one light, which cannot change"),
        "harmonics": f"degree {extras.get('view_degree')} of the view"
        + (f", {light} of the light" if under_any else ""),
        "error of the asset": str(extras.get("asset_error", "")),
        "error of the export": f"{added:.1%} of the coefficients of the asset" if isinstance(added, float) else "",
        "not in it": ", ".join(map(str, extras.get("left_out") or ())),
        "written by": str(extras.get("generator", "")),
    }


def _picture(figures: Figures) -> dict[str, str]:
    bad = ("values not finite", "values negative")
    return {
        "can be": figures["can be"],
        "size": f"{figures['width']} × {figures['height']} pixels",
        "colours of": figures.get("colours of", ""),
        "other layers": ", ".join(figures.get("other layers", ())),
        "mean radiance": ", ".join(f"{value:.4g}" for value in figures["mean radiance"]),
        "largest radiance": f"{figures['largest radiance']:.4g}",
        **{name: f"{figures[name]:,}" for name in bad if figures[name]},
        "command": figures.get("command", ""),
    }


def _others(figures: Figures) -> dict[str, str]:
    """Return the single figures, without settings and hashes."""
    counts = ("weights", "queries")
    hidden = ("kind", "bytes", "settings: ", "scene hash", "of model")
    return {
        name: f"{value:.4g}" if isinstance(value, float) else f"{value:,}" if name in counts else str(value)
        for name, value in figures.items()
        if not isinstance(value, dict | list) and not name.startswith(hidden)
    }


def _lights(figures: Figures) -> dict[str, str]:
    counts = {name: str(figures[name]) for name in ("directional lights", "sphere lights") if figures[name]}
    return {**counts, "skies": ", ".join(figures["skies"])}


_LINES: dict[str, Callable[[Figures], dict[str, str]]] = {
    "asset": _asset,
    "model": _model,
    "scene": _scene,
    "mesh": _mesh,
    "picture": _picture,
    "lights": _lights,
}


def _object(figures: Figures, mesh: object) -> str:
    counts = f"{figures['vertices']:,} vertices, {figures['faces']:,} faces"
    return f"{mesh}: {counts}" if mesh else counts


def _longest_side(bounds: Any, unit: str) -> str:
    low, high = bounds
    return _length(max(b - a for a, b in zip(low, high, strict=True)), unit)


def _length(value: float, unit: str) -> str:
    length, name = millimetres(unit), unit if unit in MILLIMETRES else "scene units"
    return f"{value:.4g} {name}" + ("" if length is None or name == "mm" else f" ({value * length:.4g} mm)")


def _surface(figures: Figures) -> str:
    eta, roughness = figures.get("eta"), figures.get("roughness")
    if eta is None:
        return ""
    return f"index of refraction {eta:g}" + (f", roughness {roughness:g}" if isinstance(roughness, float) else "")


def _time(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 100 else f"{seconds / 60:.0f} min"


def in_bytes(count: int) -> str:
    """Return the size of a file in words, such as 1.2 MB."""
    return f"{count / 1e6:,.1f} MB" if count >= 1e5 else f"{count / 1e3:,.1f} kB"
