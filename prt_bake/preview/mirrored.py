"""The surface that reflects, and the sky prefiltered for it: blurred by its GGX lobe."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from formats.asset import Asset
from prt_bake.mathematics.box_filter import box_filter, zone

ALBEDOS = 32
"""Angles of a table of directional albedo."""
_SAME_INDEX = 1e-9
_FACETS = 16
"""Facets along each side of the lattice that averages a rough surface."""
_SHARPEST = 0.02
"""Below this alpha the sky is not prefiltered."""
_LEAST_ROWS, _MOST_ROWS = 48, 128
_ROWS_TIMES_ALPHA = 12.0


@dataclass(frozen=True, eq=False)
class Interface:
    """The reflecting surface: relative index of refraction `eta`, GGX roughness `alpha`."""

    eta: float
    alpha: float


def interface_of(asset: Asset) -> Interface | None:
    """Return the surface of the asset's object, or None if its index is 1, which reflects nothing."""
    if abs(asset.eta - 1.0) < _SAME_INDEX:
        return None
    return Interface(asset.eta, asset.roughness or 0.0)


def prefiltered_sky(picture: NDArray[np.float32], alpha: float) -> NDArray[np.float32]:
    """Return the normalised integral ∫ L D(h) cosθ / (4 h·n) dω for each direction as normal and view, lat-long.

    D is the GGX distribution of roughness `alpha`; h is the half vector. This is the prefiltered environment of game
    engines (Karis, "Real Shading in Unreal Engine 4", 2013). A constant sky is unchanged. The result is as coarse as
    the lobe allows; for a smooth surface it is `picture` itself.
    """
    if alpha < _SHARPEST:
        return np.asarray(picture)
    rows = min(max(math.ceil(_ROWS_TIMES_ALPHA / alpha), _LEAST_ROWS), _MOST_ROWS)
    coarse = resampled_sky(picture, rows)
    # The lobe depends on the difference of azimuths alone: each pair of rows is a circular convolution.
    theta = math.pi * (np.arange(rows) + 0.5) / rows
    phi = 2.0 * math.pi * np.arange(2 * rows) / (2 * rows)
    cosine = np.cos(theta)[:, None, None] * np.cos(theta)[None, :, None]
    cosine = cosine + (np.sin(theta)[:, None] * np.sin(theta)[None, :])[:, :, None] * np.cos(phi)
    kernel = np.fft.rfft(_lobe(cosine, alpha) * np.sin(theta)[None, :, None], axis=2)
    spectrum = np.fft.rfft(coarse, axis=1)
    blurred = np.fft.irfft(np.einsum("abk,bkc->akc", kernel, spectrum, optimize=True), 2 * rows, axis=1)
    weight = kernel[:, :, 0].real.sum(axis=1)
    return np.asarray(np.maximum(blurred / weight[:, None, None], 0.0), np.float32)


def directional_albedo(interface: Interface) -> NDArray[np.float64]:
    """Return the share of light that the surface reflects towards the cosine (i / (n − 1))² to its normal, for each i.

    It is that of `prt_bake.reflection.microfacet`, Fresnel's reflectance for a smooth surface. At grazing a rough one
    reflects much less than a smooth one, which reflects all.
    """
    from prt_bake.reflection.microfacet import fresnel, masking, mirrored, visible_facets

    cosine = np.maximum(np.linspace(0.0, 1.0, ALBEDOS) ** 2, 1e-4)
    if interface.alpha < _SHARPEST:
        return fresnel(cosine, interface.eta)
    side = (np.arange(_FACETS) + 0.5) / _FACETS
    numbers = np.tile(np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2), (ALBEDOS, 1))
    cosine = np.repeat(cosine, _FACETS**2)
    alpha = np.full(len(cosine), interface.alpha)
    towards = np.stack([np.sqrt(1.0 - cosine**2), np.zeros(len(cosine)), cosine], axis=1)
    facets = visible_facets(towards, alpha, numbers)
    reflected = fresnel(np.einsum("ni,ni->n", towards, facets).clip(0.0, 1.0), interface.eta)
    reflected *= masking(mirrored(towards, facets)[:, 2], alpha)
    return np.asarray(reflected.reshape(ALBEDOS, -1).mean(axis=1))


def resampled_sky(picture: NDArray[np.float32], rows: int) -> NDArray[np.float64]:
    """Resample a lat-long picture to [rows,2·rows,3] by box filtering, weighted by solid angle."""
    height, width = picture.shape[:2]
    down, across = box_filter(height, rows, zone), box_filter(width, 2 * rows, np.subtract)
    zones = (down @ picture.reshape(height, -1)).reshape(rows, width, 3)
    return np.stack([across @ line for line in zones])


def _lobe(cosine: NDArray[np.float64], alpha: float) -> NDArray[np.float64]:
    """Return D(h) cosθ / (4 h·n) at the cosine between the reflected direction and the light."""
    squared = np.maximum(0.5 + 0.5 * cosine, 1e-6)  # (h·n)²
    distribution = alpha**2 / (math.pi * (squared * (alpha**2 - 1.0) + 1.0) ** 2)
    return np.asarray(distribution * np.maximum(cosine, 0.0) / (4.0 * np.sqrt(squared)))
