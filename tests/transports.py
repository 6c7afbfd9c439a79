"""Analytic transports for bakes: kinks, edges and lobes, with and without coherence between vertices."""

import numpy as np
import trimesh
from numpy.typing import NDArray

from formats.mesh import Mesh, build_mesh
from prt_bake import sh, sphere
from prt_bake.bake_job import views_of
from prt_bake.randomness import uniforms

Array = NDArray[np.float64]


def icosphere(subdivisions: int) -> Mesh:
    ball = trimesh.creation.icosphere(subdivisions=subdivisions)
    return build_mesh(np.asarray(ball.vertices), np.asarray(ball.faces))


class Edged:
    """A clamped cosine about the normal of a unit sphere, cut by a shadow's edge; the view does not matter."""

    def evaluate(self, incident: Array, positions: Array, outgoing: Array) -> Array:
        cosine = np.maximum(np.einsum("ndi,ni->nd", incident, positions), 0.0)
        lit = np.where(incident[..., 0] > 0.4 * positions[:, None, 1], 1.0, 0.5)
        return np.stack([cosine * lit, cosine, cosine**2 + 0.05], axis=-1)


class Lobed:
    """A forward lobe about −ωo on a diffuse floor."""

    def __init__(self, sharpness: float = 8.0, floor: float = 0.3) -> None:
        self.sharpness, self.floor = sharpness, floor

    def evaluate(self, incident: Array, positions: Array, outgoing: Array) -> Array:
        forward = np.exp(self.sharpness * (-np.einsum("ndi,ni->nd", incident, outgoing) - 1.0))
        facing = np.maximum(np.einsum("ndi,ni->nd", incident, positions), 0.0)
        colours = np.array([1.0, 0.7, 0.5])
        return forward[..., None] * colours + self.floor * facing[..., None] * colours[::-1]


class Incoherent:
    """Kinks and lobes that have nothing to do with those of the vertices beside, and a kink in the view."""

    def evaluate(self, incident: Array, positions: Array, outgoing: Array) -> Array:
        key = np.round(positions * 1e6).astype(np.int64)
        numbers = uniforms((1, key[:, 0], key[:, 1], key[:, 2]), 7)
        axes = numbers[:, :6].reshape(-1, 2, 3) - 0.5
        axes /= np.linalg.norm(axes, axis=-1, keepdims=True)
        kinked = np.abs(np.einsum("ndi,ni->nd", incident, axes[:, 0]))
        kinked *= (np.maximum((outgoing * axes[:, 1]).sum(-1), 0.0) + 0.2)[:, None]
        sharpness = 3.0 + 20.0 * numbers[:, 6:]
        forward = np.exp(sharpness * (-np.einsum("ndi,ni->nd", incident, outgoing) - 1.0))
        return forward[..., None] * [1.0, 0.7, 0.5] + 0.3 * kinked[..., None] * [1.0, 0.7, 1.0]


class Chequered:
    """What is seen changes with the view so fast that no view tells of another."""

    def evaluate(self, incident: Array, positions: Array, outgoing: Array) -> Array:
        chequer = np.sign(np.sin(40.0 * outgoing[:, 0]) * np.sin(40.0 * outgoing[:, 1]))
        cosine = np.maximum(np.einsum("ndi,ni->nd", incident, positions), 0.0)
        return (cosine * (1.0 + 0.5 * chequer[:, None]))[..., None] * np.array([1.0, 0.8, 0.5])


class Counting:
    """Counts what another transport is asked for, from outside."""

    def __init__(self, transport: object) -> None:
        self.transport, self.evaluations = transport, 0

    def evaluate(self, incident: Array, positions: Array, outgoing: Array) -> Array:
        answer = self.transport.evaluate(incident, positions, outgoing)  # type: ignore[attr-defined]
        self.evaluations += answer.shape[0] * answer.shape[1]
        return answer


def exact(transport: object, mesh: Mesh, rings: int, sectors: int, degree: int = 2, directions: int = 4096) -> Array:
    """Coefficients [V,B,K,3] from a fit over many directions, turned anew at each vertex."""
    lattice = sphere.fibonacci(directions)
    harmonics = sh.evaluate(lattice, degree)
    fit = np.linalg.solve(harmonics.T @ harmonics, harmonics.T)
    _tangents, views = views_of(mesh, rings, sectors)
    found = np.empty((len(mesh.positions), rings * sectors, sh.count(degree), 3))
    for vertex, x in enumerate(mesh.positions):
        turn = sphere.random_rotations(1, 900 + vertex)[0]
        outgoing = views(vertex, vertex + 1)[0][0]
        for first in range(0, len(outgoing), 64):
            some = outgoing[first : first + 64]
            incident = np.broadcast_to(lattice @ turn.T, (len(some), directions, 3))
            values = transport.evaluate(incident, np.repeat(x[None], len(some), 0), some)  # type: ignore[attr-defined]
            found[vertex, first : first + 64] = sh.rotation(turn, degree) @ (fit @ np.asarray(values, np.float64))
    return found


def uniform_needs(transport: object, mesh: Mesh, truth: Array, rings: int, sectors: int, error: float) -> float:
    """Uniform directions a bin that plain Monte Carlo needs for the error: its variance of one direction, measured."""
    _tangents, views = views_of(mesh, rings, sectors)
    generator, squares, many = np.random.default_rng(3), 0.0, 0
    for vertex, x in enumerate(mesh.positions):
        bins = generator.integers(0, rings * sectors, 16)
        incident = sphere.uniform(16 * 256, vertex).reshape(16, 256, 3)
        values = transport.evaluate(incident, np.repeat(x[None], 16, 0), views(vertex, vertex + 1)[0][0, bins])  # type: ignore[attr-defined]
        harmonics = sh.evaluate(incident.reshape(-1, 3), 2).reshape(16, 256, -1)
        squares += float(((4.0 * np.pi * harmonics[..., None] * values[:, :, None]).var(axis=1)).sum())
        many += 16
    return squares / many / float((truth**2).sum(axis=(2, 3)).mean()) / error**2
