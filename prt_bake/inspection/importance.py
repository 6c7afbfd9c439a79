"""Description and faults of an importance module."""

from pathlib import Path
from typing import Any

from prt_bake.importance.module import load_importance, read_importance


def describe(path: Path) -> dict[str, Any]:
    """Return the model's hash, the size, the settings and the metadata of an importance module."""
    module, model = read_importance(path)
    return {
        "of model": model,
        "weights": sum(parameter.numel() for parameter in module.parameters()),
        **{f"settings: {name}": value for name, value in module.settings.as_json().items()},
        **module.metadata,
    }


def find_faults(path: Path) -> list[str]:
    """Raise the error of reading the module, or if it belongs to another model; else return no faults."""
    read_importance(path)
    load_importance(path.with_name(path.stem.removesuffix(".importance") + path.suffix))
    return []
