"""Small networks, lobes and cameras for the tests of networks' pictures, and what their pictures should be."""

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
    """Random, smooth, mostly positive."""
    shape = {"features": 16, "width": 32, "feature_mean": 0.0, "feature_spread": 0.15, "directions": "cartesian"}
    metadata = {"up": "y", "eta": 1.4, "roughness": 0.3}
    network = NeuralBSSRDF(NetworkSettings(**shape | settings), (-1.0,) * 3, 2.0, 0.1, metadata)
    network.output.bias.data += 1.0
    return network.eval()


class Lobes:
    """A module whose lobes about the normal widen with height."""

    def lobe(self, positions, outgoing, normals) -> Lobe:
        sigma = 0.6 + 0.2 * np.asarray(positions)[:, 1:2]
        return Lobe(np.asarray(normals)[:, None], sigma, np.ones_like(sigma), 2.0)


class Slope:
    """A transport of directions of incidence alone: 1 + b·ωi, so that its integrals are known."""

    slope = np.array([0.3, -0.4, 0.5])

    def evaluate(self, incident, positions, outgoing):
        value = 1.0 + np.asarray(incident) @ self.slope
        return np.repeat(value[..., None], 3, axis=2) * np.array([1.0, 2.0, 0.5])


def close_up(size: int = 4) -> Camera:
    """All pixels show the ball, and so little of it that a pixel's middle says all of it."""
    return Camera(np.array([0.5, 1.0, 4.0]), np.array([0.05, 0.1, 0.0]), np.array([0.0, 1.0, 0.0]), 1.0, size, size)


def quadrature(network, lighting: Lighting, camera: Camera, count: int = 20_000) -> np.ndarray:
    """The pixels [H,W,3], of which the middles are taken, by `count` directions of a lattice."""
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
    """Every pixel agrees with the truth, within its error as passes measure it (Student's t, Bonferroni)."""
    # Besides chance: what the lattice misses of an uneven sky, and a pixel's middle of the pixel.
    t = (picture.image - truth) / np.hypot(picture.standard_error, 1e-3 * truth)
    limit = stats.t.isf(0.5 * false_alarm / t.size, picture.passes - 1)
    assert np.abs(t).max() < limit
    # And so does their mean, of whose error many pixels tell more.
    error = np.sqrt((picture.standard_error.astype(np.float64) ** 2).sum(axis=(0, 1))) / t[..., 0].size
    off = (picture.image - truth).mean(axis=(0, 1)) / np.hypot(error, 1e-3 * truth.mean(axis=(0, 1)))
    assert np.abs(off).max() < stats.t.isf(0.5 * false_alarm / 3, 7 * 8)
