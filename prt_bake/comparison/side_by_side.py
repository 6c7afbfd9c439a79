"""A picture, its reference and their FLIP map in one image."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from formats.image import write_image


def write_side_by_side(
    image: NDArray[np.float32],
    reference: NDArray[np.float32],
    flip_map: NDArray[np.float32],
    path: str | Path,
    exposure: float = 0.0,
) -> None:
    """Write image [H,W,3], reference [H,W,3] and FLIP map [H,W] (black 0, white 1) side by side."""
    error = np.repeat(flip_map[..., None] * 2.0**-exposure, 3, axis=2)
    write_image(path, np.concatenate([image, reference, error], axis=1, dtype=np.float32), exposure=exposure)
