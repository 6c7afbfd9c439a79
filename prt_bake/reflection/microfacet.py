"""Reflection at the microsurface of a dielectric, in NumPy: the reflecting half of the interface that walks cross.

The model is that of `prt_bake.tracer.surface.interface`: GGX, separable Smith masking, single scattering (Walter et al.
2007), microfacets drawn from the visible ones (Heitz 2018). What is reflected here and what walks let in are therefore
parts of one microsurface, and with what single scattering loses they make 1.

All functions work in the local frame whose z axis is the interface's normal. `alpha` is the GGX roughness, `eta` the
index inside over that outside; rows are independent.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def fresnel(cosine: Array, eta: float) -> Array:
    """Reflectance of unpolarised light at `cosine` ≥ 0 to the facet, on the outside; 1 on total reflection."""
    squared = 1.0 - (1.0 - cosine * cosine) / (eta * eta)
    other = np.sqrt(np.maximum(squared, 0.0))
    with np.errstate(invalid="ignore"):  # 0 / 0 where nothing refracts, which is total reflection
        parallel = (eta * cosine - other) / (eta * cosine + other)
        perpendicular = (cosine - eta * other) / (cosine + eta * other)
    return np.where(squared > 0.0, 0.5 * (parallel * parallel + perpendicular * perpendicular), 1.0)


def masking(cosine: Array, alpha: Array) -> Array:
    """Smith's G1 of GGX [N] for directions at `cosine` [N] to the normal; 0 below the horizon."""
    return np.where(cosine > 0.0, cosine * _masking_per_cosine(np.maximum(cosine, 0.0), alpha), 0.0)


def visible_facets(towards: Array, alpha: Array, numbers: Array) -> Array:
    """Normals [N,3] of microfacets seen from `towards` [N,3], by uniform numbers [N,2] (Heitz 2018, by the disc).

    Their density is G1(i) (i·m)⁺ D(m) / i_z.
    """
    view = _unit(towards * np.stack([alpha, alpha, np.ones_like(alpha)], axis=1))
    x, y, z = view.T
    flat = np.sqrt(x * x + y * y)
    upright = flat < 1e-7
    across = np.where(upright, 1.0, flat)
    tx, ty = np.where(upright, 1.0, -y / across), np.where(upright, 0.0, x / across)
    radius, angle = np.sqrt(numbers[:, 0]), 2.0 * np.pi * numbers[:, 1]
    p, q = radius * np.cos(angle), radius * np.sin(angle)
    share = 0.5 * (1.0 + z)
    q = (1.0 - share) * np.sqrt(np.maximum(0.0, 1.0 - p * p)) + share * q
    r = np.sqrt(np.maximum(0.0, 1.0 - p * p - q * q))
    # p t + q (view × t) + r view, flattened by alpha.
    hx = p * tx - q * z * ty + r * x
    hy = p * ty + q * z * tx + r * y
    hz = q * (x * ty - y * tx) + r * z
    return _unit(np.stack([alpha * hx, alpha * hy, np.maximum(hz, 1e-9)], axis=1))


def mirrored(towards: Array, facets: Array) -> Array:
    """Where facets [N,3] reflect light to that goes back along `towards` [N,3]."""
    return np.asarray(2.0 * np.einsum("ni,ni->n", towards, facets)[:, None] * facets - towards)


def reflection_density(towards: Array, facets: Array, alpha: Array) -> Array:
    """Density [N], per solid angle, of the direction that a visible facet [N,3], seen from `towards`, reflects to.

    f(i, o) |o·n| of the interface is this times the facet's Fresnel reflectance times `masking` of o.
    """
    # alpha² cos² + sin²: the sine, which may be as small as alpha, is not taken from the cosine.
    root = alpha * alpha + (1.0 - alpha * alpha) * (facets[:, 0] ** 2 + facets[:, 1] ** 2)
    distribution = alpha * alpha / (np.pi * root * root)
    density = 0.25 * distribution * _masking_per_cosine(towards[:, 2], alpha)
    return np.where(facets[:, 2] > 0.0, density, 0.0)


def half_vectors(towards: Array, reflected: Array) -> Array:
    """Facets [N,3] that reflect `towards` [N,3] into `reflected` [N,3]; [0, 0, 0] where these are opposite."""
    half = towards + reflected
    length = np.linalg.norm(half, axis=1, keepdims=True)
    return np.asarray(np.divide(half, length, out=np.zeros_like(half), where=length > 1e-12))


def _masking_per_cosine(cosine: Array, alpha: Array) -> Array:
    """G1(i) / i_z, which has a limit at grazing where both vanish."""
    return np.asarray(2.0 / (cosine + np.sqrt(cosine * cosine + alpha * alpha * (1.0 - cosine * cosine))))


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.sqrt(np.einsum("ni,ni->n", vectors, vectors))[:, None])
