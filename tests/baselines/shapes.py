"""Meshes with texture coordinates."""

import itertools

import numpy as np
from numpy.typing import NDArray

from formats.mesh import Mesh, build_mesh

Array = NDArray[np.float64]
_GAP = 0.06
"""Distance of a chart from its cell's border, in cells."""


def ball_of_charts(n: int = 6) -> Mesh:
    """A unit ball of six charts, each a side of a cube of n × n quads, in 3 × 2 cells of the texture."""
    line = np.linspace(-1.0, 1.0, n + 1)
    v, u = (part.ravel() for part in np.meshgrid(line, line, indexing="ij"))
    corner = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    a, b, c, d = (part.ravel() for part in (corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]))
    side = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    points, faces, uv = [], [], []
    for number, (axis, sign) in enumerate(itertools.product(range(3), (1.0, -1.0))):
        place = np.empty((len(u), 3))
        place[:, axis], place[:, (axis + 1) % 3], place[:, (axis + 2) % 3] = sign, sign * u, v
        points.append(place)
        faces.append(side + number * len(u))
        inside = _GAP + (1.0 - 2.0 * _GAP) * (np.stack([u, v], axis=1) + 1.0) / 2.0
        uv.append((inside + np.array([number % 3, number // 3])) / 3.0)
    cells = np.concatenate(points)
    unique, index = np.unique(np.round(cells, 9), axis=0, return_inverse=True)
    positions = unique / np.linalg.norm(unique, axis=1, keepdims=True)
    triangles = np.concatenate(faces)
    mesh = build_mesh(positions, index.ravel()[triangles])
    return Mesh(mesh.positions, mesh.faces, positions, corner_uv=np.concatenate(uv)[triangles])


def queries_on(mesh: Mesh, count: int, seed: int = 0) -> tuple[NDArray[np.int64], Array, Array]:
    """Random faces [N], barycentric (u, v) [N,2] and positions [N,3] on them."""
    generator = np.random.default_rng(seed)
    faces = generator.integers(len(mesh.faces), size=count)
    weights = generator.dirichlet(np.ones(3), size=count)
    positions = np.einsum("nc,ncj->nj", weights, mesh.positions[np.asarray(mesh.faces)[faces]])
    return faces, weights[:, 1:], positions
