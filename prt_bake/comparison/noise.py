"""What the error layers of two pictures say of their noise, and how to draw noise like it once more.

A layer `error` holds one sigma a pixel and channel. Of a picture by `prtbake render` it is that of independent walks:
every pixel errs for itself, on average by nothing, and the square of sigma is an unbiased variance. Of a picture by
`prtbake shade` it is what the bake left: neighbouring pixels share vertices and view bins, the next frame has the same
error again, and its size is an upper bound between bins. Such an error cannot be averaged away or drawn again.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from formats.image.exr import Layers

Array = NDArray[np.float64]

_PASSES = "prtbake.passes"
"""A picture that was summed over independent passes says how many they were."""
_WINDOW = 5
"""Pixels along a side over which variances are averaged before noise is drawn: few walks tell a pixel's badly."""
_FEWEST_SHAPES = 64


@dataclass(frozen=True)
class PixelErrors:
    """The errors of two pictures, in the radiance that is compared.

    Attributes:
        image, reference: sigma [H,W,3] of independent noise; 0 where there is none.
        shared: sigma [H,W,3] of what the bake left in either, which pixels share; 0 where there is none.
    """

    image: Array
    reference: Array
    shared: Array

    @property
    def variance(self) -> Array:
        """Of the independent noise of the difference [H,W,3]."""
        return np.asarray(self.image**2 + self.reference**2)

    @property
    def independent(self) -> bool:
        """Whether there is any independent noise."""
        return bool(self.image.any() or self.reference.any())

    def scaled(self, factor: float) -> "PixelErrors":
        """The errors of the pictures times a factor."""
        return PixelErrors(*(factor * part for part in (self.image, self.reference, self.shared)))


def errors_of(image: Layers, reference: Layers) -> PixelErrors | None:
    """What two pictures of one size say of their errors; None where neither says anything."""
    sigmas = [each.layers.get("error") for each in (image, reference)]
    if all(sigma is None for sigma in sigmas):
        return None
    nothing = np.zeros(image.image.shape)
    parts, shared = [], nothing
    for each, sigma in zip((image, reference), sigmas, strict=True):
        known = nothing if sigma is None else np.broadcast_to(_coloured(sigma), nothing.shape).astype(np.float64)
        if _PASSES in each.attributes:
            parts.append(known)
        else:
            parts.append(nothing)
            shared = np.hypot(shared, known)
    return PixelErrors(parts[0], parts[1], shared)


def unusable(path: Path, picture: Layers) -> str | None:
    """Why a picture's error layer cannot be used, in a sentence; None where it can, or where there is none."""
    sigma = picture.layers.get("error")
    if sigma is None:
        return None
    wrong = int((~np.isfinite(sigma) | (sigma < 0.0)).sum())
    if wrong:
        return (
            f"{path}: {wrong} of {sigma.size} values of its error layer are negative or not finite (a single pass "
            "tells no error); no noise is taken out"
        )
    return None


def same_numbers(image: Layers, reference: Layers) -> bool:
    """Whether two pictures were drawn from the same random numbers, so that their noise is alike: equal pictures, or
    one seed and one kind of source.
    """
    if np.array_equal(image.image, reference.image):
        return True
    ours, theirs = image.attributes, reference.attributes
    seed = "prtbake.seed"
    kinds = [{name for name in ("prtbake.scene", "prtbake.model") if name in each} for each in (ours, theirs)]
    return seed in ours and ours.get(seed) == theirs.get(seed) and bool(kinds[0] & kinds[1])


class NoiseLike:
    """Draws noise like that of two pictures: its size from their error layers, its shape from their difference.

    The size is smoothed over 5×5 pixels. The shape is that of differences between neighbouring pixels of
    image − reference in units of sigma, scaled to a variance of one: channels hang together as they do there and bright
    specks are as rare as there, which a Gaussian would not have. Where the pictures differ by more than noise, the
    texture of that is in the shape too, not in the size.
    """

    def __init__(self, image: Array, reference: Array, errors: PixelErrors, seed: int) -> None:
        self._sigma = [_smoothed(errors.image), _smoothed(errors.reference)]
        self._shapes = _shapes(image - reference, np.hypot(*self._sigma))
        self._random = np.random.default_rng(seed)

    def draw(self) -> tuple[Array, Array]:
        """Noise [H,W,3] for the image and for the reference."""
        first, second = (self._one(sigma) for sigma in self._sigma)
        return first, second

    def _one(self, sigma: Array) -> Array:
        if not sigma.any():
            return sigma
        shape = sigma.shape[:2]
        drawn = self._shapes[self._random.integers(0, len(self._shapes), shape)]
        return np.asarray(sigma * drawn * self._random.choice([-1.0, 1.0], shape)[..., None])


def _shapes(difference: Array, sigma: Array) -> Array:
    """Differences [n,3] of neighbours in units of their sigma, of variance one, from where noise is strongest; a grey
    Gaussian where too few pixels have noise.
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
    if len(found) < _FEWEST_SHAPES or not scale.all():
        return np.random.default_rng(0).normal(size=(4096, 1)).repeat(3, axis=1)
    return np.asarray(found / scale)


def _smoothed(sigma: Array) -> Array:
    return np.sqrt(np.maximum(uniform_filter(sigma**2, size=(_WINDOW, _WINDOW, 1)), 0.0)) if sigma.any() else sigma


def _coloured(sigma: NDArray[np.float32]) -> NDArray[np.float32]:
    return sigma if sigma.ndim == 3 else sigma[..., None]
