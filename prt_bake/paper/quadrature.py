"""The network's picture without noise: every texel of the sky is counted, gathered into cells about a lattice.

It tells what of a picture's error is the network's, and what is noise. Light within a cell is moved to its middle, by
up to 3 degrees with 2048 of them, which Ŝ, that is smooth over such angles, does not notice.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from formats.mesh import Mesh
from prt_bake import environment
from prt_bake.camera import Camera, Visibility, directions
from prt_bake.directions import fibonacci
from prt_bake.lighting import Lighting
from prt_bake.network import NeuralBSSRDF

Array = NDArray[np.float64]

_VALUES_AT_ONCE = 1 << 21


def gathered(lighting: Lighting, cells: int) -> tuple[Array, Array]:
    """Directions [D,3] and the irradiance [D,3] that comes from about each; together all of the skies' light."""
    lattice = fibonacci(cells)
    tree, irradiance = cKDTree(lattice), np.zeros((cells, 3))
    for sky in lighting.skies:
        height, width = sky.image.shape[:2]
        u, v = np.meshgrid((np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height)
        towards = environment.direction_of(u, v, sky.up).reshape(-1, 3) @ sky.turn.T
        edges = np.cos(np.pi * np.arange(height + 1) / height)
        solid_angle = np.repeat((edges[:-1] - edges[1:]) * 2.0 * np.pi / width, width)
        _distance, cell = tree.query(towards)
        np.add.at(irradiance, cell, sky.image.reshape(-1, 3) * solid_angle[:, None])
    return lattice, irradiance


def seen_points(mesh: Mesh, view: Camera, points: int) -> tuple[NDArray[np.int64], Array, Array]:
    """Pixels [N], row · width + column, positions [N,3] and directions to the eye [N,3] of what points² rays a pixel
    meet.
    """
    steps = (np.arange(points) + 0.5) / points
    offsets = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    rays = directions(view, slice(0, view.height), offsets).reshape(-1, 3)
    hits = Visibility(mesh).first_hits(view.eye, rays)
    met = np.flatnonzero(hits.faces >= 0)
    u, v = hits.barycentric[met].T
    shares = np.stack([1.0 - u - v, u, v], axis=1)
    positions = np.einsum("nk,nki->ni", shares, mesh.positions[mesh.faces[hits.faces[met]]])
    return met // len(offsets), positions, -rays[met]


def quadrature_picture(
    network: NeuralBSSRDF, mesh: Mesh, lighting: Lighting, view: Camera, cells: int = 2048, points: int = 2
) -> NDArray[np.float32]:
    """The picture [H,W,3] of the light from under the surface, black elsewhere, of points² rays a pixel and `cells`
    directions each; negative radiance is cut to 0. Directional lights are not in it.
    """
    towards, irradiance = gathered(lighting, cells)
    incident = towards[None]  # one array for every call: what is worked out of it is kept
    pixels, positions, outgoing = seen_points(mesh, view, points)
    fused = network.prepared()
    radiance = np.zeros((len(pixels), 3))
    step = max(1, _VALUES_AT_ONCE // cells)
    for first in range(0, len(pixels), step):
        rows = slice(first, first + step)
        rotation = np.zeros((len(positions[rows]), 1), np.int64)
        values = fused.evaluate_block(incident, rotation, positions[rows], outgoing[rows, None])
        radiance[rows] = np.einsum("ndc,dc->nc", values[:, 0], irradiance)
    image = [np.bincount(pixels, channel, view.height * view.width) for channel in np.maximum(radiance, 0.0).T]
    return (np.stack(image, axis=-1) / points**2).reshape(view.height, view.width, 3).astype(np.float32)
