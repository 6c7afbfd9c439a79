"""Metrics of pictures of an object, as in the paper's tables, and the effect of noise on them.

Protocol: pixels that the object covers completely; an exposure that gives the reference's object a median luminance of
0.18; the sRGB curve, clamped to [0,1]; FLIP at 67 pixels per degree.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from formats.errors import QueryError
from formats.image.exr import Layers
from formats.image.gamut import LUMINANCE
from prt_bake.comparison.metrics import Comparison, compare

MIDDLE_GREY = 0.18


@dataclass(frozen=True)
class TracedPicture:
    """A reference: image, standard_error and noise [H,W,3] (e of `prt_bake.rendering.half_buffers`), coverage [H,W]."""

    image: NDArray[np.float32]
    standard_error: NDArray[np.float32]
    noise: NDArray[np.float32]
    coverage: NDArray[np.float32]


@dataclass(frozen=True)
class Figures:
    """MSE (after exposure), SSIM at full and quarter size, mean FLIP over the object's pixels, and the FLIP map."""

    mse: float
    ssim: float
    ssim_quarter: float
    flip: float
    flip_map: NDArray[np.float32]

    def as_json(self) -> dict[str, float]:
        """The metrics without the map."""
        return {name: getattr(self, name) for name in ("mse", "ssim", "ssim_quarter", "flip")}


def object_mask(coverage: ArrayLike) -> NDArray[np.bool_]:
    """The pixels [H,W] that the object covers completely. Raises QueryError if there are none."""
    mask = np.asarray(np.asarray(coverage) >= 1.0)
    if not mask.any():
        raise QueryError("report: the object covers no pixel of the reference completely; choose a larger picture")
    return mask


def exposure(image: ArrayLike, mask: NDArray[np.bool_]) -> float:
    """The exposure in stops at which the object in the picture [H,W,3] has a median luminance of 0.18.

    Raises QueryError if the median is not positive.
    """
    median = float(np.median(np.asarray(image, np.float64)[mask] @ LUMINANCE))
    if not median > 0.0:
        raise QueryError(f"report: the reference's object has a median luminance of {median:g}; no light reaches it")
    return math.log2(MIDDLE_GREY / median)


def measure(image: ArrayLike, reference: ArrayLike, mask: NDArray[np.bool_], stops: float) -> Figures:
    """The metrics of a picture [H,W,3] against a reference, both at an exposure of `stops`."""
    return _figures(compare(image, reference, mask, stops))


def subsurface_figures(
    picture: Layers, reference: TracedPicture, mask: NDArray[np.bool_], stops: float
) -> tuple[NDArray[np.float32], dict[str, float]]:
    """The FLIP map and all metrics of a picture of the light from under the surface.

    A picture without the layer `error` counts as free of noise.
    """
    found = measure(picture.image, reference.image, mask, stops)
    return found.flip_map, {
        **found.as_json(),
        "flip_without_noise": flip_without_noise(picture.image, reference, mask, stops, found.flip),
        "error": error_without_noise(picture.image, picture.layers.get("error", 0.0), reference, mask),
    }


def noise_figures(
    reference: TracedPicture, smooth: ArrayLike, mask: NDArray[np.bool_], stops: float
) -> dict[str, float]:
    """The noise floor: the metrics of a picture whose only error is noise like the reference's.

    mse is the mean squared standard error. flip, ssim and ssim_quarter are means over `smooth` with the reference's
    noise added and subtracted (`prt_bake.rendering.half_buffers`), against `smooth` [H,W,3], a noise-free picture in
    place of the unknown exact one. The reference itself is not suitable, because its noise counts as structure, which
    raises SSIM.
    """
    base = np.asarray(smooth, np.float64)
    sides = [measure(base + sign * reference.noise, base, mask, stops) for sign in (1.0, -1.0)]
    squared = (reference.standard_error[mask].astype(np.float64) * 2.0**stops) ** 2
    names = ("ssim", "ssim_quarter", "flip")
    return {"mse": float(squared.mean()), **{name: sum(getattr(side, name) for side in sides) / 2 for name in names}}


def flip_without_noise(
    image: ArrayLike, reference: TracedPicture, mask: NDArray[np.bool_], stops: float, flip: float
) -> float:
    """Mean FLIP against a noise-free reference by simulation–extrapolation, from `flip` against the noisy one.

    Adding or subtracting the reference's noise doubles the variance of its error. If FLIP² is linear in that variance,
    its value without noise is 2 flip² − doubled². FLIP of noise alone grows more slowly (about as the 0.35th power of
    the variance), so the estimate is biased upwards if noise dominates.
    """
    exact, noise = reference.image.astype(np.float64), reference.noise
    doubled = [measure(image, exact + sign * noise, mask, stops).flip for sign in (1.0, -1.0)]
    return math.sqrt(max(0.0, 2.0 * flip**2 - (sum(doubled) / 2.0) ** 2))


def error_without_noise(
    image: ArrayLike, standard_error: ArrayLike, reference: TracedPicture, mask: NDArray[np.bool_]
) -> float:
    """The relative RMSE of a picture [H,W,3] over the object, without the variance of both pictures.

    standard_error: of the picture, [H,W,3] or 0. Both the squared error and the mean square of the reference are
    unbiased. nan if the variance exceeds one of them: the error is then unknown.
    """
    values, truth = np.asarray(image, np.float64)[mask], reference.image[mask].astype(np.float64)
    variance = np.broadcast_to(np.asarray(standard_error, np.float64), np.shape(image))[mask] ** 2
    reference_variance = reference.standard_error[mask].astype(np.float64) ** 2
    error = np.mean((values - truth) ** 2 - reference_variance - variance)
    signal = np.mean(truth**2 - reference_variance)
    return math.sqrt(error / signal) if signal > 0.0 and error >= 0.0 else math.nan


def framing(coverage: ArrayLike) -> dict[str, Any]:
    """The share of the picture that the object fills, and the number of pixels that count."""
    share = np.asarray(coverage, np.float64)
    return {"object_share": float(share.mean()), "object_pixels": int((share >= 1.0).sum())}


def _figures(comparison: Comparison) -> Figures:
    c = comparison
    return Figures(c.mse, c.ssim, c.ssim_quarter, c.flip, c.flip_map)
