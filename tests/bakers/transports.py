"""Analytic transports for bakes: kinks, edges and lobes, with and without coherence between vertices."""

import numpy as np
import trimesh
from numpy.typing import NDArray

from formats.mesh import Mesh, build_mesh
from prt_bake.baking.job.views import views_of
from prt_bake.mathematics import sh, sphere
from prt_bake.mathematics.random import uniforms

Array = NDArray[np.float64]


def icosphere(subdivisions: int) -> Mesh:
    ball = trimesh.creation.icosphere(subdivisions=subdivisions)
    return build_mesh(np.asarray(ball.vertices), np.asarray(ball.faces))


class Edged:
    """A clamped cosine about the normal of a unit sphere, cut by a shadow edge; it does not depend on the view."""

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
    """Kinks and lobes that are independent of those at neighbouring vertices, and a kink in the view."""

    def evaluate(self, incident: Array, positions: Array, outgoing: Array) -> Array:
        numbers = _position_uniforms(positions)
        axes = _units(numbers[:, :6].reshape(-1, 2, 3) - 0.5)
        kinked = np.abs(np.einsum("ndi,ni->nd", incident, axes[:, 0]))
        kinked *= (np.maximum((outgoing * axes[:, 1]).sum(-1), 0.0) + 0.2)[:, None]
        sharpness = 3.0 + 20.0 * numbers[:, 6:]
        forward = np.exp(sharpness * (-np.einsum("ndi,ni->nd", incident, outgoing) - 1.0))
        return forward[..., None] * [1.0, 0.7, 0.5] + 0.3 * kinked[..., None] * [1.0, 0.7, 1.0]


class Chequered:
    """Varies so fast with the view that no view predicts another."""

    def evaluate(self, incident: Array, positions: Array, outgoing: Array) -> Array:
        chequer = np.sign(np.sin(40.0 * outgoing[:, 0]) * np.sin(40.0 * outgoing[:, 1]))
        cosine = np.maximum(np.einsum("ndi,ni->nd", incident, positions), 0.0)
        return (cosine * (1.0 + 0.5 * chequer[:, None]))[..., None] * np.array([1.0, 0.8, 0.5])


class Ringed:
    """Rings in the view that do not predict each other, times a light that varies slowly along the surface and leans
    with the view, so that no few components explain all bins.

    `patch`: radius of a spot that is three times as bright. `sharp`: stripes in world space instead of rings, so that
    no vertex predicts another. `blind`: a position at which nothing is finite.
    """

    def __init__(self, patch: float = 0.0, sharp: bool = False, blind: Array | None = None) -> None:
        self.patch, self.sharp, self.blind = patch, sharp, blind

    def evaluate(self, incident: Array, positions: Array, outgoing: Array) -> Array:
        rings = 1.0 + 0.5 * np.sin(40.0 * (outgoing * positions).sum(axis=-1))
        if self.sharp:
            rings = 1.0 + 0.5 * np.sign(np.sin(40.0 * outgoing[:, 0]))
        about = _units(positions + 0.5 * outgoing)
        lit = np.exp(12.0 * (np.einsum("ndi,ni->nd", incident, about) - 1.0)) * rings[:, None]
        if self.patch:
            lit[patched(positions, self.patch)] *= 3.0
        if self.blind is not None:
            lit[(np.abs(positions - self.blind) < 1e-9).all(axis=1)] = np.nan
        return lit[..., None] * np.array([1.0, 0.8, 0.5])


def patched(positions: Array, radius: float) -> NDArray[np.bool_]:
    return positions @ np.array([0.48, 0.6, 0.64]) > np.cos(radius)


class Clamped:
    """A clamped cosine that is darker towards grazing views, like light behind an interface."""

    def evaluate(self, incident: Array, positions: Array, outgoing: Array) -> Array:
        view = 1.0 - 0.8 * (1.0 - np.clip((positions * outgoing).sum(-1), 0.0, 1.0)) ** 5
        return _coloured(_facing(incident, positions) * view[:, None])


class Phased:
    """The Henyey–Greenstein phase function about −ωo, and a diffuse part."""

    def __init__(self, g: float = 0.8) -> None:
        self.g = g

    def evaluate(self, incident: Array, positions: Array, outgoing: Array) -> Array:
        g, cosine = self.g, -np.einsum("ndi,ni->nd", incident, outgoing)
        phase = (1.0 - g * g) / (1.0 + g * g - 2.0 * g * cosine) ** 1.5 / (4.0 * np.pi)
        return _coloured(0.3 * (phase + 0.2 + _facing(incident, positions)))


class Kinked:
    """A kink across an axis that varies with position and view."""

    def evaluate(self, incident: Array, positions: Array, outgoing: Array) -> Array:
        x, y, z = positions.T
        axes = _units(np.stack([np.sin(2.0 * x), np.cos(2.0 * y), np.sin(z + 1.0)], -1) + 0.5 * outgoing)
        return _coloured(np.abs(np.einsum("ndi,ni->nd", incident, axes)) + 0.1)


class TwoLobed:
    """Lobes about the mirrored view and about −ωo, of different colours."""

    def evaluate(self, incident: Array, positions: Array, outgoing: Array) -> Array:
        mirrored = 2.0 * (positions * outgoing).sum(-1, keepdims=True) * positions - outgoing
        back = np.exp(10.0 * (np.einsum("ndi,ni->nd", incident, mirrored) - 1.0))
        forward = np.exp(6.0 * (-np.einsum("ndi,ni->nd", incident, outgoing) - 1.0))
        return np.stack([back, 0.5 * (back + forward), forward], -1) + 0.3 * _facing(incident, positions)[..., None]


class KinkedPerVertex:
    """A kink at every vertex that is independent of those at neighbouring vertices."""

    def evaluate(self, incident: Array, positions: Array, outgoing: Array) -> Array:
        numbers = _position_uniforms(positions) - 0.5
        kinked = np.maximum(np.einsum("ndi,ni->nd", incident, _units(numbers[:, :3])), 0.0)
        return _coloured(kinked * (1.3 + (outgoing * _units(numbers[:, 3:6])).sum(-1))[:, None] + 0.05)


class LobedPerVertex:
    """Forward lobes with a different width and strength at every vertex."""

    def evaluate(self, incident: Array, positions: Array, outgoing: Array) -> Array:
        numbers = _position_uniforms(positions)
        sharpness, strength, floor = 3.0 + 10.0 * numbers[:, :1], 0.3 + numbers[:, 1:2], 0.3 * numbers[:, 2:3]
        forward = np.exp(sharpness * (-np.einsum("ndi,ni->nd", incident, outgoing) - 1.0))
        return _coloured(strength * forward + floor * _facing(incident, positions))


class Shadowed:
    """A clamped cosine cut off by a horizon that varies with position."""

    def evaluate(self, incident: Array, positions: Array, outgoing: Array) -> Array:
        lit = incident[..., 1] > 0.3 * np.sin(3.0 * positions[:, :1])
        return _coloured(_facing(incident, positions) * lit + 0.1)


class Sunlit:
    """A fixed light of 5° that darkens towards grazing views, on a diffuse floor."""

    def evaluate(self, incident: Array, positions: Array, outgoing: Array) -> Array:
        towards = np.array([0.3, 0.5, 0.8]) / np.linalg.norm([0.3, 0.5, 0.8])
        small = np.exp(300.0 * (incident @ towards - 1.0)) * np.abs((outgoing * positions).sum(-1))[:, None]
        return _coloured(0.5 * _facing(incident, positions) + 3.0 * small)


def _coloured(values: Array) -> Array:
    return np.asarray(values[..., None] * np.array([1.0, 0.7, 0.5]))


def _facing(incident: Array, normals: Array) -> Array:
    return np.asarray(np.maximum(np.einsum("ndi,ni->nd", incident, normals), 0.0))


def _units(vectors: Array) -> Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def _position_uniforms(positions: Array) -> Array:
    """Uniform random numbers [N,7] for each position."""
    key = np.round(positions * 1e6).astype(np.int64)
    return np.asarray(uniforms((1, key[:, 0], key[:, 1], key[:, 2]), 7))


class Counting:
    """Counts the evaluations of another transport."""

    def __init__(self, transport: object) -> None:
        self.transport, self.evaluations = transport, 0

    def evaluate(self, incident: Array, positions: Array, outgoing: Array) -> Array:
        answer = self.transport.evaluate(incident, positions, outgoing)  # type: ignore[attr-defined]
        self.evaluations += answer.shape[0] * answer.shape[1]
        return answer


def exact(
    transport: object, mesh: Mesh, rings: int, sectors: int, degree: int = 2, directions: int = 4096, every: int = 1
) -> Array:
    """Coefficients [V,B,K,3] from a fit over many directions, with a rotation per vertex; for one of `every` bins."""
    lattice = sphere.fibonacci(directions)
    harmonics = sh.evaluate(lattice, degree)
    fit = np.linalg.solve(harmonics.T @ harmonics, harmonics.T)
    views = views_of(mesh, rings, sectors)
    found = np.empty((len(mesh.positions), -(-rings * sectors // every), sh.count(degree), 3))
    for vertex, x in enumerate(mesh.positions):
        turn = sphere.random_rotations(1, 900 + vertex)[0]
        outgoing = views(np.array([vertex]))[0][0, ::every]
        for first in range(0, len(outgoing), 64):
            some = outgoing[first : first + 64]
            incident = np.broadcast_to(lattice @ turn.T, (len(some), directions, 3))
            values = transport.evaluate(incident, np.repeat(x[None], len(some), 0), some)  # type: ignore[attr-defined]
            found[vertex, first : first + 64] = sh.rotation(turn, degree) @ (fit @ np.asarray(values, np.float64))
    return found


def uniform_directions_needed(
    transport: object, mesh: Mesh, truth: Array, rings: int, sectors: int, error: float
) -> float:
    """Uniform directions per bin that plain Monte Carlo needs for the error, from its measured variance of one
    direction.
    """
    views = views_of(mesh, rings, sectors)
    generator, squares, many = np.random.default_rng(3), 0.0, 0
    for vertex, x in enumerate(mesh.positions):
        bins = generator.integers(0, rings * sectors, 16)
        incident = sphere.uniform(16 * 256, vertex).reshape(16, 256, 3)
        values = transport.evaluate(incident, np.repeat(x[None], 16, 0), views(np.array([vertex]))[0][0, bins])  # type: ignore[attr-defined]
        harmonics = sh.evaluate(incident.reshape(-1, 3), 2).reshape(16, 256, -1)
        squares += float(((4.0 * np.pi * harmonics[..., None] * values[:, :, None]).var(axis=1)).sum())
        many += 16
    return squares / many / float((truth**2).sum(axis=(2, 3)).mean()) / error**2
