"""Alpha channels of compared pictures: empty pixels, and premultiplication of the colour."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from formats.image.exr import Layers

Array = NDArray[np.float32]

_NAME = "A"


def alpha_of(picture: Layers) -> Array | None:
    """The alpha [H,W] of a picture; None if it has none or is opaque everywhere."""
    alpha = picture.layers.get(_NAME)
    return None if alpha is None or bool((alpha >= 1.0).all()) else alpha


def premultiplied(path: Path, picture: Layers) -> Layers:
    """The picture with premultiplied alpha: .exr files are premultiplied, .png files are not."""
    alpha = alpha_of(picture)
    if alpha is None or path.suffix.lower() != ".png":
        return picture
    return replace(picture, image=picture.image * alpha[..., None])


def covered_in_either(first: Layers, second: Layers) -> NDArray[np.bool_] | None:
    """The pixels [H,W] that are not empty in one of two pictures of equal size.

    None if these are all or no pixels, or if a picture has no alpha.
    """
    alphas = alpha_of(first), alpha_of(second)
    if alphas[0] is None or alphas[1] is None:
        return None
    covered = ~((alphas[0] <= 0.0) & (alphas[1] <= 0.0))  # NaN counts as covered
    return None if covered.all() or not covered.any() else np.asarray(covered)
