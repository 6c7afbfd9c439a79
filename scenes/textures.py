"""Textures of the grape: its bloom as roughness, and the skin of its seeds. Seamless, since sampled on a sphere."""

import numpy as np
from numpy.typing import NDArray

from formats.scene.solid_texture import blend_weight

Array = NDArray[np.float64]


def bloom(width: int = 128) -> NDArray[np.uint8]:
    """Return GGX alphas [H,W] from 0.1 to 0.45 as 8-bit values: waxy patches, partly rubbed off."""
    patches = blend_weight(_ball(width), "noise", 0.5, seed=4, octaves=5, thresholds=(0.3, 0.7))
    return np.rint(255 * (0.1 + 0.35 * patches)).astype(np.uint8)


def seed_skin(width: int = 128) -> Array:
    """Return linear reflectances [H,W,3]: brown with darker furrows."""
    furrows = blend_weight(_ball(width) * [1.0, 0.3, 1.0], "veins", 0.5, seed=2, octaves=3)[..., None]
    skin: Array = (1 - furrows) * np.array([0.30, 0.17, 0.08]) + furrows * np.array([0.10, 0.05, 0.025])
    return skin


def _ball(width: int) -> Array:
    """Return the point on the unit sphere at each texel's centre [width/2,width,3], row 0 at the top."""
    height = width // 2
    phi = (np.arange(width) + 0.5) / width * 2 * np.pi
    theta = ((np.arange(height) + 0.5) / height * np.pi)[:, None]
    return np.stack(
        np.broadcast_arrays(np.sin(theta) * np.sin(phi), np.cos(theta), np.sin(theta) * np.cos(phi)), axis=-1
    )
