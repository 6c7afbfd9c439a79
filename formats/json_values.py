"""Checks of single values in JSON that other programs may have written."""

import reprlib
from collections.abc import Callable, Iterator, Mapping
from typing import Any

Check = tuple[Callable[[Any], bool], str]
"""Whether a value is as expected, and what is expected, in words."""


def value_faults(values: Mapping[str, Any], checks: Mapping[str, Check], where: str = "") -> Iterator[str]:
    """Yield a sentence for every value that fails the check of its key; keys that are missing are no faults."""
    for name, (holds, expected) in checks.items():
        if name in values and not holds(values[name]):
            yield f"{where}{name} is {reprlib.repr(values[name])}; expected {expected}"


def is_table(value: Any) -> bool:
    """Whether a value is a JSON object."""
    return isinstance(value, dict)


def is_number(value: Any) -> bool:
    """Whether a value is a number that float32 can hold."""
    return isinstance(value, int | float) and not isinstance(value, bool) and -3e38 < value < 3e38


def one_of(*choices: str) -> Check:
    """The check that a value is one of some words."""
    return (lambda value: value in choices), " or ".join(map(repr, choices))


def _is_interval(value: Any) -> bool:
    return isinstance(value, list) and len(value) == 2 and all(map(ERROR[0], value)) and value[0] <= value[1]


def _is_text(value: Any) -> bool:
    return isinstance(value, str)


TABLE: Check = is_table, "a table"
TEXT: Check = _is_text, "text"
REFRACTIVE_INDEX: Check = (
    (lambda value: is_number(value) and value > 0.0),
    "an index of refraction, a finite number above 0",
)
ERROR: Check = (lambda value: is_number(value) and value >= 0.0), "an error, a finite number from 0 on"
ERROR_OR_UNKNOWN: Check = (lambda value: value is None or ERROR[0](value)), f"{ERROR[1]}, or null"
ERROR_INTERVAL: Check = (lambda value: value is None or _is_interval(value)), "the ends of an interval, or null"
ROUGHNESS: Check = (lambda value: is_number(value) and value >= 0.0), "a GGX alpha, a finite number from 0 on"
