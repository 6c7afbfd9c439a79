"""What a bake will do before it does it: its size, how it is cut into blocks, and what it leaves out."""

from dataclasses import asdict, dataclass, field
from typing import Any

BYTES_AT_ONCE = 8 << 20
"""Values of Ŝ held at once by one worker."""


@dataclass(frozen=True)
class Item:
    """Something that a scene may not need."""

    item: str
    reason: str
    """What was seen that speaks for leaving it out, or against."""
    saving: str
    """What the asset or the bake has less of; empty where it is kept."""
    cost: str
    """What it took to find out, and the error that it adds."""

    def as_json(self) -> dict[str, str]:
        """Plain values for a report."""
        return asdict(self)


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
    """From the beginning to the asset, as a few blocks foretell it; None if none was baked."""
    seconds_between: tuple[float, float] | None = None
    """What it hardly falls short of and hardly exceeds; None where nothing tells."""
    left_out: list[Item] = field(default_factory=list)
    kept: list[Item] = field(default_factory=list)

    def as_json(self) -> dict[str, Any]:
        """Plain values for a report."""
        return asdict(self)


def plan_bake(
    vertices: int, bins: int, count: int, samples: int, bytes_each: int = 2, channels: int = 3, views: int | None = None
) -> BakePlan:
    """The sizes of baking `count` coefficients × channels at vertices × bins from `samples` directions each, of which
    the asset keeps `views`, all by default.
    """
    queries, kept = vertices * bins, vertices * (bins if views is None else views)
    return BakePlan(vertices, bins, count, samples, queries * samples, kept * count * channels * bytes_each, None)


def vertices_at_once(bins: int, directions: int) -> int:
    """Vertices per block, at least 1, so that the values of one block take about 8 MiB in float32."""
    return max(1, BYTES_AT_ONCE // (bins * directions * 12))
