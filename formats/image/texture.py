"""Surface textures: images of roughness or of reflectance, mapped by texture coordinates."""

import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from formats.errors import SceneError, warn
from formats.file_names import named_file
from formats.image.files import read_data
from formats.image.rows import open_image

_LOSS = 1e-3
"""How far lossy compression takes values out of their range."""
_GREY = 0.02
"""Largest difference between the channels of a grey image: a JPEG is off by a few codes of 255."""
_LEAST_ALPHA = 0.01
"""The boundary of a texture is rough everywhere: at an alpha of 0 the density of a facet is infinite."""


def read_roughness_texture(scene_path: Path, key: str, name: str) -> NDArray[np.float64]:
    """Read GGX alphas float64 [H,W] from 0.01 to 1, row 0 on top: the first channel as data, without the sRGB curve.

    Lower ones, from 0 on, are raised to 0.01.

    Args:
        scene_path: the scene file; `name` is relative to its folder.
        key: the key that names the image in the scene file, for messages.
        name: the image file.

    Raises:
        SceneError: values are NaN or out of range (the message has their count and the first).
        ImageError: the image cannot be read.
        StorageError: the file is missing.
    """
    path = named_file(scene_path, name)
    return np.maximum(_check_range(scene_path, key, path, read_roughness(path)), _LEAST_ALPHA)


def read_roughness(path: str | os.PathLike[str]) -> NDArray[np.float64]:
    """Read the first channel of an image as data, float64 [H,W]; raises as `formats.image.read_data`.

    Channels that differ are a warning: textures for glTF, for example, have the roughness in green.
    """
    data = read_data(path)
    levels = np.ascontiguousarray(data[..., 0])
    with np.errstate(invalid="ignore"):  # values that are not finite are refused by those who use them
        different = any((np.abs(data[..., other] - levels) > _GREY).any() for other in (1, 2))
    if different:
        warn(f"{path}: its channels differ, and red is read; if another one is meant, save that alone, in grey")
    return levels


def read_reflectance_texture(scene_path: Path, key: str, name: str) -> NDArray[np.float64]:
    """Read linear reflectances float64 [H,W,3] from 0 to 1, row 0 on top; `.png` and `.jpg` are decoded from sRGB.

    Colours outside Rec.709 are clipped to it, with a warning.

    Arguments and errors as `read_roughness_texture`.
    """
    path = named_file(scene_path, name)
    return _check_range(scene_path, key, path, open_image(path, clip=True).read().astype(np.float64))


def _check_range(scene_path: Path, key: str, path: Path, texture: NDArray[np.float64]) -> NDArray[np.float64]:
    invalid = ~((texture >= 0) & (texture <= 1))
    if invalid.any() and ((texture > -_LOSS) & (texture < 1 + _LOSS)).all():
        warn(f"{path}: {invalid.sum()} values are outside 0 to 1, by less than {_LOSS:g}, and are clipped")
        return np.clip(texture, 0.0, 1.0)
    if invalid.any():
        first = tuple(int(i) for i in np.argwhere(invalid)[0])
        raise SceneError(
            f"{scene_path}: {key}: {path} has {invalid.sum()} of {texture.size} values out of range, the first in row "
            f"{first[0]}, column {first[1]} is {texture[first]:g}; expected values from 0 to 1"
        )
    return np.ascontiguousarray(texture)
