"""Small networks, lobes and cameras for the tests of networks' pictures, and what their pictures should be."""

import numpy as np
from scipy import stats
from shapes import ball

from prt_bake import directions
from prt_bake.camera import Camera, Visibility, pixel_directions
from prt_bake.lighting import Lighting
from prt_bake.lobe import Lobe
from prt_bake.network import NetworkSettings, NeuralBSSRDF
from prt_bake.render_loop import Rendering

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


def close_up(size: int = 6) -> Camera:
    """All pixels show the ball."""
    return Camera(np.array([0.5, 1.0, 4.0]), np.array([0.05, 0.1, 0.0]), np.array([0.0, 1.0, 0.0]), 12.0, size, size)


def quadrature(network, lighting: Lighting, camera: Camera, count: int = 20_000, across: int = 3) -> np.ndarray:
    """The pixels [H,W,3] by `count` directions of a lattice and Gauss points in each pixel."""
    nodes, shares = np.polynomial.legendre.leggauss(across)
    places = np.stack(np.meshgrid(0.5 * nodes + 0.5, 0.5 * nodes + 0.5), axis=-1).reshape(1, -1, 2)
    weights = np.outer(0.5 * shares, 0.5 * shares).ravel()
    pixels = np.arange(camera.width * camera.height)
    rays = pixel_directions(camera, pixels, np.repeat(places, len(pixels), axis=0)).reshape(-1, 3)
    hits = Visibility(MESH).first_hits(camera.eye, rays)
    assert (hits.faces >= 0).all()
    corners = MESH.positions[MESH.faces[hits.faces]]
    u, v = hits.barycentric[:, :1], hits.barycentric[:, 1:]
    positions = (1 - u - v) * corners[:, 0] + u * corners[:, 1] + v * corners[:, 2]
    incident = directions.fibonacci(count)
    light = lighting.radiance(incident) * 4 * np.pi / count
    radiance = np.concatenate(
        [
            np.einsum("ndc,dc->nc", network.evaluate(incident, positions[n : n + 16], -rays[n : n + 16]), light)
            for n in range(0, len(rays), 16)
        ]
    )
    return (radiance.reshape(len(pixels), -1, 3) * weights[:, None]).sum(axis=1).reshape(camera.height, -1, 3)


def assert_pictures(picture: Rendering, truth: np.ndarray, false_alarm: float = 1e-4) -> None:
    """Every pixel agrees with the truth, within its error as passes measure it (Student's t, Bonferroni)."""
    t = (picture.image - truth) / picture.standard_error
    limit = stats.t.isf(0.5 * false_alarm / t.size, picture.passes - 1)
    assert np.abs(t).max() < limit
    assert np.sqrt(np.mean(t**2)) < 1.5  # that none is far off does not say that all are right
