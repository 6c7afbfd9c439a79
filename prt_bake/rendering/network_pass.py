"""Passes of a network's picture: incident directions are sampled at each visible point, and the network gives Ŝ."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from formats.mesh import Mesh
from prt_bake.lights.emitters import Disc, LightSampler
from prt_bake.lights.lighting import Lighting
from prt_bake.mathematics.random import uniforms
from prt_bake.network.inference.pairs import PairTransport
from prt_bake.rendering.mixture import IncidentSamples, Lobe, Mixture, draw
from prt_bake.rendering.object_points import ObjectPoints

Array = NDArray[np.float64]

NARROW = 10.0
"""Degrees: over a disc of this diameter Ŝ changes so little that one direction per point is enough."""
_DISC_STREAM = 0xA6


class PointLobes(Protocol):
    """Lobes for sampling incident directions at points of pixels."""

    def at(self, pixels: NDArray[np.int64], positions: Array, outgoing: Array, normals: Array) -> Lobe:
        """Lobes of N points: positions [N,3] seen along outgoing [N,3], face normals [N,3], in pixels [N]."""


class NetworkTracer:
    """The `ObjectTracer` of a network under a lighting.

    Directional lights up to NARROW across get a separate direction at each point: without size they are exact, and a
    lobe would miss them. The other lights are sampled by the mixture.
    """

    def __init__(
        self, transport: PairTransport, mesh: Mesh, lighting: Lighting, mixture: Mixture, lobes: PointLobes | None
    ) -> None:
        """`lobes` is used if the mixture samples lobes."""
        self.set_mixture(mixture)
        self._transport, self._mesh, self.lobes = transport, mesh, lobes
        wide = tuple(sun for sun in lighting.suns if sun.angular_diameter > NARROW)
        self._narrow = [Disc(sun) for sun in lighting.suns if sun.angular_diameter <= NARROW]
        self.has_wide_lights = bool(wide) or any(sky.image.any() for sky in lighting.skies)
        self._sampler = LightSampler(Lighting(lighting.skies, wide)) if self.has_wide_lights else None

    def set_mixture(self, mixture: Mixture) -> None:
        """Use another mixture of as many points."""
        self.mixture, self.points, self.samples = mixture, mixture.points, mixture.samples
        self.cost = max(1, max(mixture.directions) // 2)

    def radiance(self, points: ObjectPoints, seed: int) -> tuple[Array, int]:
        """As `ObjectTracer.radiance`; samples are evaluations of the network."""
        total, evaluations = self.radiance_by_mixtures(points, seed, (self.mixture,))
        return total[0], evaluations

    def radiance_by_mixtures(self, seen: ObjectPoints, seed: int, mixtures: tuple[Mixture, ...]) -> tuple[Array, int]:
        """`radiance` by several mixtures [M,N,3] that are subsets of the tracer's mixture, from the same directions."""
        total, evaluations = np.zeros((len(mixtures), len(seen.faces), 3)), 0
        positions, normals = self._positions(seen), self._mesh.face_normals[seen.faces]
        outgoing, keys = seen.outgoing, seen.keys
        point_of = (keys % np.uint64(self.points)).astype(np.int64)
        # Points with equally many directions are evaluated together, since large batches are faster.
        for count in sorted(set(self.mixture.directions)):
            points = [point for point in range(self.points) if self.mixture.directions[point] == count]
            chosen = [np.flatnonzero(point_of == point) for point in points]
            rows = np.concatenate(chosen)
            if not len(rows):
                continue
            samples = [
                self._sample(point, positions[rows], outgoing[rows], normals[rows], keys[rows], seed)
                for point, rows in zip(points, chosen, strict=True)
            ]
            to_narrow, irradiance = self._sample_narrow(keys[rows], seed)
            to_wide = [part.directions for part in samples if part is not None]
            directions = np.concatenate([np.concatenate(to_wide), to_narrow], axis=1) if to_wide else to_narrow
            values = self._transport.evaluate_pairs(directions, positions[rows], outgoing[rows])
            evaluations += values.shape[0] * values.shape[1]
            values = np.asarray(values, np.float64)
            wide = values.shape[1] - to_narrow.shape[1]
            total[:, rows] = np.einsum("nsc,nsc->nc", values[:, wide:], irradiance)
            for i, mixture in enumerate(mixtures if to_wide else ()):
                weights = [
                    part.weights(mixture.light[point], mixture.lobe[point], mixture.trust)
                    for point, part in zip(points, samples, strict=True)
                    if part is not None
                ]
                total[i, rows] += np.einsum("nsc,nsc->nc", values[:, :wide], np.concatenate(weights))
        return total, evaluations

    def _sample(
        self, point: int, positions: Array, outgoing: Array, normals: Array, keys: NDArray[np.uint64], seed: int
    ) -> IncidentSamples | None:
        """Directions to the wide lights; None without such lights."""
        if self._sampler is None:
            return None
        lobe = None
        if self.mixture.lobe[point] and self.lobes is not None:
            pixels = (keys // np.uint64(self.points)).astype(np.int64)
            lobe = self.lobes.at(pixels, positions, outgoing, normals)
        return draw(self._sampler, lobe, self.mixture, point, keys, seed)

    def _sample_narrow(self, keys: NDArray[np.uint64], seed: int) -> tuple[Array, Array]:
        """Directions to the narrow lights [N,L,3], and their irradiance [N,L,3]."""
        directions, irradiance = np.empty((2, len(keys), len(self._narrow), 3))
        for i, disc in enumerate(self._narrow):
            directions[:, i], irradiance[:, i] = disc.draw(uniforms((_DISC_STREAM, seed, i, keys), 2))
        return directions, irradiance

    def _positions(self, points: ObjectPoints) -> Array:
        corners = self._mesh.positions[self._mesh.faces[points.faces]]
        u_v = points.barycentric
        weights = np.concatenate([1.0 - u_v.sum(axis=1, keepdims=True), u_v], axis=1)
        return np.asarray(np.einsum("nk,nkc->nc", weights, corners))
