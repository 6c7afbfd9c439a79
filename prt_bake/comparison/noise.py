"""Noise of two pictures from their error layers, and resampling of similar noise.

The layer `error` holds a standard error for each pixel and channel. For pictures of `prtbake render` the errors are
independent between pixels with a mean of 0, and the square of the layer is an unbiased variance. For pictures of
`prtbake shade` they are the error of the bake: neighbouring pixels share vertices and view bins, all frames have the
same error, and between bins the layer is an upper bound. Such errors do not average out and cannot be resampled.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from formats.image.exr import Layers

Array = NDArray[np.float64]

_PASSES = "prtbake.passes"
"""The attribute of pictures that are means over independent passes."""
_ERROR_CHANNELS = ("error.R", "error.G", "error.B")
_WINDOW = 5
"""Side of the window in pixels over which variances are averaged; the variance of a single pixel is inaccurate."""
_MIN_SAMPLES = 64


@dataclass(frozen=True)
class PixelErrors:
    """Standard errors of two pictures, in the compared radiance.

    Attributes:
        image, reference: standard error [H,W,3] of independent noise; 0 without noise.
        shared: standard error [H,W,3] of both bakes, correlated between pixels; 0 without a bake.
    """

    image: Array
    reference: Array
    shared: Array

    @property
    def variance(self) -> Array:
        """Variance of the independent noise of the difference [H,W,3]."""
        return np.asarray(self.image**2 + self.reference**2)

    @property
    def independent(self) -> bool:
        """Whether there is any independent noise."""
        return bool(self.image.any() or self.reference.any())

    def scaled(self, factor: float) -> "PixelErrors":
        """The errors of both pictures times a factor."""
        return PixelErrors(*(factor * part for part in (self.image, self.reference, self.shared)))


def errors_of(image: Layers, reference: Layers) -> PixelErrors | None:
    """The errors of two pictures of equal size; None if neither has an error layer."""
    sigmas = [each.layers.get("error") for each in (image, reference)]
    if all(sigma is None for sigma in sigmas):
        return None
    zero = np.zeros(image.image.shape)
    independent, shared = [], zero
    for each, sigma in zip((image, reference), sigmas, strict=True):
        error = zero if sigma is None else np.broadcast_to(_with_channels(sigma), zero.shape).astype(np.float64)
        if _PASSES in each.attributes:
            independent.append(error)
        else:
            independent.append(zero)
            shared = np.hypot(shared, error)
    return PixelErrors(independent[0], independent[1], shared)


def unusable_reason(path: Path, picture: Layers) -> str | None:
    """Why a picture's error layer cannot be used; None if it can be used, or if there is none."""
    sigma = picture.layers.get("error")
    found = [name for name in _ERROR_CHANNELS if name in picture.layers]  # complete ones are the layer "error"
    if found:
        missing = " and ".join(name for name in _ERROR_CHANNELS if name not in found)
        return (
            f"{path}: its error layer has {' and '.join(found)} without {missing}; the metrics are not corrected for "
            "noise"
        )
    if sigma is None:
        return None
    wrong = int((~np.isfinite(sigma) | (sigma < 0.0)).sum())
    if wrong:
        return (
            f"{path}: {wrong} of {sigma.size} values of its error layer are negative or not finite (a single pass "
            "has no error estimate); the metrics are not corrected for noise"
        )
    return None


def same_random_numbers(image: Layers, reference: Layers) -> bool:
    """Whether the noise of two pictures is correlated: they are equal, or have the same seed and kind of source."""
    if np.array_equal(image.image, reference.image):
        return True
    ours, theirs = image.attributes, reference.attributes
    seed = "prtbake.seed"
    kinds = [{name for name in ("prtbake.scene", "prtbake.model") if name in each} for each in (ours, theirs)]
    return seed in ours and ours.get(seed) == theirs.get(seed) and bool(kinds[0] & kinds[1])


class NoiseLike:
    """Resamples noise like that of two pictures.

    The standard errors come from the error layers, smoothed over 5×5 pixels. The distribution is the empirical one of
    differences between neighbouring pixels of image − reference, standardised to a variance of 1. It keeps the
    correlation of channels and the rate of fireflies, unlike a Gaussian. True differences between the pictures affect
    the shape of the distribution, not its variance.
    """

    def __init__(self, image: Array, reference: Array, errors: PixelErrors, seed: int) -> None:
        self._sigma = [_smoothed(errors.image), _smoothed(errors.reference)]
        self._residuals = _standardised_residuals(image - reference, np.hypot(*self._sigma))
        self._random = np.random.default_rng(seed)

    def draw(self) -> tuple[Array, Array]:
        """Noise [H,W,3] for the image and for the reference."""
        first, second = (self._resample(sigma) for sigma in self._sigma)
        return first, second

    def _resample(self, sigma: Array) -> Array:
        if not sigma.any():
            return sigma
        shape = sigma.shape[:2]
        drawn = self._residuals[self._random.integers(0, len(self._residuals), shape)]
        return np.asarray(sigma * drawn * self._random.choice([-1.0, 1.0], shape)[..., None])


def _standardised_residuals(difference: Array, sigma: Array) -> Array:
    """Differences [n,3] between neighbours over their standard error, of variance 1, from the noisiest pixels.

    If too few pixels have noise, a Gaussian that is equal in all channels.
    """
    size = np.sqrt((sigma**2).mean(axis=2))
    strong = (sigma > 0.0).all(axis=2) & (size >= np.median(size))
    pairs = ((np.s_[:, 1:], np.s_[:, :-1]), (np.s_[1:], np.s_[:-1]))
    found = np.concatenate(
        [
            ((difference[p] - difference[q]) / np.hypot(sigma[p], np.maximum(sigma[q], 1e-300)))[strong[p] & strong[q]]
            for p, q in pairs
        ]
    )
    scale = np.sqrt((found**2).mean(axis=0)) if len(found) else np.zeros(3)
    if len(found) < _MIN_SAMPLES or not scale.all():
        return np.random.default_rng(0).normal(size=(4096, 1)).repeat(3, axis=1)
    return np.asarray(found / scale)


def _smoothed(sigma: Array) -> Array:
    return np.sqrt(np.maximum(uniform_filter(sigma**2, size=(_WINDOW, _WINDOW, 1)), 0.0)) if sigma.any() else sigma


def _with_channels(sigma: NDArray[np.float32]) -> NDArray[np.float32]:
    return sigma if sigma.ndim == 3 else sigma[..., None]
