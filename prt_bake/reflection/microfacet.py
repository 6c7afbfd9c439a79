"""Reflection at the microsurface of a dielectric, in NumPy.

The model is that of the walk's interface, which is compiled (`prt_bake.tracer.surface.interface`): GGX, separable Smith
masking, single scattering (Walter et al. 2007), sampling of visible microfacets (Heitz 2018). The light reflected here,
the light that walks let in and the loss of single scattering therefore sum to 1.

All functions work in the local frame whose z axis is the interface's normal. `alpha` is the GGX roughness, `eta` the
index inside over the index outside. Rows are independent.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def fresnel(cosine: Array, eta: float) -> Array:
    """Fresnel reflectance of unpolarised light at `cosine` ≥ 0 to the facet, from outside; 1 on total reflection."""
    squared = 1.0 - (1.0 - cosine * cosine) / (eta * eta)
    other = np.sqrt(np.maximum(squared, 0.0))
    with np.errstate(invalid="ignore"):  # 0 / 0 on total reflection
        parallel = (eta * cosine - other) / (eta * cosine + other)
        perpendicular = (cosine - eta * other) / (cosine + eta * other)
    return np.where(squared > 0.0, 0.5 * (parallel * parallel + perpendicular * perpendicular), 1.0)


def masking(cosine: Array, alpha: Array) -> Array:
    """Smith's G1 of GGX [N] for directions at `cosine` [N] to the normal; 0 below the horizon."""
    return np.where(cosine > 0.0, cosine * _masking_per_cosine(np.maximum(cosine, 0.0), alpha), 0.0)


def visible_facets(towards: Array, alpha: Array, numbers: Array) -> Array:
    """Sample normals [N,3] of microfacets visible from `towards` [N,3] by uniform numbers [N,2] (Heitz 2018).

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
    """The mirror directions [N,3] of `towards` [N,3] at facets [N,3]."""
    return np.asarray(2.0 * np.einsum("ni,ni->n", towards, facets)[:, None] * facets - towards)


def reflection_density(towards: Array, facets: Array, alpha: Array) -> Array:
    """Density [N] per solid angle of the mirror directions of `towards` [N,3] at sampled visible facets [N,3].

    f(i, o) |o·n| of the interface is this density times the Fresnel reflectance times `masking` of o.
    """
    # alpha² cos² + sin²: the sine can be as small as alpha, so it is not computed from the cosine.
    root = alpha * alpha + (1.0 - alpha * alpha) * (facets[:, 0] ** 2 + facets[:, 1] ** 2)
    distribution = alpha * alpha / (np.pi * root * root)
    density = 0.25 * distribution * _masking_per_cosine(towards[:, 2], alpha)
    return np.where(facets[:, 2] > 0.0, density, 0.0)


def half_vectors(towards: Array, reflected: Array) -> Array:
    """Facets [N,3] that reflect `towards` [N,3] into `reflected` [N,3]; [0, 0, 0] if these are opposite."""
    half = towards + reflected
    length = np.linalg.norm(half, axis=1, keepdims=True)
    return np.asarray(np.divide(half, length, out=np.zeros_like(half), where=length > 1e-12))


def _masking_per_cosine(cosine: Array, alpha: Array) -> Array:
    """G1(i) / i_z, which has a limit at grazing."""
    return np.asarray(2.0 / (cosine + np.sqrt(cosine * cosine + alpha * alpha * (1.0 - cosine * cosine))))


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.sqrt(np.einsum("ni,ni->n", vectors, vectors))[:, None])
