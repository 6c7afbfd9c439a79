"""Alpha channels of pictures that are compared: where a picture shows nothing, and how its colour is meant."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from formats.image.exr import Layers

Array = NDArray[np.float32]

_NAME = "A"


def alpha_of(picture: Layers) -> Array | None:
    """The alpha [H,W] of a picture; None where it has none or is opaque everywhere."""
    alpha = picture.layers.get(_NAME)
    return None if alpha is None or bool((alpha >= 1.0).all()) else alpha


def weighted(path: Path, picture: Layers) -> Layers:
    """The picture with its colour weighted by its alpha, as `.exr` keeps it and `.png` does not."""
    alpha = alpha_of(picture)
    if alpha is None or path.suffix.lower() != ".png":
        return picture
    return replace(picture, image=picture.image * alpha[..., None])


def seen_in_either(first: Layers, second: Layers) -> NDArray[np.bool_] | None:
    """The pixels [H,W] that show something in one of two pictures of one size; None where all do, none does, or a
    picture has no alpha.
    """
    alphas = alpha_of(first), alpha_of(second)
    if alphas[0] is None or alphas[1] is None:
        return None
    seen = (alphas[0] > 0.0) | (alphas[1] > 0.0)
    return None if seen.all() or not seen.any() else np.asarray(seen)
