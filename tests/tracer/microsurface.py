"""A random walk over the Smith microsurface of a rough dielectric, as an independent reference for how the energy lost
by single scattering splits into reflection and transmission.

Heitz et al. 2016, "Multiple-scattering microfacet BSDFs with the Smith model": heights uniform in (−1, 1), visible
normals of GGX for any direction by spherical caps (Dupuy and Benyoub 2023). It shares no code with the product.
"""

import numpy as np


def _fresnel(cosine: np.ndarray, eta: np.ndarray) -> np.ndarray:
    across = np.sqrt(np.maximum(0.0, 1.0 - (1.0 - cosine**2) / eta**2))
    parallel = (eta * cosine - across) / (eta * cosine + across)
    perpendicular = (cosine - eta * across) / (cosine + eta * across)
    return np.where(across > 0.0, 0.5 * (parallel**2 + perpendicular**2), 1.0)


def _normals(w: np.ndarray, alpha: float, generator: np.random.Generator) -> np.ndarray:
    v = w * [alpha, alpha, 1.0]
    v = v / np.linalg.norm(v, axis=1, keepdims=True)
    angle = 2.0 * np.pi * generator.random(len(w))
    z = (1.0 - generator.random(len(w))) * (1.0 + v[:, 2]) - v[:, 2]
    radius = np.sqrt(np.clip(1.0 - z * z, 0.0, 1.0))
    m = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1) + v
    m = np.maximum(m * [alpha, alpha, 1.0], [-np.inf, -np.inf, 1e-12])
    return np.asarray(m / np.linalg.norm(m, axis=1, keepdims=True))


def _heights(w: np.ndarray, h: np.ndarray, alpha: float, generator: np.random.Generator) -> np.ndarray:
    """Height of the next hit of a ray from height h; inf if it escapes."""
    z = np.where(np.abs(w[:, 2]) < 1e-6, 1e-6, w[:, 2])
    slope = np.maximum(0.0, 1.0 - z * z) / (z * z)
    lengths = np.minimum(0.5 * (-1.0 + np.sign(z) * np.sqrt(1.0 + alpha**2 * slope)), np.inf)
    below = np.clip(0.5 * (h + 1.0), 1e-12, 1.0)
    away = np.where(z > 0.0, below ** np.maximum(lengths, 0.0), 0.0)
    u = 1.0 - generator.random(len(w))
    with np.errstate(divide="ignore", over="ignore"):
        met = np.clip(2.0 * np.minimum(below * u ** (-1.0 / lengths), 1.0) - 1.0, -1.0, 1.0)
    return np.where(u <= away, np.inf, met)


def transmitted(cosine: float, alpha: float, eta: float, count: int, seed: int) -> np.ndarray:
    """Which of `count` rays at `cosine` from index 1 end in index `eta` after any number of bounces."""
    generator = np.random.default_rng(seed)
    w = np.tile([-np.sqrt(1.0 - cosine**2), 0.0, -cosine], (count, 1))
    side, h, flying = np.ones(count), np.ones(count), np.arange(count)
    while len(flying):
        up = side[flying]
        met = _heights(w[flying] * np.stack([up, up, up], axis=1) * [1, 1, 1], h[flying] * up, alpha, generator)
        keeps = np.isfinite(met)
        flying, up, met = flying[keeps], up[keeps], met[keeps]
        h[flying] = met * up
        i = -w[flying] * up[:, None]
        m = _normals(i, alpha, generator)
        c = np.clip(np.sum(i * m, axis=1), 0.0, 1.0)
        step = np.where(up > 0.0, eta, 1.0 / eta)
        mirrored = generator.random(len(flying)) < _fresnel(c, step)
        across = np.sqrt(np.maximum(0.0, 1.0 - (1.0 - c * c) / step**2))
        refracted = (c / step - across)[:, None] * m - i / step[:, None]
        o = np.where(mirrored[:, None], 2.0 * c[:, None] * m - i, refracted) * up[:, None]
        w[flying] = o / np.linalg.norm(o, axis=1, keepdims=True)
        side[flying] = np.where(mirrored, up, -up)
    return side < 0.0
