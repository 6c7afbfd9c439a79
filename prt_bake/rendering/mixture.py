"""How directions of incidence are drawn at a point: from the light, from the object's lobe, or from both.

Both together are weighted by the balance heuristic (Veach and Guibas 1995) with the light's share times a `trust`: of n
directions from the light and m from the lobe each counts radiance · (trust, or 1 if from the lobe) / (trust n p_light +
m p_lobe). That is unbiased for any trust; 1 is best for independent numbers. Evenly placed ones make the smooth part of
the integrand, which one of the two ways may have to itself, far less noisy than that.
"""

from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from formats.errors import QueryError
from prt_bake.lights.emitters import LightSampler
from prt_bake.mathematics.sobol import sobol_points

Array = NDArray[np.float64]
Sampling = Literal["light", "lobe", "mis"]

_LIGHT_STREAM, _LOBE_STREAM = 0xA4, 0xA5


class Lobe(Protocol):
    """What directions are drawn from at N points: those from where the object lets much through."""

    def draw(self, numbers: Array) -> Array:
        """Directions [N,S,3] from uniform numbers [N,S,3]."""

    def density(self, directions: Array) -> Array:
        """The density [N,S] per solid angle with which `directions` [N,S,3] are drawn."""


@dataclass(frozen=True)
class Mixture:
    """How many directions each point of a pixel gets in a pass, from the light and from the lobe, and the trust.

    Raises QueryError where a point gets none, and where the trust is not above 0.
    """

    light: tuple[int, ...]
    lobe: tuple[int, ...]
    trust: float = 1.0

    def __post_init__(self) -> None:
        if len(self.light) != len(self.lobe) or not self.light or min(self.directions) < 1 or not self.trust > 0.0:
            raise QueryError(f"mixture: {self} where each point needs a direction, and the trust is above 0")

    @property
    def directions(self) -> tuple[int, ...]:
        """Of each point."""
        return tuple(n + m for n, m in zip(self.light, self.lobe, strict=True))

    @property
    def points(self) -> int:
        """Of a pixel in a pass."""
        return len(self.light)

    @property
    def samples(self) -> int:
        """Directions a pixel and pass."""
        return sum(self.directions)

    @property
    def share(self) -> float:
        """Of the directions, those drawn from the light."""
        return sum(self.light) / self.samples

    def as_json(self) -> dict[str, Any]:
        """Plain values; the reverse of `from_json`."""
        return {"light": list(self.light), "lobe": list(self.lobe), "trust": self.trust}

    @staticmethod
    def from_json(values: dict[str, Any]) -> "Mixture":
        """What `as_json` gave."""
        return Mixture(tuple(map(int, values["light"])), tuple(map(int, values["lobe"])), float(values["trust"]))


@dataclass(frozen=True)
class Drawn:
    """Directions of incidence [N,S,3] of N points, the first `from_light` from the light, the others from the lobe.

    radiance [N,S,3] that comes from there; light, lobe [N,S]: with which density each way draws them (None: not asked).
    """

    directions: Array
    radiance: Array
    light: Array
    lobe: Array | None
    from_light: int

    def weights(self, n: int, m: int, trust: float) -> Array:
        """What Ŝ is multiplied by in the sum over directions [N,S,3], of which the first n and m of each way
        count.
        """
        turn = np.arange(self.light.shape[1])
        from_light = turn < self.from_light
        factor = np.where(from_light, trust * (turn < n), 1.0 * (turn - self.from_light < m))
        density = trust * n * self.light
        if self.lobe is not None and m:
            density = density + m * self.lobe
        # Where the light is drawn alone, rounding at the rim of a tent can leave neither light nor density.
        share = np.divide(factor, density, out=np.zeros_like(density), where=density > 0.0)
        return np.asarray(self.radiance * share[..., None])


def draw(
    sampler: LightSampler, lobe: Lobe | None, mixture: Mixture, point: int, keys: NDArray[np.uint64], seed: int
) -> Drawn:
    """Directions for N points, all the `point`-th of their pixels; keys [N] are pixel · points + point."""
    pixels = keys // np.uint64(mixture.points)
    parts = []
    if mixture.light[point]:
        parts.append(sampler.draw(_numbers(_LIGHT_STREAM, mixture.light, point, pixels, seed)))
    if lobe is not None and mixture.lobe[point]:
        parts.append(lobe.draw(_numbers(_LOBE_STREAM, mixture.lobe, point, pixels, seed)))
    directions = parts[0] if len(parts) == 1 else np.concatenate(parts, axis=1)
    radiance, density = sampler.look_up(directions)
    beside = lobe.density(directions) if lobe is not None and mixture.lobe[point] else None
    return Drawn(directions, radiance, density, beside, mixture.light[point])


def _numbers(stream: int, counts: tuple[int, ...], point: int, pixels: NDArray[np.uint64], seed: int) -> Array:
    """Numbers [N,S,3] of one point: its members of a sequence that all points of a pixel share.

    The points take turns, so that the numbers of one lie about as evenly as those of all.
    """
    turns = [(turn, other) for turn in range(max(counts)) for other in range(len(counts)) if turn < counts[other]]
    members = np.array([i for i, (_turn, other) in enumerate(turns) if other == point], np.int64)
    return sobol_points(members, (stream, seed, pixels))
