"""Lights of every kind as lat-long pictures, for programs that read nothing else.

Suns and sphere lights become discs of the same irradiance. A sun narrower than three rows of the picture is drawn that
wide, which its harmonics of a low degree do not show.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from formats.image.rows import rows_of
from formats.mesh import Mesh
from formats.scene.lights import DirectionalLight
from prt_bake.lights.environment import direction_of, rotation
from prt_bake.lights.lighting import Lighting, Sky, read_lighting
from prt_bake.lights.skies.downsampled import shrink

Array = NDArray[np.float64]

MOST_ROWS = 1024
"""Larger skies are downsampled, since a page projects them on a few harmonics."""
_ROWS = 256
_BLOCK = 64
"""Rows that are computed at once."""
_PARTS = 4
"""Samples along each side of a pixel at the edge of a disc."""


def light_picture(
    light: str | Path, up: str, mesh: Mesh | None, *, mend: bool = False, say: Callable[[str], None] = print
) -> tuple[NDArray[np.float32], Lighting]:
    """Return a light as a lat-long picture [H,W,3] with `up` on top, and the lighting that it shows.

    Args:
        light: what `prt.read_lighting` takes: a picture, a lights file, `sun:…` or `sphere:…`.
        up: the axis that points up, "y" or "z".
        mesh: the object, which sphere lights are seen from the middle of.
        mend: repairs bad pixels of skies.
        say: called with warnings.

    Channels below 0, which `.hdr` cannot store, are 0. Raises as `prt.read_lighting`.
    """
    lighting = read_lighting([light], up, mend=mend, say=say, mesh=mesh, most_rows=MOST_ROWS, degree=0)
    skies = [_small(sky) for sky in lighting.skies]
    if len(skies) == 1 and not lighting.suns and np.array_equal(skies[0].turn, rotation(0.0, up)):
        return np.maximum(skies[0].image, 0.0), lighting
    height = max([_ROWS, *(sky.image.shape[0] for sky in skies)])
    width = max([2 * height, *(sky.image.shape[1] for sky in skies)])
    picture = np.zeros((height, width, 3))
    for first in range(0, height, _BLOCK):
        directions = _directions(np.arange(first, min(first + _BLOCK, height)) + 0.5, height, width, up)
        for sky in skies:
            picture[first : first + _BLOCK] += sky.radiance(directions.reshape(-1, 3)).reshape(directions.shape)
    for sun in lighting.suns:
        _add_disc(picture, sun, up)
    return np.maximum(picture, 0.0).astype(np.float32), lighting


def _small(sky: Sky) -> Sky:
    if sky.image.shape[0] <= MOST_ROWS:
        return sky
    return replace(sky, image=shrink(rows_of(sky.image), MOST_ROWS, 0)[0], residual=None)


def _directions(rows: Array, height: int, width: int, up: str) -> Array:
    """Unit directions [R,width,3] of the pixels of some `rows` [R], which may be fractions."""
    columns = (np.arange(width) + 0.5) / width
    return direction_of(columns[None, :], rows[:, None] / height, up)


def _add_disc(picture: Array, sun: DirectionalLight, up: str) -> None:
    """Add a disc of constant radiance to a picture [H,W,3]: its irradiance is that of the sun."""
    height, width = picture.shape[:2]
    radius = max(math.radians(sun.angular_diameter) / 2.0, 1.5 * math.pi / height)
    middle = math.acos(max(-1.0, min(1.0, float(direction_of(0.5, 0.0, up) @ sun.direction))))
    first = max(0, math.floor((middle - radius) / math.pi * height))
    end = min(height, math.ceil((middle + radius) / math.pi * height))
    within = (np.arange(_PARTS) + 0.5) / _PARTS
    share = np.zeros((end - first, width))
    for down in within:
        for across in within:
            directions = direction_of(
                (np.arange(width)[None, :] + across) / width, (np.arange(first, end)[:, None] + down) / height, up
            )
            share += directions @ sun.direction >= math.cos(radius)
    edges = np.cos(math.pi * np.arange(first, end + 1) / height)
    solid_angle = float((share.sum(axis=1) * (edges[:-1] - edges[1:])).sum()) * 2.0 * math.pi / width
    picture[first:end] += share[..., None] * (sun.irradiance / solid_angle)
