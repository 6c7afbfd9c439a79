"""Checks of a bake's arguments, done before any work."""

import hashlib
import operator
from collections.abc import Collection
from dataclasses import replace
from typing import Any, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from formats.errors import QueryError
from formats.mesh import Mesh
from prt_bake.baking.job.pruning_record import Light
from prt_bake.baking.job.sampling import DirectionKind
from prt_bake.mathematics import sh

HIGHEST_DEGREE = 20
MOST_WORKERS = 1024
MOST_LOBES = 4
_CHOICES: dict[str, tuple[str, ...]] = {
    "directions": get_args(DirectionKind),
    "precision": ("float32", "bfloat16"),
    "storage": ("float16", "float32"),
}


def refuse_unusable(
    mesh: Mesh,
    *,
    degree: int,
    rings: int,
    sectors: int,
    samples: int | None,
    error: float | None,
    minutes: float | None,
    seed: int,
    workers: int,
    leave_out: Collection[str],
    lobes: int,
    **chosen: str,
) -> None:
    """Raises QueryError for an argument out of its domain and for a mesh without vertices."""
    if not len(mesh.positions):
        raise QueryError("mesh: expected at least one vertex to bake at, found none; give a mesh that has vertices")
    if len(bad := np.flatnonzero(~np.isfinite(mesh.positions).all(axis=1))):
        raise QueryError(
            f"mesh: {len(bad)} of {len(mesh.positions)} vertices are not finite, the first is number {bad[0]}"
        )
    _require_integer("degree", degree, 0, HIGHEST_DEGREE)
    _require_integer("rings", rings, 1, None)
    _require_integer("sectors", sectors, 1, None)
    if samples is not None:
        _require_integer("samples", samples, 1, None)
    _require_integer("seed", seed, 0, 2**63 - 1)
    _require_integer("workers", workers, 1, MOST_WORKERS)
    _require_integer("lobes", lobes, 0, MOST_LOBES)
    if error is not None and not 0.0 < _number("error", error) < 1.0:
        raise QueryError(f"error must be a relative RMSE between 0 and 1, found {error}")
    if minutes is not None and not _number("minutes", minutes) > 0.0:
        raise QueryError(f"minutes must be positive, found {minutes}")
    if isinstance(leave_out, str):
        raise QueryError(f"leave_out must be a collection of names, such as [{leave_out!r}], found {leave_out!r}")
    for name, choice in chosen.items():
        if choice not in _CHOICES[name]:
            raise QueryError(f"{name} must be one of {', '.join(_CHOICES[name])}, found {choice!r}")


def as_light(light: Light | ArrayLike | None, degree: int) -> Light | None:
    """A light from its coefficients [K,3], of `degree` or a higher one; raises QueryError for another shape."""
    if light is None:
        return None
    coefficients = np.asarray(light.coefficients if isinstance(light, Light) else light, np.float64)
    count = sh.count(degree)
    if coefficients.ndim != 2 or coefficients.shape[1] != 3 or len(coefficients) < count:
        raise QueryError(
            f"for_light: expected coefficients of shape [{count}, 3] for degree {degree}, or more rows, "
            f"found {list(coefficients.shape)}"
        )
    if not np.isfinite(coefficients).all():
        row = int(np.flatnonzero(~np.isfinite(coefficients).all(axis=1))[0])
        raise QueryError(f"for_light: expected finite coefficients, found {coefficients[row].tolist()} in row {row}")
    if isinstance(light, Light):
        return replace(light, coefficients=coefficients[:count])
    digest = hashlib.sha256(np.ascontiguousarray(coefficients[:count], "<f8").tobytes()).hexdigest()
    return Light(coefficients[:count], "a light", digest)


def as_point(eye: ArrayLike) -> NDArray[np.float64]:
    """A point [3]; raises QueryError for anything else."""
    point = np.asarray(eye, np.float64)
    if point.shape != (3,) or not np.isfinite(point).all():
        raise QueryError(f"for_eye: expected three finite numbers, found {point.tolist()}")
    return point


def _require_integer(name: str, number: Any, least: int, most: int | None) -> None:
    try:
        value = operator.index(number)
    except TypeError:
        raise QueryError(f"{name} must be a whole number, found {number!r}") from None
    if value < least:
        raise QueryError(f"{name} must be at least {least}, found {value}")
    if most is not None and value > most:
        raise QueryError(f"{name} must be at most {most:,}, found {value:,}")


def _number(name: str, value: Any) -> float:
    try:
        return float(value)
    except (TypeError, ValueError):
        raise QueryError(f"{name} must be a number, found {value!r}") from None
