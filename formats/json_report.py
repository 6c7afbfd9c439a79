"""Reports as JSON. JSON has no NaN: a number that is not finite, such as an unknown figure, becomes null."""

import json
import math
import re
from pathlib import Path
from typing import Any

from formats.atomic import replacing

_NUMBERS = re.compile(r"\[\n[^\[\]{}\"]*\]")
"""A list of plain values in indented JSON; texts in JSON contain no line breaks."""


def as_text(report: dict[str, Any]) -> str:
    """The report as indented JSON, each list of numbers on one line. Numbers that are not finite become null."""
    return _NUMBERS.sub(_on_one_line, json.dumps(finite(report), indent=2, allow_nan=False))


def as_line(value: Any) -> str:
    """The value as JSON in one line. Numbers that are not finite become null."""
    return json.dumps(finite(value), allow_nan=False)


def write_report(report: dict[str, Any], path: str | Path) -> None:
    """Writes a report as JSON, atomically; raises StorageError if `path` cannot be written."""
    with replacing(path) as part:
        part.write_text(as_text(report) + "\n", encoding="utf-8")


def finite(value: Any) -> Any:
    """The value with lists in place of tuples, and None in place of every number that is not finite."""
    if isinstance(value, dict):
        return {name: finite(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _on_one_line(found: re.Match[str]) -> str:
    return "[" + " ".join(found.group()[1:-1].split()) + "]"
