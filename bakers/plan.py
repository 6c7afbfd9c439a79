"""The size of a bake, before it runs: evaluations, bytes, block size, and what is pruned."""

from dataclasses import asdict, dataclass, field
from typing import Any

BYTES_AT_ONCE = 8 << 20
"""Bytes of Ŝ that one worker holds at once."""


@dataclass(frozen=True)
class PrunableItem:
    """A part of a bake that may be redundant: vertices, views, bands or channels."""

    item: str
    reason: str
    """The measurement by which it is pruned or kept."""
    saving: str
    """What the asset or the bake saves; empty if the item is kept."""
    cost: str
    """The cost of the measurement, and the error that pruning adds."""

    def as_json(self) -> dict[str, str]:
        """Plain values for a report."""
        return asdict(self)


@dataclass(frozen=True)
class BakePlan:
    """Sizes of a bake; evaluations are counted as calls of `evaluate` (walks, for a path tracer)."""

    vertices: int
    bins: int
    coefficients: int
    samples: int
    evaluations: int
    raw_bytes: int
    """Coefficients before compression, as stored."""
    seconds: float | None
    """Predicted duration of the bake, from a few blocks; None if none was baked."""
    seconds_between: tuple[float, float] | None = None
    """Range that the duration is very likely in; None if unknown."""
    left_out: list[PrunableItem] = field(default_factory=list)
    kept: list[PrunableItem] = field(default_factory=list)
    lobes: dict[str, Any] = field(default_factory=dict)
    """The entry of the provenance, with the predicted seconds and bytes."""
    effort: str = ""
    """When the bake ends, in words."""
    error: float | None = None
    """Error that an adaptive bake will have: the requested one, or the one that its time allows; None if unknown."""

    def as_json(self) -> dict[str, Any]:
        """Plain values for a report."""
        return asdict(self)


def vertices_at_once(bins: int, directions: int) -> int:
    """Vertices per block, at least 1, so that the values of one block take about 8 MiB in float32."""
    return max(1, BYTES_AT_ONCE // (bins * directions * 12))
