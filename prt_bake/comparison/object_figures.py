"""Figures of an object's pictures, the paper's tables' own: how far they are from a reference, and what noise does.

Law: the pixels that the object covers wholly; an exposure that gives the reference's object a median luminance of 0.18;
the sRGB curve cut to [0,1]; FLIP at 67 pixels a degree.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from formats.errors import QueryError
from formats.image.exr import Layers
from prt_bake.comparison.metrics import Comparison, compare
from prt_bake.rendering.half_buffers import TracedPicture

MIDDLE_GREY = 0.18
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""Of linear Rec.709."""


@dataclass(frozen=True)
class Figures:
    """MSE (after exposure), SSIM at full and quarter size and mean FLIP over the object's pixels; the map of FLIP."""

    mse: float
    ssim: float
    ssim_quarter: float
    flip: float
    flip_map: NDArray[np.float32]

    def as_json(self) -> dict[str, float]:
        """The figures without the map."""
        return {name: getattr(self, name) for name in ("mse", "ssim", "ssim_quarter", "flip")}


def object_mask(coverage: ArrayLike) -> NDArray[np.bool_]:
    """The pixels [H,W] that the object covers wholly; raises QueryError where there is none."""
    mask = np.asarray(np.asarray(coverage) >= 1.0)
    if not mask.any():
        raise QueryError("report: no pixel of the reference is covered wholly by the object; ask for a larger --size")
    return mask


def exposure(image: ArrayLike, mask: NDArray[np.bool_]) -> float:
    """The stops by which the picture [H,W,3] is lifted so that its object has a median luminance of 0.18.

    Raises QueryError where that median is not positive.
    """
    median = float(np.median(np.asarray(image, np.float64)[mask] @ LUMINANCE))
    if not median > 0.0:
        raise QueryError(f"report: the reference's object has a median luminance of {median:g}; no light reaches it")
    return math.log2(MIDDLE_GREY / median)


def measure(image: ArrayLike, reference: ArrayLike, mask: NDArray[np.bool_], stops: float) -> Figures:
    """The figures of a picture [H,W,3] against a reference, both lifted by `stops`."""
    return _figures(compare(image, reference, mask, stops))


def alone(
    picture: Layers, reference: TracedPicture, mask: NDArray[np.bool_], stops: float
) -> tuple[NDArray[np.float32], dict[str, float]]:
    """All figures of a picture of the light from under the surface alone, and its map of FLIP; a picture without a
    layer of errors has no noise.
    """
    found = measure(picture.image, reference.image, mask, stops)
    return found.flip_map, {
        **found.as_json(),
        "flip_without_noise": flip_without_noise(picture.image, reference, mask, stops, found.flip),
        "error": error_without_noise(picture.image, picture.layers.get("error", 0.0), reference, mask),
    }


def noise_figures(reference: TracedPicture, smooth: ArrayLike, mask: NDArray[np.bool_], stops: float) -> dict[str, float]:
    """What the reference's own noise does to each figure: a picture exact but for such noise would have them.

    mse: of the standard errors. flip, ssim, ssim_quarter: means of what `smooth` and itself with the reference's noise
    added and taken away make (`prt_bake.rendering.half_buffers` says which noise). `smooth` [H,W,3] is a picture
    without noise that stands for the exact one, which nobody has; the reference itself would not do: its own noise
    passes for structure, and SSIM forgives more of it.
    """
    base = np.asarray(smooth, np.float64)
    sides = [measure(base + sign * reference.noise, base, mask, stops) for sign in (1.0, -1.0)]
    squared = (reference.standard_error[mask].astype(np.float64) * 2.0**stops) ** 2
    names = ("ssim", "ssim_quarter", "flip")
    return {"mse": float(squared.mean()), **{name: sum(getattr(side, name) for side in sides) / 2 for name in names}}


def flip_without_noise(
    image: ArrayLike, reference: TracedPicture, mask: NDArray[np.bool_], stops: float, flip: float
) -> float:
    """An estimate of the mean FLIP that a picture would have against a reference without noise; `flip` is what it has.

    With the reference's noise added to the reference or taken away, the variance of its error is doubled. If the square
    of FLIP grows in a straight line with that variance, it is 2 flip² − doubled² at none. Of noise alone FLIP grows
    more slowly (about as the 0.35th power of the variance), so that where noise is most of it the estimate is too high.
    """
    exact, noise = reference.image.astype(np.float64), reference.noise
    doubled = [measure(image, exact + sign * noise, mask, stops).flip for sign in (1.0, -1.0)]
    return math.sqrt(max(0.0, 2.0 * flip**2 - (sum(doubled) / 2.0) ** 2))


def error_without_noise(
    image: ArrayLike, standard_error: ArrayLike, reference: TracedPicture, mask: NDArray[np.bool_]
) -> float:
    """The relative RMSE of a picture [H,W,3] over the object, its own noise and the reference's taken out.

    standard_error: of the picture, [H,W,3] or 0. Over E[reference²] without noise; 0 where the noise leaves nothing of
    the error, nan where it leaves nothing of the reference.
    """
    ours, theirs = np.asarray(image, np.float64)[mask], reference.image[mask].astype(np.float64)
    own = np.broadcast_to(np.asarray(standard_error, np.float64), np.shape(image))[mask] ** 2
    noise = reference.standard_error[mask].astype(np.float64) ** 2
    error, value = np.mean((ours - theirs) ** 2 - noise - own), np.mean(theirs**2 - noise)
    return math.sqrt(max(0.0, float(error / value))) if value > 0.0 else math.nan


def framing(coverage: ArrayLike) -> dict[str, Any]:
    """The share of the picture that the object fills, and the number of pixels that count."""
    share = np.asarray(coverage, np.float64)
    return {"object_share": float(share.mean()), "object_pixels": int((share >= 1.0).sum())}


def _figures(comparison: Comparison) -> Figures:
    c = comparison
    return Figures(c.mse, c.ssim, c.ssim_quarter, c.flip, c.flip_map)
