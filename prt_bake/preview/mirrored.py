"""The sky as a rough surface mirrors it: blurred by the lobe of its microfacets."""

import math

import numpy as np
from numpy.typing import NDArray

_SHARPEST = 0.02
"""Below this alpha the sky itself is what is mirrored."""
_LEAST_ROWS, _MOST_ROWS = 48, 128
_ROWS_TIMES_ALPHA = 12.0


def prefiltered_sky(picture: NDArray[np.float32], alpha: float) -> NDArray[np.float32]:
    """A lat-long picture of ∫ L D(h) cosθ / (4 h·n) dω over its weight, about each direction as normal and view.

    D is the GGX distribution of roughness `alpha`, h half way between the normal and the light: what a prefiltered sky
    is in engines (Karis, "Real Shading in Unreal Engine 4", 2013). A constant sky stays what it is. It is as coarse as
    the lobe allows, and the picture itself where the surface is smooth.
    """
    if alpha < _SHARPEST:
        return np.asarray(picture)
    rows = min(max(math.ceil(_ROWS_TIMES_ALPHA / alpha), _LEAST_ROWS), _MOST_ROWS)
    coarse = resampled_sky(picture, rows)
    # A lobe about a direction is the same for all azimuths: a convolution along rows, for each two of them.
    theta = math.pi * (np.arange(rows) + 0.5) / rows
    phi = 2.0 * math.pi * np.arange(2 * rows) / (2 * rows)
    cosine = np.cos(theta)[:, None, None] * np.cos(theta)[None, :, None]
    cosine = cosine + (np.sin(theta)[:, None] * np.sin(theta)[None, :])[:, :, None] * np.cos(phi)
    kernel = np.fft.rfft(_lobe(cosine, alpha) * np.sin(theta)[None, :, None], axis=2)
    waves = np.fft.rfft(coarse, axis=1)
    spread = np.fft.irfft(np.einsum("abk,bkc->akc", kernel, waves, optimize=True), 2 * rows, axis=1)
    weight = kernel[:, :, 0].real.sum(axis=1)
    return np.asarray(np.maximum(spread / weight[:, None, None], 0.0), np.float32)


def resampled_sky(picture: NDArray[np.float32], rows: int) -> NDArray[np.float64]:
    """A lat-long picture [rows,2·rows,3] of the means of a finer one (by solid angle), or of the nearest pixels of a
    coarser one.
    """
    height, width = picture.shape[:2]
    sine = np.sin(math.pi * (np.arange(height) + 0.5) / height)
    down = _overlaps(height, rows) * sine
    down /= down.sum(axis=1, keepdims=True)
    across = _overlaps(width, 2 * rows)
    across /= across.sum(axis=1, keepdims=True)
    return np.asarray(np.einsum("wv,hvc->hwc", across, np.tensordot(down, picture, axes=1), optimize=True))


def _overlaps(count: int, fewer: int) -> NDArray[np.float64]:
    """How much of each of `count` equal parts of a line lies in each of `fewer` equal parts [fewer,count]."""
    edges, others = np.arange(count + 1) / count, np.arange(fewer + 1) / fewer
    low = np.maximum(edges[None, :-1], others[:-1, None])
    high = np.minimum(edges[None, 1:], others[1:, None])
    return np.asarray(np.maximum(high - low, 0.0))


def _lobe(cosine: NDArray[np.float64], alpha: float) -> NDArray[np.float64]:
    """Its value at the cosine between the mirrored direction and the light."""
    squared = np.maximum(0.5 + 0.5 * cosine, 1e-6)  # (h·n)²
    distribution = alpha**2 / (math.pi * (squared * (alpha**2 - 1.0) + 1.0) ** 2)
    return np.asarray(distribution * np.maximum(cosine, 0.0) / (4.0 * np.sqrt(squared)))
