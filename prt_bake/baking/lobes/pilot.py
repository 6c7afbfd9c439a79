"""Tries at a few vertices what lobes gain, and how many pay."""

import time
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from prt_bake.baking.lobes.search import Index, LobeSearch

GAIN = 0.025
"""A lobe is kept if it explains at least this share of Ŝ, as a root mean square."""
_VERTICES = 64


class LobePlan(NamedTuple):
    """The lobes that pay, by a few vertices, and what they gain there in views and directions that were not fitted."""

    own: int
    fitted: int
    beyond: float
    """Root mean square of Ŝ beyond the harmonics, relative to Ŝ."""
    left: list[float]
    """The same less the transport's own lobes, and less each further lobe."""
    seconds: float
    """Of the search at one vertex."""

    @property
    def lobes(self) -> int:
        """Number of lobes in a view."""
        return self.own + self.fitted

    def as_json(self) -> dict[str, Any]:
        """Plain values for provenance."""
        return {"lobes_in_a_view": self.lobes, "beyond_harmonics": self.beyond, "left_by_lobes": self.left}


def plan_lobes(search: LobeSearch, vertices: Index, most: int) -> LobePlan:
    """The lobes that pay at `vertices`, at most `most` in a view."""
    some = np.unique(vertices[np.linspace(0, len(vertices) - 1, min(_VERTICES, len(vertices))).astype(np.int64)])
    values, scale = search.values(some, 1)
    unit = scale.max() or 1.0
    values = _in_units(values, scale / unit)
    rest = search.check.beyond_harmonics(values)
    own = search.own_fields(some)[:most]
    whole = rest.copy()
    for field in own:
        search.check.subtract(field._replace(powers=field.powers / unit), whole, -1.0)
    beyond, before = _squares(whole), _squares(rest)
    total = _squares(values) - before + beyond
    if total <= 0.0:
        return LobePlan(0, 0, 0.0, [], 0.0)
    number = len(own) if beyond - before >= GAIN**2 * total else 0
    left = [before] if number else []
    search.fields(some[:1], False, 1)  # kernels are compiled before the time is taken
    began = time.monotonic()
    if before >= GAIN**2 * total and number < most:
        left += _fitted(search, some, most - number, unit, rest, GAIN**2 * total)
    seconds = (time.monotonic() - began) / len(some)
    shares = np.sqrt(np.divide(left, total)).tolist()
    return LobePlan(number, len(left) - bool(number), float(np.sqrt(beyond / total)), shares, seconds)


def none_gained(plan: LobePlan, grid: tuple[int, int]) -> str:
    """Why no lobe pays at rings × sectors nodes."""
    if plan.beyond < GAIN:
        return "they would gain nothing"
    return f"they would gain nothing at {grid[0]}×{grid[1]} nodes; with more view bins there are more, up to 8×16"


def _fitted(
    search: LobeSearch, vertices: Index, most: int, unit: float, held_out: NDArray[np.float32], worth: float
) -> list[float]:
    """Squares that are left in the held-out views after each fitted lobe that takes at least `worth` from them."""
    values, scale = search.values(vertices, 0)
    rest = search.fit.beyond_harmonics(_in_units(values, scale / unit))
    left, before = list[float](), _squares(held_out)
    while len(left) < most:
        search.check.subtract(search.fit.add(rest), held_out)
        if before - _squares(held_out) < worth:
            break
        left.append(before := _squares(held_out))
    return left


def _in_units(values: NDArray[np.float32], scale: NDArray[np.float64]) -> NDArray[np.float32]:
    return values * scale.astype(np.float32)[:, None, None, None]


def _squares(values: NDArray[np.floating]) -> float:
    return float(np.square(values, dtype=np.float64).sum())
