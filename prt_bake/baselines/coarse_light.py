"""The light of a NeRFactor: a lat-long picture of 16 × 32 pixels, in which a sun is one pixel of 11°."""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from formats.image.rows import rows_of
from formats.scene.lights import DirectionalLight
from prt_bake.lights.environment import direction_of, pixel_of
from prt_bake.lights.lighting import Lighting, Sky, as_lighting
from prt_bake.lights.skies.downsampled import shrink
from prt_bake.mathematics.box_filter import zone
from prt_bake.mathematics.sphere import tangent_frame

Array = NDArray[np.float64]

LIGHT_ROWS, LIGHT_COLUMNS = 16, 32
_FINEST = 512
"""Rows of a sky beyond which it is downsampled first: its pixels are then 1/32 of those of the light."""
_DISC_POINTS = 1024


def coarse_light(light: ArrayLike | Lighting, up: str = "y", *, enlarged: int = 1) -> NDArray[np.float32]:
    """The light as a NeRFactor sees it, a lat-long picture of mean radiances, float32 [16,32,3].

    Args:
        light: a lat-long picture [H,W,3] or a lighting.
        up: the axis that points up, "y" or "z".
        enlarged: repeats each pixel in both directions. Renderers interpolate between the centres of pixels, and of
            `enlarged=16` show the steps.

    Raises ImageError and QueryError for what is no light.

    >>> import numpy as np
    >>> from prt_bake.baselines import coarse_light
    >>> coarse_light(np.ones((64, 128, 3))).shape
    (16, 32, 3)
    """
    lighting = as_lighting(light, up, 0.0)
    radiance = np.zeros((LIGHT_ROWS, LIGHT_COLUMNS, 3))
    for sky in lighting.skies:
        radiance += _means(sky, up)
    edges = np.linspace(0.0, 1.0, LIGHT_ROWS + 1)
    angles = 4.0 * np.pi / LIGHT_COLUMNS * zone(edges[1:], edges[:-1])
    for sun in lighting.suns:
        u, v = pixel_of(_disc(sun), up)
        rows = np.minimum((v * LIGHT_ROWS).astype(np.int64), LIGHT_ROWS - 1)
        columns = np.minimum((u * LIGHT_COLUMNS).astype(np.int64), LIGHT_COLUMNS - 1)
        np.add.at(radiance, (rows, columns), sun.irradiance / (len(u) * angles[rows, None]))
    return radiance.astype(np.float32).repeat(enlarged, axis=0).repeat(enlarged, axis=1)


def _means(sky: Sky, up: str) -> Array:
    """Means of a sky over the pixels, from points at least twice as dense as its own pixels."""
    if sky.image.shape[0] > _FINEST:
        sky = replace(sky, image=shrink(rows_of(sky.image), _FINEST, 0)[0])
    height, width = sky.image.shape[:2]
    finer = max(8, -(-2 * height // LIGHT_ROWS), -(-2 * width // LIGHT_COLUMNS))
    u = (np.arange(finer * LIGHT_COLUMNS) + 0.5) / (finer * LIGHT_COLUMNS)
    means = np.empty((LIGHT_ROWS, LIGHT_COLUMNS, 3))
    for row in range(LIGHT_ROWS):
        edges = (row + np.arange(finer + 1) / finer) / LIGHT_ROWS
        weights = zone(edges[1:], edges[:-1])
        points = direction_of(u, 0.5 * (edges[1:] + edges[:-1])[:, None], up).reshape(-1, 3)
        values = sky.radiance(points).reshape(finer, LIGHT_COLUMNS, finer, 3)
        means[row] = np.einsum("r,rcsk->ck", weights / (finer * weights.sum()), values)
    return means


def _disc(sun: DirectionalLight) -> Array:
    """Directions [N,3] evenly spread over the disc of a sun."""
    if sun.angular_diameter == 0.0:
        return sun.direction[None]
    number = np.arange(_DISC_POINTS) + 0.5
    cosine = 1.0 - number / _DISC_POINTS * (1.0 - math.cos(math.radians(sun.angular_diameter) / 2.0))
    sine, angle = np.sqrt(1.0 - cosine**2), math.pi * (1.0 + math.sqrt(5.0)) * number
    tangent = tangent_frame(sun.direction[None])[0]
    across = np.cos(angle)[:, None] * tangent + np.sin(angle)[:, None] * np.cross(sun.direction, tangent)
    return np.asarray(cosine[:, None] * sun.direction + sine[:, None] * across)
