"""Light reflected by a half space, isotropic scattering: Chandrasekhar, "Radiative Transfer" (1950), chapters III, IV.

The H function solves 1 / H(μ) = √(1 − a) + a/2 ∫₀¹ μ' H(μ') / (μ + μ') dμ' at albedo a.
"""

import numpy as np
from numpy.typing import ArrayLike

_NODES = 64


def h_function(albedo: float, cosine: ArrayLike) -> np.ndarray:
    """H at cosines of any shape, by iteration on Gauss–Legendre nodes in √μ, as the slope at 0 is infinite."""
    x, w = np.polynomial.legendre.leggauss(_NODES)
    root = 0.5 * (x + 1.0)
    nodes, weights = root**2, root * w
    h = np.ones(_NODES)
    for _ in range(10_000):
        last, h = h, _next(albedo, nodes, nodes, weights, h)
        # The plain iteration oscillates about its limit; the mean of two iterates converges.
        h = 0.5 * (h + last)
        if np.abs(h - last).max() < 1e-13:
            break
    return _next(albedo, np.asarray(cosine, np.float64), nodes, weights, h)


def _next(albedo: float, cosine: np.ndarray, nodes: np.ndarray, weights: np.ndarray, h: np.ndarray) -> np.ndarray:
    integral = np.sum(weights * nodes * h / (cosine[..., None] + nodes), axis=-1)
    return np.asarray(1.0 / (np.sqrt(1.0 - albedo) + 0.5 * albedo * integral))


def reflected(albedo: float, outgoing_cosine: ArrayLike, incident_cosine: ArrayLike) -> np.ndarray:
    """Ŝ [1/sr]: radiance towards μo for unit irradiance normal to the light's direction; 0 for light from below."""
    mu_o, mu_i = np.asarray(outgoing_cosine, np.float64), np.asarray(incident_cosine, np.float64)
    positive = np.maximum(mu_i, 1e-300)
    value = (
        albedo / (4.0 * np.pi) * positive / (positive + mu_o) * h_function(albedo, mu_o) * h_function(albedo, positive)
    )
    return np.where(mu_i > 0.0, value, 0.0)


def white_sky(albedo: float, outgoing_cosine: ArrayLike) -> np.ndarray:
    """∫ Ŝ dωi under a sky of radiance 1: 1 − √(1 − a) H(μo)."""
    return np.asarray(1.0 - np.sqrt(1.0 - albedo) * h_function(albedo, outgoing_cosine))
