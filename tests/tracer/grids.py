"""Media of one region for kernel tests, and SciPy's interpolation of the same grids."""

from types import SimpleNamespace

import numpy as np
from scipy.interpolate import RegularGridInterpolator

from prt_bake.tracer.volume.media import Media
from prt_bake.tracer.volume.prepared_media import prepare_media

LOW, HIGH = np.array([-0.5, -0.4, -0.3]), np.array([0.5, 0.6, 0.2])


def medium_of(sigma_t: object, albedo: object = 1.0, phase_g: float = 0.0) -> Media:
    """Media of one region, number 1, in the box LOW … HIGH."""
    medium = SimpleNamespace(sigma_t=sigma_t, albedo=albedo, phase_g=phase_g, bounds=np.array([LOW, HIGH]))
    return prepare_media((SimpleNamespace(medium=medium),), np.zeros(3), 1.0)


def look_up(grid: np.ndarray, points: np.ndarray) -> np.ndarray:
    """SciPy's trilinear interpolation of a grid [Z,Y,X,…] at points [N,3] = (x, y, z), clamped to the cell centres."""
    for axis in range(3):
        if grid.shape[axis] == 1:
            grid = np.repeat(grid, 2, axis=axis)
    centres = [
        LOW[k] + (np.arange(count) + 0.5) / count * (HIGH[k] - LOW[k]) for k, count in enumerate(grid.shape[2::-1])
    ]
    inside = np.clip(points, [c[0] for c in centres], [c[-1] for c in centres])
    return np.asarray(RegularGridInterpolator(centres[::-1], grid.astype(np.float64))(inside[:, ::-1]))


def optical_depths(grid: np.ndarray, p: np.ndarray, d: np.ndarray, far: float) -> tuple[np.ndarray, np.ndarray]:
    """Distances [S] and ∫ sigma_t [S] or [S,3] up to each, along p + t d in the grid, by the midpoint rule."""
    steps = 20_000
    t = np.linspace(0.0, far, steps + 1)
    middles = 0.5 * (t[1:] + t[:-1])
    sums = np.cumsum(look_up(grid, p + middles[:, None] * d), axis=0) * far / steps
    return t, np.concatenate([np.zeros_like(sums[:1]), sums])
