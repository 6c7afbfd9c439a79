"""How far a bake goes: to an error, for a time, or with a fixed number of samples; and what it does by default."""

import math
from dataclasses import dataclass
from typing import Any

from bakers.transport import transport_kind
from formats.errors import QueryError
from prt_bake.mathematics import sh

DEFAULT_SAMPLES = 64
DEFAULT_ERROR = 0.02
"""Relative RMSE of an adaptive bake if neither an error, a time nor a number of samples is given."""


@dataclass(frozen=True)
class Effort:
    """When a bake ends, and a sentence for the user."""

    adaptive: bool
    """Refined to an error or for a time, not the same number of samples everywhere."""
    samples: int
    """Per view bin; an adaptive bake ignores it."""
    error: float | None
    minutes: float | None
    sentence: str
    """What is done, and why if it was not asked for."""


def choose_effort(
    transport: Any, degree: int, directions: str, samples: int | None, error: float | None, minutes: float | None
) -> Effort:
    """The effort of a bake of `transport` to `degree`; None is an argument that was not given.

    Without any of them, a transport that evaluates Ŝ over Fibonacci lattices is baked to `DEFAULT_ERROR`; random walks,
    of which 1/error² are needed, and other directions take 64 samples, or twice as many directions as coefficients.
    Raises QueryError for a time that nothing can use.
    """
    walks = transport_kind(transport) == "coefficients"
    refinable = directions == "fibonacci" and not walks
    if minutes is not None and not refinable:
        raise QueryError(
            f"minutes: only bakes with fibonacci directions of a transport that evaluates Ŝ can run for a time, found "
            f"{'path tracing' if walks else f'{directions} directions'}; give samples or an error instead"
        )
    default = DEFAULT_SAMPLES if walks else max(DEFAULT_SAMPLES, 2 * sh.count(degree))
    fixed = samples if samples is not None else default
    unit = "paths" if walks else "directions"
    if error is not None or minutes is not None:
        ignored = "" if samples is None else f"; the {samples} {unit} per view bin are ignored"
        return Effort(refinable, fixed, error, minutes, _goal(error, minutes) + ignored)
    if samples is not None:
        return Effort(False, fixed, None, None, f"with {samples} {unit} per view bin")
    if refinable:
        return Effort(True, fixed, DEFAULT_ERROR, None, f"{_goal(DEFAULT_ERROR, None)}, the default")
    return Effort(False, fixed, None, None, f"with {fixed} {unit} per view bin, the default")


def _goal(error: float | None, minutes: float | None) -> str:
    """The goal in words, such as "to 2 % error, for at most 5 minutes"."""
    goals = []
    if error is not None:
        goals.append(f"to {100.0 * error:g} % error")
    if minutes is not None:
        unit = "minute" if minutes == 1.0 else "minutes"
        until = "until it is stopped" if math.isinf(minutes) else f"{minutes:g} {unit}"
        least = "" if math.isinf(minutes) else "for at most " if error is not None else "for "
        goals.append(least + until)
    return ", ".join(goals)
