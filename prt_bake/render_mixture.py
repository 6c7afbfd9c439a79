"""How directions of incidence are drawn at a point: from the light, from the object's lobe, or from both.

Both together are weighted by the balance heuristic (Veach and Guibas 1995): of n directions from the light and m from the
lobe each weighs radiance / (n p_light + m p_lobe), whichever it was drawn by.
"""

from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from formats.errors import QueryError
from prt_bake.emitters import LightSampler
from prt_bake.even_numbers import even_numbers

Array = NDArray[np.float64]
Sampling = Literal["light", "lobe", "mis"]

_LIGHT_STREAM, _LOBE_STREAM = 0xA4, 0xA5


class Lobe(Protocol):
    """What directions are drawn from at N points: those where the object lets much through."""

    def draw(self, numbers: Array) -> Array:
        """Directions [N,S,3] from uniform numbers [N,S,3]."""

    def density(self, directions: Array) -> Array:
        """The density [N,S] per solid angle with which `directions` [N,S,3] are drawn."""


class LobeMaker(Protocol):
    """An importance module."""

    def lobe(self, positions: Array, outgoing: Array, normals: Array) -> Lobe:
        """The lobe of each of N points [N,3] seen along outgoing [N,3], about normals [N,3]."""


@dataclass(frozen=True)
class Counts:
    """How many directions each point of a pixel gets in a pass: `light` [points] from the light, `lobe` [points].

    Raises QueryError where a point gets none.
    """

    light: tuple[int, ...]
    lobe: tuple[int, ...]

    def __post_init__(self) -> None:
        if len(self.light) != len(self.lobe) or not self.light or min(map(sum, zip(self.light, self.lobe))) < 1:
            raise QueryError(f"counts: {self.light} and {self.lobe} where each point needs a direction")

    @property
    def share(self) -> float:
        """Of the directions, those drawn from the light."""
        return sum(self.light) / (sum(self.light) + sum(self.lobe))

    @property
    def points(self) -> int:
        """Of a pixel in a pass."""
        return len(self.light)

    @property
    def samples(self) -> int:
        """Directions a pixel and pass."""
        return sum(self.light) + sum(self.lobe)

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        return {"light": list(self.light), "lobe": list(self.lobe), "share of the light": self.share}


@dataclass(frozen=True)
class Drawn:
    """Directions of incidence [N,S,3] of N points and the radiance over density [N,S,3] of each, to be summed."""

    directions: Array
    weights: Array


def draw(
    sampler: LightSampler, lobe: Lobe | None, counts: Counts, point: int, keys: NDArray[np.uint64], seed: int
) -> Drawn:
    """Directions for N points, all the `point`-th of their pixels; keys [N] are pixel · points + point."""
    pixels = keys // np.uint64(counts.points)
    parts = []
    if counts.light[point]:
        parts.append(sampler.draw(_numbers(_LIGHT_STREAM, counts.light, point, pixels, seed)))
    if counts.lobe[point]:
        assert lobe is not None
        parts.append(lobe.draw(_numbers(_LOBE_STREAM, counts.lobe, point, pixels, seed)))
    directions = parts[0] if len(parts) == 1 else np.concatenate(parts, axis=1)
    radiance, density = sampler.look_up(directions)
    density *= counts.light[point]
    if counts.lobe[point]:
        assert lobe is not None
        density += counts.lobe[point] * lobe.density(directions)
    # Where the light is drawn alone, rounding at the rim of a tent can leave neither light nor density.
    some = (density > 0.0)[..., None]
    return Drawn(directions, np.divide(radiance, density[..., None], out=np.zeros_like(radiance), where=some))


def _numbers(stream: int, counts: tuple[int, ...], point: int, pixels: NDArray[np.uint64], seed: int) -> Array:
    """Numbers [N,S,3] of one point: its members of a sequence that all points of a pixel share.

    The points take turns, so that the numbers of one lie about as evenly as those of all.
    """
    turns = [(turn, other) for turn in range(max(counts)) for other in range(len(counts)) if turn < counts[other]]
    members = np.array([i for i, (_turn, other) in enumerate(turns) if other == point], np.int64)
    return even_numbers(members, (stream, seed, pixels))
