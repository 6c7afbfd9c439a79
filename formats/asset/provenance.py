"""The two JSON texts of an asset, its provenance and what was pruned: the values that shading reads."""

import json
from collections.abc import Iterator, Mapping
from typing import Any

from formats.json_values import (
    ERROR,
    ERROR_OR_UNKNOWN,
    REFRACTIVE_INDEX,
    ROUGHNESS,
    TABLE,
    Check,
    is_number,
    value_faults,
)


def provenance_faults(text: Any) -> Iterator[str]:
    """Yield a sentence for every fault of the text of /provenance/json."""
    values = _parsed(text)
    if not isinstance(values, dict):
        yield "/provenance/json is not a JSON object (NaN and Infinity are no JSON)"
        return
    faults = list(value_faults(values, _CHECKS))
    if not faults:
        faults.extend(value_faults(values.get("estimated_relative_rmse", {}), _ERRORS, "estimated_relative_rmse."))
        faults.extend(value_faults(values.get("compression", {}), _COMPRESSION, "compression."))
        # A bake that has no roughness of its own has the one of its model.
        faults.extend(value_faults(values.get("model", {}), {} if "roughness" in values else _MODEL, "model."))
        faults.extend(value_faults(values.get("settings", {}), _SETTINGS, "settings."))
    yield from (f"/provenance/json: {fault}" for fault in faults)


def pruned_faults(text: Any) -> Iterator[str]:
    """Yield a sentence for every fault of the text of the attribute left_out."""
    items = _parsed(text)
    if not isinstance(items, list):
        yield "the attribute left_out is not a JSON list"
    elif not all(isinstance(item, dict) and {"item", "reason"} <= item.keys() for item in items):
        yield "the attribute left_out is not a JSON list of tables with the keys item and reason"


def _parsed(text: Any) -> Any:
    """The JSON value, or None if there is none; JSON has no NaN and no infinity."""
    try:
        return json.loads(text, parse_constant=_refuse)
    except (ValueError, TypeError):
        return None


def _refuse(constant: str) -> None:
    raise ValueError(constant)


def _is_point(value: Any) -> bool:
    return value is None or (isinstance(value, list) and len(value) == 3 and all(map(is_number, value)))


_UNKNOWN_OR_ROUGHNESS: Check = (lambda value: value is None or ROUGHNESS[0](value)), ROUGHNESS[1]
_CHECKS: Mapping[str, Check] = {
    "eta": REFRACTIVE_INDEX,
    "roughness": _UNKNOWN_OR_ROUGHNESS,
    "seconds": ((lambda value: value is None or is_number(value)), "a number, or null"),
    **dict.fromkeys(("model", "settings", "compression", "estimated_relative_rmse"), TABLE),
}
_ERRORS: Mapping[str, Check] = {"total": ERROR_OR_UNKNOWN}
_COMPRESSION: Mapping[str, Check] = {"added_relative_rmse": ERROR}
_MODEL: Mapping[str, Check] = {"roughness": _UNKNOWN_OR_ROUGHNESS}
_SETTINGS: Mapping[str, Check] = {"for_eye": (_is_point, "a point, three numbers")}
