"""Multiple importance sampling of directions of incidence at a point: from the light, the object's lobe, or both.

Both are combined by the balance heuristic (Veach and Guibas 1995) with a factor `trust` on the light: of n directions
from the light and m from the lobe, each has the weight radiance · (trust, or 1 if from the lobe) / (trust n p_light +
m p_lobe). This is unbiased for every trust. 1 is best for independent numbers. Low-discrepancy numbers reduce the noise
of the smooth part of the integrand much more, so another trust can be better.
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
    """Distributions of incident directions at N points, dense where much light comes through the object."""

    def draw(self, numbers: Array) -> Array:
        """Directions [N,S,3] from uniform numbers [N,S,3]."""

    def density(self, directions: Array) -> Array:
        """The density [N,S] per solid angle with which `directions` [N,S,3] are drawn."""


@dataclass(frozen=True)
class Mixture:
    """The numbers of directions per point of a pixel in a pass, from the light and from the lobe, and the trust.

    Raises QueryError if a point has no direction, or if the trust is not positive.
    """

    light: tuple[int, ...]
    lobe: tuple[int, ...]
    trust: float = 1.0

    def __post_init__(self) -> None:
        if len(self.light) != len(self.lobe) or not self.light or min(self.directions) < 1 or not self.trust > 0.0:
            raise QueryError(f"mixture: expected a direction for each point and a trust above 0, found {self}")

    @property
    def directions(self) -> tuple[int, ...]:
        """Directions per point."""
        return tuple(n + m for n, m in zip(self.light, self.lobe, strict=True))

    @property
    def points(self) -> int:
        """Points per pixel and pass."""
        return len(self.light)

    @property
    def samples(self) -> int:
        """Directions per pixel and pass."""
        return sum(self.directions)

    @property
    def share(self) -> float:
        """The share of directions from the light."""
        return sum(self.light) / self.samples

    def as_json(self) -> dict[str, Any]:
        """Plain JSON values."""
        return {"light": list(self.light), "lobe": list(self.lobe), "trust": self.trust}

    @staticmethod
    def from_json(values: dict[str, Any]) -> "Mixture":
        """The inverse of `as_json`."""
        return Mixture(tuple(map(int, values["light"])), tuple(map(int, values["lobe"])), float(values["trust"]))


@dataclass(frozen=True)
class IncidentSamples:
    """Directions of incidence [N,S,3] of N points, the first `from_light` from the light, the others from the lobe.

    radiance [N,S,3] from these directions; light, lobe [N,S]: densities of both methods (None: not computed).
    """

    directions: Array
    radiance: Array
    light: Array
    lobe: Array | None
    from_light: int

    def weights(self, n: int, m: int, trust: float) -> Array:
        """The weights of Ŝ in the sum over directions [N,S,3], using the first n of the light and m of the lobe."""
        index = np.arange(self.light.shape[1])
        from_light = index < self.from_light
        factor = np.where(from_light, trust * (index < n), 1.0 * (index - self.from_light < m))
        density = trust * n * self.light
        if self.lobe is not None and m:
            density = density + m * self.lobe
        # Rounding at the rim of a bilinear tent can make both radiance and density 0.
        share = np.divide(factor, density, out=np.zeros_like(density), where=density > 0.0)
        return np.asarray(self.radiance * share[..., None])


def draw(
    sampler: LightSampler, lobe: Lobe | None, mixture: Mixture, point: int, keys: NDArray[np.uint64], seed: int
) -> IncidentSamples:
    """Sample directions for N points, each the `point`-th of its pixel; keys [N] are pixel · points + point."""
    pixels = keys // np.uint64(mixture.points)
    parts = []
    if mixture.light[point]:
        parts.append(sampler.draw(_numbers(_LIGHT_STREAM, mixture.light, point, pixels, seed)))
    if lobe is not None and mixture.lobe[point]:
        parts.append(lobe.draw(_numbers(_LOBE_STREAM, mixture.lobe, point, pixels, seed)))
    directions = parts[0] if len(parts) == 1 else np.concatenate(parts, axis=1)
    radiance, density = sampler.look_up(directions)
    lobe_density = lobe.density(directions) if lobe is not None and mixture.lobe[point] else None
    return IncidentSamples(directions, radiance, density, lobe_density, mixture.light[point])


def _numbers(stream: int, counts: tuple[int, ...], point: int, pixels: NDArray[np.uint64], seed: int) -> Array:
    """Numbers [N,S,3] of one point: its members of the low-discrepancy sequence of the pixel.

    Points take turns, so that the numbers of each point have low discrepancy too.
    """
    turns = [(turn, other) for turn in range(max(counts)) for other in range(len(counts)) if turn < counts[other]]
    members = np.array([i for i, (_turn, other) in enumerate(turns) if other == point], np.int64)
    return sobol_points(members, (stream, seed, pixels))
