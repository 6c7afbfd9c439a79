"""What a bake is asked for, refused before any work where it makes no sense."""

import operator
from collections.abc import Collection
from typing import Any, get_args

from formats.errors import QueryError
from formats.mesh import Mesh
from prt_bake.baking.job.sampling import DirectionKind

HIGHEST_DEGREE = 20
MOST_WORKERS = 1024
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
    samples: int,
    error: float | None,
    minutes: float | None,
    seed: int,
    workers: int,
    leave_out: Collection[str],
    **chosen: str,
) -> None:
    """Raises QueryError for an argument out of its domain, and for a mesh without vertices."""
    if not len(mesh.positions):
        raise QueryError("mesh: it has no vertices, and coefficients are baked at vertices; give one that has some")
    _refuse_beyond("degree", degree, 0, HIGHEST_DEGREE)
    _refuse_beyond("rings", rings, 1, None)
    _refuse_beyond("sectors", sectors, 1, None)
    _refuse_beyond("samples", samples, 1, None)
    _refuse_beyond("seed", seed, 0, 2**63 - 1)
    _refuse_beyond("workers", workers, 1, MOST_WORKERS)
    if error is not None and not 0.0 < _number("error", error) < 1.0:
        raise QueryError(f"error must be a relative RMSE between 0 and 1, found {error}")
    if minutes is not None and not _number("minutes", minutes) > 0.0:
        raise QueryError(f"minutes must be positive, found {minutes}")
    if isinstance(leave_out, str):
        raise QueryError(f"leave_out must be a collection of names, such as [{leave_out!r}], found {leave_out!r}")
    for name, choice in chosen.items():
        if choice not in _CHOICES[name]:
            raise QueryError(f"{name} must be one of {', '.join(_CHOICES[name])}, found {choice!r}")


def _refuse_beyond(name: str, number: Any, least: int, most: int | None) -> None:
    try:
        whole = operator.index(number)
    except TypeError:
        raise QueryError(f"{name} must be a whole number, found {number!r}") from None
    if whole < least:
        raise QueryError(f"{name} must be at least {least}, found {whole}")
    if most is not None and whole > most:
        raise QueryError(f"{name} must be at most {most:,}, found {whole:,}")


def _number(name: str, value: Any) -> float:
    try:
        return float(value)
    except (TypeError, ValueError):
        raise QueryError(f"{name} must be a number, found {value!r}") from None
