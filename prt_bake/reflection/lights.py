"""Lights for next-event estimation: sampled and evaluated with densities for multiple importance sampling."""

import math
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from formats.scene.lights import DirectionalLight
from prt_bake.lights.emitters import BrightSky, Disc
from prt_bake.lights.lighting import Lighting, Sky, in_disc, solid_angle

Array = NDArray[np.float64]


class LightSource(Protocol):
    """One light of a lighting."""

    def draw(self, numbers: Array) -> tuple[Array, Array, Array]:
        """Directions [N,3] from uniform numbers [N,3], radiance over density [N,3], and density per solid angle [N]."""

    def evaluate(self, directions: Array) -> tuple[Array, Array]:
        """Radiance [N,3] from `directions` [N,3], and the density [N] with which `draw` samples them."""


class SkySource:
    """A sky that is not black, sampled in proportion to its energy."""

    def __init__(self, sky: Sky) -> None:
        """Build the sky's tables."""
        self._sky = BrightSky(sky)

    def draw(self, numbers: Array) -> tuple[Array, Array, Array]:
        """As `LightSource.draw`."""
        directions = self._sky.directions(numbers)
        radiance, density = self._sky.look_up(directions)
        weight = np.divide(radiance, density[:, None], out=np.zeros_like(radiance), where=density[:, None] > 0.0)
        return directions, weight, density

    def evaluate(self, directions: Array) -> tuple[Array, Array]:
        """As `LightSource.evaluate`."""
        return self._sky.look_up(directions)


class SunSource:
    """A directional light. Without size its density is infinite when drawn, and `evaluate` gives 0."""

    def __init__(self, sun: DirectionalLight) -> None:
        """Keep the light."""
        self._sun, self._disc = sun, Disc(sun)
        size = solid_angle(sun)
        self._density = 1.0 / size if size > 0.0 else math.inf

    def draw(self, numbers: Array) -> tuple[Array, Array, Array]:
        """As `LightSource.draw`."""
        directions, weight = self._disc.draw(numbers)
        return directions, weight, np.full(len(directions), self._density)

    def evaluate(self, directions: Array) -> tuple[Array, Array]:
        """As `LightSource.evaluate`."""
        if not math.isfinite(self._density):
            return np.zeros(directions.shape), np.zeros(len(directions))
        within = in_disc(self._sun, directions).astype(np.float64)
        return within[:, None] * self._sun.irradiance * self._density, within * self._density


def light_sources(lighting: Lighting) -> tuple[LightSource, ...]:
    """The lights of a lighting that are not black."""
    skies = [SkySource(sky) for sky in lighting.skies if sky.image.any()]
    return (*skies, *(SunSource(sun) for sun in lighting.suns if sun.irradiance.any()))
