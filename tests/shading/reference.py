"""Slow, simple reference implementations in float64."""

import math

import numpy as np

from formats.asset import Asset


def reconstruct(asset: Asset, light: np.ndarray, eye: np.ndarray) -> np.ndarray:
    """Radiance [V,3] towards the eye, a point [3] or directions [V,3], not clamped."""
    radiance = np.zeros((len(asset.mesh.positions), 3))
    for v in np.flatnonzero(asset.valid):
        outgoing = eye - asset.mesh.positions[v] if np.ndim(eye) == 1 else eye[v]
        outgoing = outgoing / math.sqrt(outgoing @ outgoing)
        n, t = asset.mesh.normals[v], np.asarray(asset.tangents[v], np.float64)
        cos_theta = max(-1.0, min(1.0, float(outgoing @ n)))
        phi = math.atan2(float(outgoing @ np.cross(n, t)), float(outgoing @ t))
        transfer = np.asarray(asset.coefficients[v], np.float64)
        transfer = np.broadcast_to(transfer, (asset.rings * asset.sectors, transfer.shape[1], 3))
        bins = transfer.reshape(asset.rings, asset.sectors, *transfer.shape[1:])
        radiance[v] = np.sum(interpolated(bins, cos_theta, phi) * light, axis=0)
    return radiance


def interpolated(bins: np.ndarray, cos_theta: float, phi: float) -> np.ndarray:
    """The value between view bins [rings,sectors,…] at (cosθ, φ)."""
    rings = len(bins)
    centres = [1.0 - (i + 0.5) / rings for i in range(rings)]
    if cos_theta >= centres[0]:
        share = (1.0 - cos_theta) / (1.0 - centres[0])
        return (1.0 - share) * bins[0].mean(axis=0) + share * along_ring(bins[0], phi)
    for i in range(rings - 1):
        if cos_theta >= centres[i + 1]:
            share = (centres[i] - cos_theta) * rings
            return (1.0 - share) * along_ring(bins[i], phi) + share * along_ring(bins[i + 1], phi)
    return along_ring(bins[-1], phi)


def along_ring(ring: np.ndarray, phi: float) -> np.ndarray:
    """The value between sectors [sectors,…] at φ: linear, periodic."""
    sectors = len(ring)
    place = (phi / (2.0 * math.pi)) % 1.0 * sectors - 0.5
    low = math.floor(place)
    return (1.0 - (place - low)) * ring[low % sectors] + (place - low) * ring[(low + 1) % sectors]


def nearest_hits(corners: np.ndarray, origin: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The first face [R] (−1: none) hit by each ray [R,3] from one origin, by testing all faces, and its distance [R].

    corners: [F,3,3]. Möller and Trumbore, "Fast, minimum storage ray/triangle intersection" (1997).
    """
    first, along_u, along_v = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    across = np.cross(rays[:, None], along_v)
    determinant = np.einsum("rfi,fi->rf", across, along_u)
    start = origin - first
    turned = np.cross(start, along_u)
    with np.errstate(divide="ignore", invalid="ignore"):
        u = np.einsum("rfi,fi->rf", across, start) / determinant
        v = rays @ turned.T / determinant
        distance = np.einsum("fi,fi->f", along_v, turned) / determinant
        hit = (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0) & (distance > 0.0)
    distance = np.where(hit, distance, np.inf)
    return np.where(hit.any(axis=1), distance.argmin(axis=1), -1), distance.min(axis=1)
