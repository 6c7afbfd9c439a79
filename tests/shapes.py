"""Meshes for tests."""

import numpy as np

from formats.mesh import Mesh, build_mesh

OCTAHEDRON = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], np.float64)


def ball(subdivisions: int, radius: float = 1.0) -> Mesh:
    """A sphere from a subdivided octahedron; quarter turns about the axes are symmetries."""
    positions = OCTAHEDRON
    faces = np.array([[x, y, z] for x in (0, 1) for y in (2, 3) for z in (4, 5)])
    inward = np.linalg.det(positions[faces]) < 0
    faces[inward] = faces[inward][:, ::-1]
    for _ in range(subdivisions):
        positions, faces = _subdivided(positions, faces)
    return build_mesh(radius * positions, faces)


def _subdivided(positions: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    edges = np.sort(np.concatenate([faces[:, [1, 2]], faces[:, [2, 0]], faces[:, [0, 1]]]), axis=1)
    edges, of_face = np.unique(edges, axis=0, return_inverse=True)
    middles = positions[edges].sum(axis=1)
    middles /= np.linalg.norm(middles, axis=1, keepdims=True)
    a, b, c = faces.T
    bc, ca, ab = len(positions) + of_face.reshape(3, -1)
    quarters = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    return np.concatenate([positions, middles]), np.concatenate([np.stack(corners, axis=1) for corners in quarters])


def ring(major: float = 1.0, minor: float = 0.4, around: int = 16, across: int = 10) -> Mesh:
    """A torus about y."""
    u, v = np.meshgrid(np.arange(around), np.arange(across), indexing="ij")
    phi, theta = 2 * np.pi * u / around, 2 * np.pi * v / across
    out = major + minor * np.cos(theta)
    positions = np.stack([out * np.cos(phi), minor * np.sin(theta), out * np.sin(phi)], axis=-1).reshape(-1, 3)

    def vertex(i: np.ndarray, j: np.ndarray) -> np.ndarray:
        return (i % around) * across + j % across

    corners = [vertex(u, v), vertex(u, v + 1), vertex(u + 1, v + 1), vertex(u + 1, v)]
    a, b, c, d = (corner.ravel() for corner in corners)
    return build_mesh(positions, np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]))
