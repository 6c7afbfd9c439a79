"""Optical depths along straight lines, by testing every face and fine sums; shares no code with the path tracer."""

import numpy as np
from scipy.ndimage import map_coordinates

from formats.scene import Scene


def extinction(scene: Scene, points: np.ndarray) -> np.ndarray:
    """sigma_t at points [...,3], trilinear between cell centres and clamped."""
    return at_cells(np.asarray(scene.sigma_t, np.float64), scene.bounds, points)


def at_cells(grid: np.ndarray, bounds: np.ndarray | None, points: np.ndarray) -> np.ndarray:
    """A grid [Z,Y,X] over `bounds`, or a constant, at points [...,3]."""
    if grid.ndim == 0 or bounds is None:
        return np.full(points.shape[:-1], float(grid))
    low, high = bounds
    place = (points - low) / (high - low) * np.array(grid.shape[::-1]) - 0.5
    flat = map_coordinates(grid, place.reshape(-1, 3)[:, ::-1].T, order=1, mode="nearest")
    return np.asarray(flat.reshape(points.shape[:-1]))


def crossings(scene: Scene, origins: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Distances [R,C] at which rays from origins [R,3] cross the surface, ascending, padded with inf."""
    corners = np.asarray(scene.mesh.positions)[np.asarray(scene.mesh.faces)]
    u_edge, v_edge = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    across = np.cross(direction, v_edge)
    with np.errstate(divide="ignore"):
        inverse = 1.0 / np.sum(across * u_edge, axis=1)
    start = origins[:, None] - corners[:, 0]
    turned = np.cross(start, u_edge)
    u, v = np.sum(start * across, axis=2) * inverse, turned @ direction * inverse
    distance = np.sum(turned * v_edge, axis=2) * inverse
    hit = (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0) & (distance > 1e-9)
    distance = np.sort(np.where(hit, distance, np.inf), axis=1)
    return distance[:, : max(1, int(hit.sum(axis=1).max()))]


def optical_depth(scene: Scene, points: np.ndarray, direction: np.ndarray, steps: int = 64) -> np.ndarray:
    """∫ sigma_t [R] from points inside to infinity, through all crossings."""
    ends = crossings(scene, points, direction)
    ends = np.concatenate([np.zeros((len(points), 1)), ends], axis=1)
    depth = np.zeros(len(points))
    for begin in range(0, ends.shape[1] - 1, 2):
        inside = np.isfinite(ends[:, begin + 1])
        near, far = ends[inside, begin], ends[inside, begin + 1]
        share = (np.arange(steps) + 0.5) / steps
        t = near[:, None] + (far - near)[:, None] * share
        along = points[inside, None] + t[..., None] * direction
        depth[inside] += (far - near) * extinction(scene, along).mean(axis=1)
    return depth


def single_scattering(
    scene: Scene, position: np.ndarray, outgoing: np.ndarray, incident: np.ndarray, steps: int = 1500
) -> float:
    """Ŝ of single scattering behind an index-matched boundary at albedo 1, by the midpoint rule along the view ray."""
    ends = crossings(scene, position[None], -outgoing)[0]
    edges = np.concatenate([[0.0], ends[np.isfinite(ends)]])
    total, depth = 0.0, 0.0
    for near, far in zip(edges[0::2], edges[1::2], strict=True):
        step = (far - near) / steps
        points = position - (near + step * (np.arange(steps) + 0.5))[:, None] * outgoing
        sigma_t = extinction(scene, points)
        here = depth + step * (np.cumsum(sigma_t) - 0.5 * sigma_t)
        total += step * float(np.sum(sigma_t * np.exp(-here - optical_depth(scene, points, incident))))
        depth += step * float(sigma_t.sum())
    cosine, g = -float(outgoing @ incident), scene.phase_g
    return total * (1.0 - g * g) / (4.0 * np.pi * (1.0 + g * g - 2.0 * g * cosine) ** 1.5)
