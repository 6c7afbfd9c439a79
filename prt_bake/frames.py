"""Radiance at an asset's vertices frame after frame, for an eye that moves."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from formats.asset import Asset
from prt_bake.environment import rotate_light
from prt_bake.shading import shade_vertices


class Frames:
    """What `shading.shade` gives, for one asset and many eyes."""

    def __init__(self, asset: Asset) -> None:
        self._asset = asset
        self._radiance = np.zeros((len(asset.valid), 3), np.float32)
        self._light: NDArray[np.float64] | None = None
        self._turned: NDArray[np.float64] | None = None

    def light(self, coefficients: ArrayLike | None) -> None:
        """The light's coefficients [K,3]; None for an asset of quantity "radiance"."""
        self._light = self._turned = None if coefficients is None else np.asarray(coefficients, np.float64)

    def turn(self, degrees: float) -> None:
        """Turn the light that was given about the asset's up axis."""
        if self._light is not None:
            self._turned = rotate_light(self._light, degrees, self._asset.up)

    def fold(self) -> None:
        """The light stays."""

    def draw(self, eye: ArrayLike, visible: NDArray[np.bool_] | None = None) -> NDArray[np.float32]:
        """Radiance [V,3] towards the eye, negative values cut to 0; one buffer that the next frame writes over."""
        self._radiance[:] = shade_vertices(self._asset, self._turned, eye, visible).radiance
        return self._radiance
