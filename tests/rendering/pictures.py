"""Small scenes, cameras and skies for tests of path-traced pictures, and z-scores of their differences."""

import math
from pathlib import Path

import numpy as np

from formats.mesh import write_mesh
from formats.scene import Scene, read_scene
from prt_bake.geometry.camera import Camera
from prt_bake.rendering.scene import Rendering
from tests.shapes import ball

WHITE = np.ones((8, 16, 3), np.float32)


def make_scene(
    folder: Path, albedo: str = "1.0", eta: float = 1.0, roughness: float = 0.0, sigma_t: float = 3.0
) -> Scene:
    """A unit ball."""
    write_mesh(ball(3), folder / "ball.ply")
    (folder / "ball.toml").write_text(
        f'[object]\nmesh = "ball.ply"\n[interface]\neta = {eta}\nroughness = {roughness}\n'
        f"[medium]\nsigma_t = {sigma_t}\nalbedo = {albedo}\nphase_g = 0.4\n"
    )
    return read_scene(folder / "ball.toml")


def front(eye: tuple[float, float, float] = (0.0, 0.0, 4.0), size: int = 16) -> Camera:
    """A camera that looks at the origin."""
    return Camera(np.array(eye), np.zeros(3), np.array([0.0, 1.0, 0.0]), 40.0, size, size)


def uneven_sky() -> np.ndarray:
    """Random pixels, some a hundred times as bright as others."""
    return np.random.default_rng(3).random((16, 32, 3)).astype(np.float32) ** 3


def even_sky() -> np.ndarray:
    """Random pixels that differ too little to be worth connections."""
    return 1.0 + np.random.default_rng(3).random((16, 32, 3)).astype(np.float32)


def z_score(one: Rendering, other: Rendering) -> float:
    """The z-score of the mean squared difference, whose expectation is the sum of both estimated variances."""
    inside = (one.coverage == 1) & (other.coverage == 1)
    variance = one.standard_error[inside].astype(np.float64) ** 2 + other.standard_error[inside].astype(np.float64) ** 2
    squared = (one.image[inside].astype(np.float64) - other.image[inside]) ** 2
    excess = (squared - variance).mean(axis=1)  # channels share their walks
    return float(excess.mean() / (excess.std(ddof=1) / math.sqrt(len(excess))))


def mean_z(one: Rendering, other: Rendering) -> np.ndarray:
    """The z-score of the difference in mean radiance over the object, by channel [3]."""
    inside = (one.coverage == 1) & (other.coverage == 1)
    difference = (one.image[inside].astype(np.float64) - other.image[inside]).mean(axis=0)
    variance = sum((part.standard_error[inside].astype(np.float64) ** 2).sum(axis=0) for part in (one, other))
    return np.asarray(difference * inside.sum() / np.sqrt(variance))
