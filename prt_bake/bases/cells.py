"""The sphere in cells of equal solid angle, and skies averaged over them.

The cells are the texels of the equal-area octahedron (`prt_bake.lights.skies.prefiltered`), in which Haar wavelets are
orthonormal over solid angle.
"""

import math

import numpy as np
from numpy.typing import NDArray

from prt_bake.lights.environment import from_polar
from prt_bake.lights.skies.prefiltered import prefilter, texel_directions, texel_numbers

Array = NDArray[np.float64]

TURNS = 4
"""Rotations of a sky about the up axis, by equal angles."""


def cell_directions(size: int, up: str) -> Array:
    """Unit directions [size²,3] of the centres of the cells, in object space."""
    return np.asarray(texel_directions(size).reshape(-1, 3) @ from_polar(up).T)


def cell_numbers(directions: Array, size: int, up: str) -> NDArray[np.int64]:
    """The cells [N] that contain unit directions [N,3] in object space."""
    return texel_numbers(directions @ from_polar(up), size)


def turned_skies(image: NDArray[np.float32], size: int) -> Array:
    """Radiance times solid angle [TURNS,size²,3] of a lat-long picture over the cells, turned by quarters."""
    skies = []
    for turn in range(TURNS):
        turned = np.roll(image, round(turn * image.shape[1] / TURNS), axis=1)
        levels = {len(level): level for level in prefilter(turned, np.eye(3)).levels}
        finest = max(levels)
        texels = levels.get(size)
        if texels is None:  # the picture is coarser than the cells
            texels = levels[finest].repeat(size // finest, axis=0).repeat(size // finest, axis=1)
        skies.append(texels.reshape(-1, 3).astype(np.float64))
    return np.array(skies) * (4.0 * math.pi / size**2)
