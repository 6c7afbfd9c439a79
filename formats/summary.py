"""Short texts of records, for consoles and notebooks: one line for each field, arrays by shape and range."""

import dataclasses
import os
from collections.abc import Mapping
from typing import Any

import numpy as np

_FEW = 6
"""Largest number of values that are printed one by one."""
_MANY = 10_000_000
"""Largest array whose range is looked for."""
_LONG = 90
"""Characters of a field."""


def summary(record: Any) -> str:
    """A dataclass as a text of one screen, in place of the values of its arrays.

    >>> import dataclasses, numpy as np
    >>> @dataclasses.dataclass
    ... class Ball:
    ...     centre: np.ndarray
    ...     points: np.ndarray
    ...     __repr__ = summary
    >>> Ball(np.zeros(3), np.linspace(0.0, 1.0, 300).reshape(100, 3))
    Ball(
      centre: [0, 0, 0]
      points: float64 [100, 3], 0 to 1
    )
    """
    fields = [each.name for each in dataclasses.fields(record) if not each.name.startswith("_")]
    lines = [f"  {name}: {short(getattr(record, name))}" for name in fields]
    return "\n".join([f"{type(record).__name__}(", *lines, ")"])


def short(value: Any) -> str:
    """A value in one line."""
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, str | os.PathLike):
        return _cut(repr(os.fspath(value)))
    if isinstance(value, Mapping):
        return _cut(f"{len(value)} entries: {', '.join(map(str, value))}") if value else "empty"
    if isinstance(value, list | tuple):
        return _cut(repr(value)) if len(value) <= _FEW and _plain(value) else f"{len(value)} {_kinds(value)}"
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return _record(value)
    if hasattr(type(value), "dtype") and hasattr(type(value), "shape"):  # of a closed dataset the values raise
        return _array(value)
    return _cut(repr(value))


def _array(array: Any) -> str:
    try:
        shape, kind = list(array.shape), str(array.dtype)
    except (ValueError, RuntimeError):  # h5py, for a dataset of a file that was closed
        return "of a closed file"
    if not isinstance(array, np.ndarray):
        return f"{kind} {shape} in {type(array).__name__}"
    if array.ndim == 1 and array.size <= _FEW and array.dtype.kind in "fiu":
        return f"[{', '.join(f'{each:.6g}' for each in array.tolist())}]"
    if array.dtype.kind == "b":
        return f"{kind} {shape}, {int(array.sum())} true"
    if array.dtype.kind not in "fiu" or not 0 < array.size <= _MANY:
        return f"{kind} {shape}"
    finite = array[np.isfinite(array)] if array.dtype.kind == "f" else array
    if not finite.size:
        return f"{kind} {shape}, none finite"
    bad = array.size - finite.size
    return f"{kind} {shape}, {finite.min():.4g} to {finite.max():.4g}" + (f", {bad} not finite" if bad else "")


def _record(value: Any) -> str:
    """A record inside another: its sentence if it has one, else its name and the shapes of its arrays."""
    if "__str__" in vars(type(value)):
        return _cut(str(value))
    fields = ((each.name, getattr(value, each.name)) for each in dataclasses.fields(value))
    arrays = [f"{name} {list(array.shape)}" for name, array in fields if isinstance(array, np.ndarray)]
    return _cut(f"{type(value).__name__}({', '.join(arrays)})")


def _plain(values: Any) -> bool:
    return all(each is None or isinstance(each, str | int | float) for each in values)


def _kinds(values: Any) -> str:
    return " and ".join(sorted({type(each).__name__ for each in values}))


def _cut(text: str) -> str:
    text = " ".join(text.split())
    return text if len(text) <= _LONG else f"{text[: _LONG - 1]}…"
