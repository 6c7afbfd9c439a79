"""Textures of a surface: images of a number or a colour, looked up by texture coordinates."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from formats.errors import SceneError
from formats.image.files import read_image, read_levels


def read_roughness_texture(scene_path: Path, key: str, name: str) -> NDArray[np.float64]:
    """Read GGX alphas float64 [H,W] from 0 to 1, row 0 on top: an image's first channel, of a PNG as it is stored.

    Args:
        scene_path: the scene file, beside which `name` is looked for.
        key: where the scene file names the image, for messages.
        name: the image's file name.

    Raises:
        SceneError: values NaN or out of range, with their count and the first.
        ImageError: no image that can be read.
        StorageError: the file is missing.
    """
    path = scene_path.parent / name
    return _in_range(scene_path, key, path, read_levels(path))


def read_reflectance_texture(scene_path: Path, key: str, name: str) -> NDArray[np.float64]:
    """Read linear reflectances float64 [H,W,3] from 0 to 1, row 0 on top; `.png` and `.jpg` are decoded from sRGB.

    Arguments and errors as `read_roughness_texture`.
    """
    path = scene_path.parent / name
    return _in_range(scene_path, key, path, read_image(path).astype(np.float64))


def _in_range(scene_path: Path, key: str, path: Path, texture: NDArray[np.float64]) -> NDArray[np.float64]:
    unfit = ~((texture >= 0) & (texture <= 1))
    if unfit.any():
        first = tuple(int(i) for i in np.argwhere(unfit)[0])
        raise SceneError(
            f"{scene_path}: {key}: {path} has {unfit.sum()} of {texture.size} values out of range, the first in row "
            f"{first[0]}, column {first[1]} is {texture[first]:g}; expected values from 0 to 1"
        )
    return np.ascontiguousarray(texture)
