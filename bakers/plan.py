"""What a bake will do before it does it: its size, and how it is cut into blocks."""

from dataclasses import asdict, dataclass
from typing import Any

BYTES_AT_ONCE = 8 << 20
"""Values of Ŝ held at once by one worker."""


@dataclass(frozen=True)
class BakePlan:
    """Sizes of a bake; evaluations are counted as `evaluate` alone would be called (walks, for a path tracer)."""

    vertices: int
    bins: int
    coefficients: int
    samples: int
    evaluations: int
    raw_bytes: int
    """Coefficients before compression, as stored."""
    seconds: float | None
    """Estimated from a trial block; None if none was run."""

    def as_json(self) -> dict[str, Any]:
        """Plain values for a report."""
        return asdict(self)


def plan_bake(vertices: int, bins: int, count: int, samples: int, bytes_each: int = 2) -> BakePlan:
    """The sizes of baking `count` coefficients × 3 channels at vertices × bins from `samples` directions each."""
    queries = vertices * bins
    return BakePlan(vertices, bins, count, samples, queries * samples, queries * count * 3 * bytes_each, None)


def vertices_at_once(bins: int, directions: int) -> int:
    """Vertices per block, at least 1, so that the values of one block take about 8 MiB in float32."""
    return max(1, BYTES_AT_ONCE // (bins * directions * 12))
