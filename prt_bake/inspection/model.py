"""Description and faults of a model."""

from pathlib import Path
from typing import Any

from prt_bake.network.bssrdf import load_model


def describe(path: Path) -> dict[str, Any]:
    """Return the size, the box, the settings and the metadata of a network."""
    network = load_model(path)
    return {
        "model": network.kind,
        "weights": sum(parameter.numel() for parameter in network.parameters()),
        "box minimum": network.box_min.tolist(),
        "box side": network.box_side,
        **_describe_interior(getattr(network, "view", None)),
        **{f"settings: {name}": value for name, value in network.settings.as_json().items()},
        **network.metadata,
    }


def find_faults(path: Path) -> list[str]:
    """Raise the error of reading the model; else return no faults."""
    load_model(path)
    return []


def _describe_interior(view: Any) -> dict[str, Any]:
    if view is None:
        return {}
    interior = view.interior.as_json()
    names = ("places", "spacing", "attenuation", "eta", "material")
    return {f"interior: {name}": interior[name] for name in names if name in interior}
