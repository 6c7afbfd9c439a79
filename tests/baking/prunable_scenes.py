"""Meshes and transports with parts that are redundant, or nearly so."""

from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray

from formats.mesh import Mesh, build_mesh
from tests.bakers.transports import Array


@dataclass(frozen=True)
class Grey:
    """A clamped cosine with equal channels except at one vertex, and equal views except at another."""

    coloured: Array | None = None
    changing: Array | None = None

    def evaluate(self, incident: Array, positions: Array, outgoing: Array) -> Array:
        cosine = np.maximum(np.einsum("ndi,ni->nd", incident, positions), 0.0)
        value = np.repeat(cosine[..., None], 3, axis=-1)
        if self.coloured is not None:
            value[np.isclose(positions, self.coloured).all(axis=1)] *= [1.0, 0.9, 0.8]
        if self.changing is not None:
            there = np.isclose(positions, self.changing).all(axis=1)
            value[there] *= 1.0 + (outgoing[there] * positions[there]).sum(axis=1)[:, None, None]
        return value


class Flat:
    """Constant and linear bands alone."""

    def evaluate(self, incident: Array, positions: Array, outgoing: Array) -> Array:
        value = 0.5 + 0.4 * np.einsum("ndi,ni->nd", incident, positions)
        return value[..., None] * (1.0 + (outgoing * positions).sum(axis=1))[:, None, None] * [1.0, 0.5, 0.2]


@dataclass(frozen=True)
class Nearly:
    """Equal in all channels and views and without band 2, except for these shares of the coefficients."""

    coloured: float = 0.0
    changing: float = 0.0
    banded: float = 0.0
    at: Array | None = None
    """The only vertex with these differences; None: all vertices."""

    def evaluate(self, incident: Array, positions: Array, outgoing: Array) -> Array:
        here = np.ones(len(positions)) if self.at is None else np.isclose(positions, self.at).all(axis=1)
        cosine = np.einsum("ndi,ni->nd", incident, positions)
        # The norm of 3 c² − 1 is √(16π/5), that of the constant √(4π).
        value = 1.0 + here[:, None] * self.banded * np.sqrt(5.0 / 4.0) * (3.0 * cosine**2 - 1.0)
        # The bins' cosines to the normal are uniform: scaled to mean 0 and variance 1.
        by_view = np.sqrt(12.0) * ((outgoing * positions).sum(axis=1) - 0.5)
        value *= 1.0 + (here * self.changing * by_view)[:, None]
        spread = np.sqrt(1.5) * self.coloured * np.array([1.0, -1.0, 0.0])
        return np.asarray(value[..., None] * (1.0 + here[:, None, None] * spread))


def nested(*radii: float) -> tuple[Mesh, NDArray[np.bool_]]:
    """Concentric balls, the largest first, and a mask of the vertices inside another ball."""
    balls = [trimesh.creation.icosphere(subdivisions=1, radius=radius) for radius in radii]
    each = len(balls[0].vertices)
    faces = np.concatenate([ball.faces + number * each for number, ball in enumerate(balls)])
    mesh = build_mesh(np.concatenate([ball.vertices for ball in balls]), faces)
    return mesh, np.arange(each * len(radii)) >= each


def pierced(width: float) -> tuple[Mesh, NDArray[np.bool_]]:
    """A ball in a ball, one face of which is shrunk by that share within its plane. Only inner faces with a corner of
    the gap in front of them are visible; also a mask of the hidden vertices.
    """
    mesh, inside = nested(1.0, 0.5)
    corners = mesh.positions[mesh.faces[0]]
    drawn = corners.mean(axis=0) + (1.0 - width) * (corners - corners.mean(axis=0))
    faces = np.concatenate([mesh.faces[1:], len(mesh.positions) + np.arange(3)[None]])
    in_front = (corners[None, :, None] - mesh.positions[mesh.faces][:, None]) * mesh.face_normals[:, None, None]
    shown = (in_front.sum(axis=-1) > 0.0).any(axis=(1, 2)) & inside[mesh.faces].all(axis=1)
    hidden = np.append(inside, [False] * 3)
    hidden[mesh.faces[shown]] = False
    return build_mesh(np.concatenate([mesh.positions, drawn]), faces), hidden


def finned() -> tuple[Mesh, NDArray[np.bool_]]:
    """Three sheets on one edge, a bow tie, a face without area and a vertex of no face."""
    around = [[np.cos(angle), np.sin(angle), height] for angle in (0.0, 2.1, 4.2) for height in (0.0, 1.0)]
    points = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0], *around, [3.0, 0.0, 0.0], [3.0, 1.0, 0.0], [9.0, 9.0, 9.0]])
    sheets = [[0, 1, 2 * n + 3] for n in (0, 1, 2)] + [[0, 2 * n + 3, 2 * n + 2] for n in (0, 1, 2)]
    faces = np.array([*sheets, [2, 8, 9], [0, 0, 1]])
    return build_mesh(points, faces), np.zeros(len(points), bool)


def two_skinned() -> tuple[Mesh, NDArray[np.bool_]]:
    """A ball with every face twice, back to back: no vertex is hidden."""
    ball = trimesh.creation.icosphere(subdivisions=1)
    vertices, faces = np.asarray(ball.vertices), np.asarray(ball.faces, np.int32)
    both = np.concatenate([faces, faces[:, ::-1] + len(vertices)])
    mesh = Mesh(np.concatenate([vertices, vertices]), both, np.concatenate([vertices, -vertices]))
    return mesh, np.zeros(2 * len(vertices), bool)


def doubled() -> Mesh:
    """A ball with every vertex twice; half of its faces use one copy, half the other."""
    ball = trimesh.creation.icosphere(subdivisions=1)
    vertices, faces = np.asarray(ball.vertices), np.asarray(ball.faces, np.int32).copy()
    faces[::2] += len(vertices)
    return Mesh(np.concatenate([vertices] * 2), faces, np.concatenate([vertices] * 2))


def soup() -> Mesh:
    """A ball whose faces share no vertices, with the normals of the ball."""
    ball = trimesh.creation.icosphere(subdivisions=1)
    vertices = np.asarray(ball.vertices)[np.asarray(ball.faces).reshape(-1)]
    return Mesh(vertices, np.arange(len(vertices), dtype=np.int32).reshape(-1, 3), vertices.copy())
