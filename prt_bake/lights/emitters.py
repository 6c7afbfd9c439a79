"""Importance sampling of lights: the discs of directional lights, and skies or their bright parts.

The path tracer splits a sky into two pictures that sum to it exactly. The rest, clipped at a level, is met by walks
that leave the object. The bright part above the level is sampled in proportion to its energy.
"""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from formats.scene.lights import DirectionalLight
from prt_bake.lights.lighting import Lighting, Sky, in_disc, solid_angle
from prt_bake.lights.skies.sampling import draw_directions, look_up, sky_table
from prt_bake.mathematics.directions import on_sphere

Array = NDArray[np.float64]

_LEVELS = 96
_MIN_LEVEL = 1e-6
"""The lowest level over the mean radiance, for skies that are mostly black."""


class Emitter(Protocol):
    """A light that directions of incidence are drawn from."""

    def draw(self, numbers: Array) -> tuple[Array, Array]:
        """Directions [N,3] from uniform numbers [N,3], and radiance over their density per solid angle [N,3]."""


@dataclass(frozen=True, eq=False)
class Disc:
    """A directional light, sampled uniformly over its disc."""

    sun: DirectionalLight

    def draw(self, numbers: Array) -> tuple[Array, Array]:
        """As `Emitter.draw`; every direction has the irradiance as its weight."""
        return self.directions(numbers), np.broadcast_to(self.sun.irradiance, (len(numbers), 3))

    def directions(self, numbers: Array) -> Array:
        """Directions [N,3] from uniform numbers [N,2 or more]."""
        # 1 − cosine keeps its digits on the smallest disc.
        fall = numbers[:, 0] * solid_angle(self.sun) / (2.0 * math.pi)
        angle = 2.0 * math.pi * numbers[:, 1]
        sine = np.sqrt(fall * (2.0 - fall))
        across, other = frame_across(self.sun.direction)
        towards = (1.0 - fall)[:, None] * self.sun.direction
        towards = towards + (sine * np.cos(angle))[:, None] * across + (sine * np.sin(angle))[:, None] * other
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        return np.asarray(towards)

    @property
    def power(self) -> float:
        """Irradiance, mean over channels."""
        return float(np.mean(self.sun.irradiance))

    def look_up(self, directions: Array) -> tuple[Array, Array]:
        """Radiance [N,3] from `directions` [N,3], and the density [N] per solid angle with which they are drawn."""
        density = in_disc(self.sun, directions) / solid_angle(self.sun)
        return density[:, None] * self.sun.irradiance, density


class BrightSky:
    """A sky, or its bright part, sampled in proportion to its energy (`prt_bake.lights.skies.sampling`).

    Radiance over density is smooth for every picture.
    """

    def __init__(self, sky: Sky) -> None:
        """Build the tables of a sky that is not black."""
        self._table = sky_table(sky.image, sky.to_object)

    @property
    def power(self) -> float:
        """Radiance integrated over the sphere, mean over channels."""
        return float(self._table.down[-1]) * 2.0 * math.pi**2 / self._table.weights.size

    def draw(self, numbers: Array) -> tuple[Array, Array]:
        """As `Emitter.draw`; only the first two numbers count."""
        directions = self.directions(numbers)
        light, density = self.look_up(directions)
        # Rounding at the rim of a bilinear tent can make both 0.
        return directions, np.divide(light, density[:, None], out=np.zeros_like(light), where=density[:, None] > 0.0)

    def directions(self, numbers: Array) -> Array:
        """Directions [N,3] from uniform numbers [N,2 or more]."""
        directions = np.empty((len(numbers), 3))
        draw_directions(self._table, numbers, directions)
        return directions

    def look_up(self, directions: Array) -> tuple[Array, Array]:
        """Radiance [N,3] from `directions` [N,3], and the density [N] per solid angle with which they are drawn."""
        radiance, density = np.zeros(directions.shape), np.empty(len(directions))
        look_up(self._table, directions, radiance, density)
        return radiance, density


class LightSampler:
    """Samples all lights of a lighting that have a size, in proportion to their energy, and knows every density.

    A sky or disc is chosen with the probability of its irradiance (mean over channels) among all. Directional lights
    without size are left out. If no light has a size or all are black, directions are uniform over the sphere.
    """

    def __init__(self, lighting: Lighting) -> None:
        """Build the tables of the skies."""
        discs = [Disc(sun) for sun in lighting.suns if sun.angular_diameter > 0.0]
        emitters: list[BrightSky | Disc] = [*(BrightSky(sky) for sky in lighting.skies if sky.image.any()), *discs]
        powers = np.array([emitter.power for emitter in emitters])
        self._emitters = [emitter for emitter, power in zip(emitters, powers, strict=True) if power > 0.0]
        self._shares = powers[powers > 0.0] / max(powers.sum(), np.finfo(float).tiny)

    def draw(self, numbers: Array) -> Array:
        """Directions [...,3] from uniform numbers [...,3]; the third one chooses the light."""
        rows = np.ascontiguousarray(numbers, np.float64).reshape(-1, 3)
        if not self._emitters:
            return on_sphere(rows[:, 0], rows[:, 1]).reshape(numbers.shape)
        if len(self._emitters) == 1:
            return self._emitters[0].directions(rows).reshape(numbers.shape)
        chosen = np.searchsorted(np.cumsum(self._shares)[:-1], rows[:, 2], side="right")
        directions = np.empty(rows.shape)
        for i, emitter in enumerate(self._emitters):
            directions[chosen == i] = emitter.directions(rows[chosen == i])
        return directions.reshape(numbers.shape)

    def density(self, directions: Array) -> Array:
        """The density [...] per solid angle with which `directions` [...,3] are drawn."""
        return self.look_up(directions)[1]

    def look_up(self, directions: Array) -> tuple[Array, Array]:
        """Radiance [...,3] from `directions` [...,3], and the density [...] with which they are drawn."""
        rows = np.ascontiguousarray(directions, np.float64).reshape(-1, 3)
        radiance, density = np.zeros(rows.shape), np.zeros(len(rows))
        for emitter, share in zip(self._emitters, self._shares, strict=True):
            light, drawn = emitter.look_up(rows)
            radiance += light
            density += share * drawn
        if not self._emitters:
            density[:] = 0.25 / math.pi
        return radiance.reshape(directions.shape), density.reshape(directions.shape[:-1])


@dataclass(frozen=True, eq=False)
class LightPlan:
    """The lights that walks connect to (`emitters`), and those that they meet when they leave (`skies`, `suns`)."""

    emitters: tuple[Emitter, ...]
    skies: tuple[Sky, ...]
    suns: tuple[DirectionalLight, ...]


class Connections(NamedTuple):
    """Efficiency of a path tracer's connections to one direction of incidence.

    variance: of one walk's light sample, over its squared mean. cost: of such a walk, over that of a walk without
    connections.
    """

    variance: float
    cost: float


def plan_light(lighting: Lighting, connections: Connections | None) -> LightPlan:
    """Connect to all directional lights, and to the bright parts of skies that are worth it.

    Without connections all lights are met by walks that leave.
    """
    if connections is None:
        return LightPlan((), lighting.skies, lighting.suns)
    emitters: list[Emitter] = [Disc(sun) for sun in lighting.suns]
    skies = []
    for sky in lighting.skies:
        bright, rest = split_sky(sky, connections)
        emitters += [] if bright is None else [BrightSky(bright)]
        skies.append(rest)
    return LightPlan(tuple(emitters), tuple(skies), ())


def split_sky(sky: Sky, connections: Connections) -> tuple[Sky | None, Sky]:
    """The bright part of a sky that is worth connections (None if nothing is), and the rest; they sum to the sky.

    The level between them has the least expected variance: the variance of the rest over the sphere, for walks that
    leave in any direction, plus the variance of the connections, a multiple of the bright part's squared mean.
    Connections are worth it if they lower the variance more than they cost.
    """
    grey = sky.image.mean(axis=2, dtype=np.float64)
    level = _level(grey, connections)
    if level is None:
        return None, sky
    share = np.minimum(1.0, level / np.maximum(grey, level))
    rest = (sky.image * share[..., None]).astype(np.float32)
    bright = sky.image - rest
    # A constant sky can exceed its own mean by a rounding error; it has no bright part.
    return (replace(sky, image=bright), replace(sky, image=rest)) if bright.any() else (None, sky)


def _level(grey: Array, connections: Connections) -> float | None:
    height, width = grey.shape
    rows = np.sin(np.pi * (np.arange(height) + 0.5) / height)
    area = np.repeat(rows / (rows.sum() * width), width)
    value = grey.ravel()
    mean, largest = float(area @ value), float(value.max())
    if not largest > mean > 0.0:
        return None
    deviation = value - mean
    variance = float(area @ deviation**2)
    lowest = min(mean, max(float(np.median(value)), _MIN_LEVEL * mean))
    levels = np.geomspace(lowest, largest, _LEVELS, endpoint=False)
    below = np.searchsorted(levels, value, side="right")  # the number of levels below each pixel
    share, first, second = (
        np.cumsum(np.bincount(below, weights, _LEVELS + 1))[:_LEVELS]
        for weights in (area, area * deviation, area * deviation**2)
    )
    clipped = first + (levels - mean) * (1.0 - share)  # mean of the rest minus mean of the sky
    rest_variance = second + (levels - mean) ** 2 * (1.0 - share) - clipped**2
    variances = rest_variance + connections.variance * clipped**2
    best = int(np.argmin(variances))
    return float(levels[best]) if (1.0 + connections.cost) * variances[best] < variance else None


def frame_across(direction: Array) -> tuple[Array, Array]:
    """Two unit vectors orthogonal to a unit vector [3] and to each other."""
    across = np.cross(direction, np.eye(3)[np.argmin(np.abs(direction))])
    across /= np.linalg.norm(across)
    return across, np.cross(direction, across)
