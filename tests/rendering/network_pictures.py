"""Small networks, lobes and cameras for tests of network pictures, and their expected pictures."""

import numpy as np
from scipy import stats

from prt_bake.geometry.camera import Camera, Visibility, pixel_rays
from prt_bake.lights.lighting import Lighting
from prt_bake.mathematics import directions
from prt_bake.mathematics.lobe import Lobe
from prt_bake.network.bssrdf import NetworkSettings, NeuralBSSRDF
from prt_bake.network.inference.pairs import PairNetwork
from prt_bake.rendering.loop import Rendering
from tests.shapes import ball

MESH = ball(3)


def small_network(**settings) -> NeuralBSSRDF:
    """A random, smooth, mostly positive network."""
    shape = {"features": 16, "width": 32, "feature_mean": 0.0, "feature_spread": 0.15, "directions": "cartesian"}
    metadata = {"up": "y", "eta": 1.4, "roughness": 0.3}
    network = NeuralBSSRDF(NetworkSettings(**shape | settings), (-1.0,) * 3, 2.0, 0.1, metadata)
    network.output.bias.data += 1.0
    return network.eval()


class Lobes:
    """An importance module with lobes about the normal that widen with height."""

    def lobe(self, positions, outgoing, normals) -> Lobe:
        sigma = 0.6 + 0.2 * np.asarray(positions)[:, 1:2]
        return Lobe(np.asarray(normals)[:, None], sigma, np.ones_like(sigma), 2.0)


class Slope:
    """The transport 1 + b·ωi, whose integrals are known."""

    slope = np.array([0.3, -0.4, 0.5])

    def evaluate(self, incident, positions, outgoing):
        value = 1.0 + np.asarray(incident) @ self.slope
        return np.repeat(value[..., None], 3, axis=2) * np.array([1.0, 2.0, 0.5])


def close_up(size: int = 4) -> Camera:
    """All pixels show the ball, magnified so much that a pixel equals its middle."""
    return Camera(np.array([0.5, 1.0, 4.0]), np.array([0.05, 0.1, 0.0]), np.array([0.0, 1.0, 0.0]), 1.0, size, size)


def quadrature(network, lighting: Lighting, camera: Camera, count: int = 20_000) -> np.ndarray:
    """Pixels [H,W,3] at their middles, by `count` directions of a lattice."""
    pixels = np.arange(camera.width * camera.height)
    rays = pixel_rays(camera, pixels, np.full((len(pixels), 1, 2), 0.5)).directions[:, 0]
    hits = Visibility(MESH).first_hits(camera.eye, rays)
    assert (hits.faces >= 0).all()
    corners = MESH.positions[MESH.faces[hits.faces]]
    u, v = hits.barycentric[:, :1], hits.barycentric[:, 1:]
    positions = (1 - u - v) * corners[:, 0] + u * corners[:, 1] + v * corners[:, 2]
    incident = directions.fibonacci(count)
    light = lighting.radiance(incident) * 4 * np.pi / count
    values = PairNetwork(network).evaluate_pairs(np.repeat(incident[None], len(pixels), axis=0), positions, -rays)
    return np.einsum("ndc,dc->nc", values, light).reshape(camera.height, camera.width, 3)


def assert_pictures(picture: Rendering, truth: np.ndarray, false_alarm: float = 1e-4) -> None:
    """Check that every pixel agrees with the truth within its standard error (Student's t, Bonferroni)."""
    # The additional error is that of the lattice, and of a pixel's middle.
    t = (picture.image - truth) / np.hypot(picture.standard_error, 1e-3 * truth)
    limit = stats.t.isf(0.5 * false_alarm / t.size, picture.passes - 1)
    assert np.abs(t).max() < limit
    # The mean over pixels agrees too, with a smaller error.
    error = np.sqrt((picture.standard_error.astype(np.float64) ** 2).sum(axis=(0, 1))) / t[..., 0].size
    off = (picture.image - truth).mean(axis=(0, 1)) / np.hypot(error, 1e-3 * truth.mean(axis=(0, 1)))
    assert np.abs(off).max() < stats.t.isf(0.5 * false_alarm / 3, 7 * 8)
