"""False colours for errors, coefficients and the valid mask."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

_FROM_ZERO = np.array([[24, 15, 62], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]]) / 255.0
_ABOUT_ZERO = np.array([[33, 102, 214], [146, 197, 242], [240, 240, 240], [250, 178, 112], [200, 62, 16]]) / 255.0
VALID, NOT_VALID = np.array([104, 178, 132]) / 255.0, np.array([214, 40, 100]) / 255.0


def from_zero(values: ArrayLike) -> NDArray[np.float64]:
    """Return sRGB [...,3] of values from 0 (dark) to 1 (bright), clamped."""
    return _interpolate(_FROM_ZERO, np.asarray(values, np.float64))


def about_zero(values: ArrayLike) -> NDArray[np.float64]:
    """Return sRGB [...,3] of values from −1 (blue) through 0 (white) to 1 (red), clamped."""
    return _interpolate(_ABOUT_ZERO, 0.5 + 0.5 * np.asarray(values, np.float64))


def _interpolate(anchors: NDArray[np.float64], values: NDArray[np.float64]) -> NDArray[np.float64]:
    steps = np.linspace(0.0, 1.0, len(anchors))
    return np.stack([np.interp(values, steps, channel) for channel in anchors.T], axis=-1)
