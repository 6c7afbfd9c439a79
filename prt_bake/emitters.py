"""Lights that walks are connected to: the discs of directional lights, and the bright part of a sky.

A sky is split in two pictures that sum to it, looked up in the same way: `rest`, clipped at a level, which walks find
by leaving, and what is above it, which is drawn from in proportion to its energy. The split is therefore exact.
"""

import math
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from formats.lights import DirectionalLight
from prt_bake import environment
from prt_bake.lighting import Lighting, Sky, solid_angle
from prt_bake.trainer.lit import Connections

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
        # 1 − cosine, which keeps its digits on the smallest disc.
        fall = numbers[:, 0] * solid_angle(self.sun) / (2.0 * math.pi)
        angle = 2.0 * math.pi * numbers[:, 1]
        sine = np.sqrt(fall * (2.0 - fall))
        across, other = _frame(self.sun.direction)
        towards = (1.0 - fall)[:, None] * self.sun.direction
        towards = towards + (sine * np.cos(angle))[:, None] * across + (sine * np.sin(angle))[:, None] * other
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        return towards, np.broadcast_to(self.sun.irradiance, towards.shape)


class BrightSky:
    """The bright part of a sky, drawn from in proportion to its energy.

    With pixel weights W (mean over channels times the sine of the row's zenith angle) the density over the picture's
    places (u, v) is the bilinear look-up of W over its sum: a pixel is chosen by its weight, a place about it by the
    tent with which the look-up spreads it. Radiance over density is then smooth, whatever the picture.
    """

    def __init__(self, sky: Sky) -> None:
        """Draw from all of `sky`, which must not be black."""
        height, width = sky.image.shape[:2]
        sines = np.sin(np.pi * (np.arange(height) + 0.5) / height)
        self._sky = sky
        self._weights = sky.image.mean(axis=2, dtype=np.float64) * sines[:, None]
        self._sums = np.cumsum(self._weights.ravel())
        self._per_place = height * width / self._sums[-1]

    def draw(self, numbers: Array) -> tuple[Array, Array]:
        """As `Emitter.draw`."""
        u, v = self._places(numbers)
        density = environment.radiance_at(self._weights[..., None], u, v) * self._per_place
        measure = 2.0 * math.pi**2 * np.sin(math.pi * v)[:, None]
        light = environment.radiance_at(self._sky.image, u, v) * measure
        # At the very rim of a tent both may have been rounded to 0.
        weight = np.divide(light, density, out=np.zeros_like(light), where=density > 0.0)
        return environment.direction_of(u, v, self._sky.up) @ self._sky.turn.T, weight

    def _places(self, numbers: Array) -> tuple[Array, Array]:
        height, width = self._weights.shape
        chosen = np.searchsorted(self._sums, numbers[:, 0] * self._sums[-1], side="right")
        row, column = np.divmod(np.minimum(chosen, height * width - 1), width)
        beside = _tent(numbers[:, 1])
        below = _tent(numbers[:, 2])
        # Beyond the first and the last centres the look-up stays level: half a pixel, as much as the tent's lost half.
        level = ((row == 0) & (below < 0.0)) | ((row == height - 1) & (below > 0.0))
        below = np.where(level, numbers[:, 2] - 0.5, below)
        return ((column + 0.5 + beside) / width) % 1.0, (row + 0.5 + below) / height


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


def _tent(numbers: Array) -> Array:
    """From uniform numbers, offsets in (−1, 1) whose density falls linearly from 1 at 0."""
    low = numbers < 0.5
    root = np.sqrt(2.0 * np.where(low, numbers, 1.0 - numbers))
    return np.where(low, root - 1.0, 1.0 - root)


def _frame(direction: Array) -> tuple[Array, Array]:
    """Two unit vectors across a unit vector [3]."""
    across = np.cross(direction, np.eye(3)[np.argmin(np.abs(direction))])
    across /= np.linalg.norm(across)
    return across, np.cross(direction, across)
