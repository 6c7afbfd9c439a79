"""The quality of a trained model in words: its error, what it is good for, and what more training would bring."""

import math

from prt_bake.mathematics.noise_free import Interval
from prt_bake.network.model import NEURAL_BSSRDF

LEVELS = (
    (0.05, "good for final pictures"),
    (0.10, "good for previews and real-time use"),
    (0.20, "good for a first look"),
    (math.inf, "a rough impression"),
)
"""Largest relative RMSE of a_lm for each use: pictures under a sky are off by half of it to all of it."""
_EXPONENT, _LATE_EXPONENT = 0.2, 0.15
"""The error falls as minutes to the minus this power, first and after `_MANY` (docs/measurements/low_bands.md)."""
_MANY = 5e7
"""Walks."""
_LIMITS = {"nerfactor": "more training would bring little: no BRDF has the light that comes through the object"}
"""Kind of model → what keeps its error from falling with the minutes."""
_LITTLE = 0.95
"""More training that leaves more than this part of the error is not worth mentioning."""


def learning_minutes(seconds: float, started_from: str) -> float:
    """Minutes from which an error can be extrapolated; 0, as if unknown, if part was learned in an earlier training."""
    return 0.0 if started_from else seconds / 60.0


def quality(error: Interval, minutes: float, walks: float, kind: str = "") -> str:
    """Judge a relative RMSE of a_lm after some minutes of learning from some walks, for a model of a kind.

    Nothing is extrapolated from 0 minutes.

    >>> quality(Interval(0.044, 0.041, 0.047), minutes=0.0, walks=1e8)
    'the network is 4.4 % off (4.1 to 4.7): good for final pictures'
    """
    name = "network" if kind in ("", NEURAL_BSSRDF) else "model"
    if not math.isfinite(error.value):
        return f"the error of the {name} is unknown: the noise of its reference hides it"
    error = error.or_bound()
    interval = "" if not math.isfinite(error.low) else f" ({100 * error.low:.1f} to {100 * error.high:.1f})"
    use, worst = _use(error.value), _use(error.high)
    doubt = f" (at the upper end of this range only {worst})" if worst not in ("", use) else ""
    most, outlook = ("at most ", "") if error.is_bound else ("", _outlook(error.value, minutes, walks, kind))
    return f"the {name} is {most}{100 * error.value:.1f} % off{interval}: {use}{doubt}{outlook}"


def _use(error: float) -> str:
    return next((words for most, words in LEVELS if error <= most), "")


def _outlook(error: float, minutes: float, walks: float, kind: str) -> str:
    if not minutes > 0.0:
        return ""
    if kind in _LIMITS:
        return f"; {_LIMITS[kind]}"
    more, words = (10.0, "ten minutes more") if minutes < 20.0 else (minutes, "twice the time")
    left = (1.0 + more / minutes) ** -(_EXPONENT if walks < _MANY else _LATE_EXPONENT)
    if left > _LITTLE:
        return "; more training would bring little"
    return f"; {words} would bring about {100 * error * left:.0f} % (extrapolated)"
