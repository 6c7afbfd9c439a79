"""An absorbing slab between two rough interfaces, solved by quadrature over inner directions, without random numbers.

This is a second, vectorised implementation of the interface from Walter et al. 2007 ("Microfacet models for refraction
through rough surfaces", eqs. 16–22, 33, 34) without the product's code. Directions are those of flight along the eye
path: from the eye down through the top (z up), back and forth inside, and out towards the light.
"""

import numpy as np


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.sum(a * b, axis=-1)


def fresnel(cosine: np.ndarray, index_from: float, index_to: float) -> np.ndarray:
    """Unpolarised reflectance, Walter's eq. 22; 1 for total internal reflection."""
    squared = (index_to / index_from) ** 2 - 1.0 + cosine**2
    g = np.sqrt(np.maximum(squared, 0.0))
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = (cosine * (g + cosine) - 1.0) / (cosine * (g - cosine) + 1.0)
        value = 0.5 * ((g - cosine) / (g + cosine)) ** 2 * (1.0 + ratio**2)
    return np.where(squared > 0.0, value, 1.0)


def _shape(half: np.ndarray, i: np.ndarray, o: np.ndarray, alpha: float) -> np.ndarray:
    """G D for the upward half vector: Smith masking of both directions times GGX."""
    cosine = half[..., 2]
    tangent = (1.0 - cosine**2) / np.maximum(cosine, 1e-12) ** 2
    d = alpha**2 / (np.pi * np.maximum(cosine, 1e-12) ** 4 * (alpha**2 + tangent) ** 2)
    for v in (i, o):
        seen = _dot(v, half) * v[..., 2] > 0.0
        slope = (1.0 - v[..., 2] ** 2) / v[..., 2] ** 2
        d = d * np.where(seen, 2.0 / (1.0 + np.sqrt(1.0 + alpha**2 * slope)), 0.0)
    return np.where(cosine > 0.0, d, 0.0)


def reflect(i: np.ndarray, o: np.ndarray, alpha: float, index_from: float, index_to: float) -> np.ndarray:
    """f_r |o·n| for i and o [...,3], both above (z up) on the side of `index_from`."""
    half = i + o
    half = half / np.linalg.norm(half, axis=-1, keepdims=True)
    return fresnel(_dot(i, half), index_from, index_to) * _shape(half, i, o, alpha) / (4.0 * i[..., 2])


def transmit(i: np.ndarray, o: np.ndarray, alpha: float, index_from: float, index_to: float) -> np.ndarray:
    """f_t |o·n| for i above and o below, as a scattering density of an eye path (eq. 21)."""
    half = -(index_from * i + index_to * o)
    length = np.linalg.norm(half, axis=-1, keepdims=True)
    half = half / np.maximum(length, 1e-300)
    half = half * np.where(half[..., 2:] < 0.0, -1.0, 1.0)
    ih, oh = _dot(i, half), _dot(o, half)
    through = (1.0 - fresnel(np.abs(ih), index_from, index_to)) * _shape(half, i, o, alpha)
    value = np.abs(ih * oh) * index_to**2 * through / (i[..., 2] * (index_from * ih + index_to * oh) ** 2)
    return np.where((ih > 0.0) & (oh < 0.0), value, 0.0)


def black_slab(
    outgoing: np.ndarray, incident: np.ndarray, depth: float, alpha: float, eta: float, nodes: int = 48, orders: int = 4
) -> np.ndarray:
    """Ŝ [D] of a slab of optical thickness `depth` at albedo 0, for light from `incident` [D,3] above or below.

    Sums over the number of internal reflections, up to `orders` − 1.
    """
    x, w = np.polynomial.legendre.leggauss(nodes)
    mu, phi = 0.5 * (x + 1.0), 2.0 * np.pi * (np.arange(2 * nodes) + 0.5) / (2 * nodes)
    r = np.sqrt(1.0 - mu**2)[:, None]
    up = np.stack([r * np.cos(phi), r * np.sin(phi), np.broadcast_to(mu[:, None], (nodes, 2 * nodes))], axis=-1)
    up = up.reshape(-1, 3)
    weight = np.repeat(0.5 * w * np.pi / nodes, 2 * nodes) * np.exp(-depth / up[:, 2])
    down = up * [1.0, 1.0, -1.0]
    # From inside, z always points into the slab: exits fly to −z, and the frame is flipped at the top.
    flying = transmit(np.broadcast_to(outgoing, down.shape), down, alpha, 1.0, eta)
    light_below = incident * np.where(incident[:, 2:] < 0.0, 1.0, -1.0) ** [0, 0, 1]
    total = np.zeros(len(incident))
    for order in range(orders):
        leaves_below = order % 2 == 0
        seen = (incident[:, 2] < 0.0) == leaves_below
        # i points back into the slab: −flight, with z flipped if the walk arrives at the top.
        back = -up * [1.0, 1.0, -1.0]
        for k in np.flatnonzero(seen):
            out = np.broadcast_to(light_below[k], back.shape)
            total[k] += np.sum(weight * flying * transmit(back, out, alpha, eta, 1.0))
        flying = _bounce(back, up, weight * flying, alpha, eta, orders - 1 - order)
    return total


def _bounce(back: np.ndarray, away: np.ndarray, flying: np.ndarray, alpha: float, eta: float, left: int) -> np.ndarray:
    """Flux after one internal reflection, on the same directions with z flipped."""
    result = np.zeros(len(away))
    if left <= 0:
        return result
    worth = np.flatnonzero(flying > 1e-9 * flying.max())
    for chunk in np.array_split(np.arange(len(away)), 32):
        table = reflect(back[None, worth], away[chunk, None], alpha, eta, 1.0)
        result[chunk] = table @ flying[worth]
    return result
