"""Lights that directions are drawn from: the discs of directional lights, and skies or their bright parts.

For walks a sky is split in two pictures that sum to it, looked up in the same way: `rest`, clipped at a level, which
walks find by leaving, and what is above it, which is drawn from in proportion to its energy. The split is therefore
exact.
"""

import math
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from formats.scene.lights import DirectionalLight
from prt_bake.lights import environment
from prt_bake.lights.lighting import Lighting, Sky, in_disc, solid_angle
from prt_bake.lights.sky_sampling import draw_directions, look_up, sky_table
from prt_bake.tracer.light_samples import Connections

Array = NDArray[np.float64]

_LEVELS = 96
_DARKEST = 1e-6
"""Of the mean: no level is lower, where most of a sky is black."""


class Emitter(Protocol):
    """Something that directions of incidence are drawn from."""

    def draw(self, numbers: Array) -> tuple[Array, Array]:
        """Directions [N,3] from uniform numbers [N,3], and radiance over their density per solid angle [N,3]."""


@dataclass(frozen=True, eq=False)
class Disc:
    """A directional light: drawn uniformly over its disc."""

    sun: DirectionalLight

    def draw(self, numbers: Array) -> tuple[Array, Array]:
        """As `Emitter.draw`; the irradiance is the weight of every direction."""
        return self.directions(numbers), np.broadcast_to(self.sun.irradiance, (len(numbers), 3))

    def directions(self, numbers: Array) -> Array:
        """Directions [N,3] from uniform numbers [N,2 or more]."""
        # 1 − cosine, which keeps its digits on the smallest disc.
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
    """A sky, or the bright part of one, drawn from in proportion to its energy (`sky_sampling`).

    Radiance over density is smooth, whatever the picture.
    """

    def __init__(self, sky: Sky) -> None:
        """Draw from all of `sky`, which must not be black."""
        self._table = sky_table(sky.image, sky.turn @ environment.FROM_POLAR[sky.up])

    @property
    def power(self) -> float:
        """Radiance integrated over the sphere, mean over channels."""
        return float(self._table.down[-1]) * 2.0 * math.pi**2 / self._table.weights.size

    def draw(self, numbers: Array) -> tuple[Array, Array]:
        """As `Emitter.draw`; the first two numbers are used."""
        directions = self.directions(numbers)
        light, density = self.look_up(directions)
        # At the very rim of a tent both may have been rounded to 0.
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
    """All of a lighting that has a size, drawn from in proportion to its energy, with the density of every direction.

    Each sky and each disc gets the share of its irradiance (mean over channels) among all. Directional lights without
    size are not in it. Where nothing has a size or shines, directions are uniform over the sphere.
    """

    def __init__(self, lighting: Lighting) -> None:
        """Make the tables of its skies."""
        discs = [Disc(sun) for sun in lighting.suns if sun.angular_diameter > 0.0]
        emitters: list[BrightSky | Disc] = [*(BrightSky(sky) for sky in lighting.skies if sky.image.any()), *discs]
        powers = np.array([emitter.power for emitter in emitters])
        self._emitters = [emitter for emitter, power in zip(emitters, powers, strict=True) if power > 0.0]
        self._shares = powers[powers > 0.0] / max(powers.sum(), np.finfo(float).tiny)

    def draw(self, numbers: Array) -> Array:
        """Directions [...,3] from uniform numbers [...,3]: the third chooses the light, the others the place in it."""
        rows = np.ascontiguousarray(numbers, np.float64).reshape(-1, 3)
        if not self._emitters:
            return _on_sphere(rows).reshape(numbers.shape)
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
        """Radiance [...,3] that comes from `directions` [...,3], and the density [...] with which they are drawn."""
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
    """How a lighting is gathered: by connections to `emitters`, and by walks that leave towards `skies` and `suns`."""

    emitters: tuple[Emitter, ...]
    skies: tuple[Sky, ...]
    suns: tuple[DirectionalLight, ...]


def plan_light(lighting: Lighting, connections: Connections | None) -> LightPlan:
    """Connect to all directional lights and to the bright part of skies, where there are connections and they are worth
    it.
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
    """The part of a sky that is worth connections, None where nothing is, and the rest; they sum to the sky.

    The level between them is where the expected variance is least: that of the rest over the sphere, for walks that
    leave anywhere, and that of the connections, a multiple of the bright part's squared mean. Connections are worth it
    where they lower the variance more than they cost.
    """
    grey = sky.image.mean(axis=2, dtype=np.float64)
    level = _level(grey, connections)
    if level is None:
        return None, sky
    share = np.minimum(1.0, level / np.maximum(grey, level))
    rest = (sky.image * share[..., None]).astype(np.float32)
    bright = sky.image - rest
    # A sky of one radiance exceeds its own mean by a rounding, and nothing of it is bright.
    return (replace(sky, image=bright), replace(sky, image=rest)) if bright.any() else (None, sky)


def _level(grey: Array, connections: Connections) -> float | None:
    height, width = grey.shape
    rows = np.sin(np.pi * (np.arange(height) + 0.5) / height)
    area = np.repeat(rows / (rows.sum() * width), width)
    value = grey.ravel()
    mean, largest = float(area @ value), float(value.max())
    if not largest > mean > 0.0:
        return None
    whole = float(area @ value**2) - mean**2
    lowest = min(mean, max(float(np.median(value)), _DARKEST * mean))
    levels = np.geomspace(lowest, largest, _LEVELS, endpoint=False)
    below = np.searchsorted(levels, value, side="right")  # how many of the levels lie below each pixel
    share, first, second = (
        np.cumsum(np.bincount(below, weights, _LEVELS + 1))[:_LEVELS]
        for weights in (area, area * value, area * value**2)
    )
    clipped = first + levels * (1.0 - share)
    left = second + levels**2 * (1.0 - share) - clipped**2
    variances = left + connections.variance * (mean - clipped) ** 2
    best = int(np.argmin(variances))
    return float(levels[best]) if (1.0 + connections.cost) * variances[best] < whole else None


def _on_sphere(numbers: Array) -> Array:
    height, turn = 1.0 - 2.0 * numbers[:, 0], 2.0 * math.pi * numbers[:, 1]
    radius = np.sqrt(np.maximum(0.0, 1.0 - height * height))
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), height], axis=1)


def frame_across(direction: Array) -> tuple[Array, Array]:
    """Two unit vectors across a unit vector [3]."""
    across = np.cross(direction, np.eye(3)[np.argmin(np.abs(direction))])
    across /= np.linalg.norm(across)
    return across, np.cross(direction, across)
