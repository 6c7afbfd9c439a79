"""What a network tells of an object in a picture: from every point seen, directions of incidence and Ŝ towards each."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from formats.mesh import Mesh
from prt_bake.lights.emitters import Disc, LightSampler
from prt_bake.lights.lighting import Lighting
from prt_bake.mathematics.random import uniforms
from prt_bake.network.inference.pairs import PairTransport
from prt_bake.rendering.mixture import Drawn, Lobe, Mixture, draw

Array = NDArray[np.float64]

NARROW = 10.0
"""Degrees: over a disc of this diameter Ŝ changes so little that one direction a point says enough of it."""
_DISC_STREAM = 0xA6


class PointLobes(Protocol):
    """Knows what directions to draw at points of pixels."""

    def at(self, pixels: NDArray[np.int64], positions: Array, outgoing: Array, normals: Array) -> Lobe:
        """The lobes of N points: positions [N,3] seen along outgoing [N,3], face normals [N,3], in pixels [N]."""


class NetworkTracer:
    """A network under a lighting: an `ObjectTracer`.

    Directional lights up to NARROW across get a direction of their own at each point: without size they are exact, and
    no lobe would meet them. The rest of the light is drawn as `mixture` says.
    """

    def __init__(
        self, transport: PairTransport, mesh: Mesh, lighting: Lighting, mixture: Mixture, lobes: PointLobes | None
    ) -> None:
        """`lobes` is asked where `mixture` draws from lobes."""
        self.mix(mixture)
        self._transport, self._mesh, self.lobes = transport, mesh, lobes
        wide = tuple(sun for sun in lighting.suns if sun.angular_diameter > NARROW)
        self._narrow = [Disc(sun) for sun in lighting.suns if sun.angular_diameter <= NARROW]
        self.spread = bool(wide) or any(sky.image.any() for sky in lighting.skies)
        self._sampler = LightSampler(Lighting(lighting.skies, wide)) if self.spread else None

    def mix(self, mixture: Mixture) -> None:
        """Draw as another mixture of as many points says."""
        self.mixture, self.points, self.samples = mixture, mixture.points, mixture.samples
        self.cost = max(1, max(mixture.directions) // 2)

    def radiance(
        self, faces: NDArray[np.int64], barycentric: Array, outgoing: Array, keys: NDArray[np.uint64], seed: int
    ) -> tuple[Array, int]:
        """As `ObjectTracer.radiance`; samples are evaluations of the network."""
        total, evaluations = self.radiance_by(faces, barycentric, outgoing, keys, seed, (self.mixture,))
        return total[0], evaluations

    def radiance_by(
        self,
        faces: NDArray[np.int64],
        barycentric: Array,
        outgoing: Array,
        keys: NDArray[np.uint64],
        seed: int,
        mixtures: tuple[Mixture, ...],
    ) -> tuple[Array, int]:
        """As `radiance`, by several mixtures [M,N,3], parts of this tracer's own: the same directions serve all."""
        total, evaluations = np.zeros((len(mixtures), len(faces), 3)), 0
        positions, normals = self._places(faces, barycentric), self._mesh.face_normals[faces]
        point_of = (keys % np.uint64(self.points)).astype(np.int64)
        # Points with as many directions are evaluated together: the network likes large batches.
        for count in sorted(set(self.mixture.directions)):
            points = [point for point in range(self.points) if self.mixture.directions[point] == count]
            chosen = [np.flatnonzero(point_of == point) for point in points]
            rows = np.concatenate(chosen)
            if not len(rows):
                continue
            drawn = [
                self._drawn(point, positions[rows], outgoing[rows], normals[rows], keys[rows], seed)
                for point, rows in zip(points, chosen, strict=True)
            ]
            towards, irradiance = self._to_narrow(keys[rows], seed)
            spread = [part.directions for part in drawn if part is not None]
            directions = np.concatenate([np.concatenate(spread), towards], axis=1) if spread else towards
            answers = self._transport.evaluate_pairs(directions, positions[rows], outgoing[rows])
            evaluations += answers.shape[0] * answers.shape[1]
            answers = np.asarray(answers, np.float64)
            narrow = answers.shape[1] - towards.shape[1]
            total[:, rows] = np.einsum("nsc,nsc->nc", answers[:, narrow:], irradiance)
            for i, mixture in enumerate(mixtures if spread else ()):
                weights = [
                    part.weights(mixture.light[point], mixture.lobe[point], mixture.trust)
                    for point, part in zip(points, drawn, strict=True)
                    if part is not None
                ]
                total[i, rows] += np.einsum("nsc,nsc->nc", answers[:, :narrow], np.concatenate(weights))
        return total, evaluations

    def _drawn(
        self, point: int, positions: Array, outgoing: Array, normals: Array, keys: NDArray[np.uint64], seed: int
    ) -> Drawn | None:
        """Directions to the light that is spread; None where there is none."""
        if self._sampler is None:
            return None
        lobe = None
        if self.mixture.lobe[point] and self.lobes is not None:
            pixels = (keys // np.uint64(self.points)).astype(np.int64)
            lobe = self.lobes.at(pixels, positions, outgoing, normals)
        return draw(self._sampler, lobe, self.mixture, point, keys, seed)

    def _to_narrow(self, keys: NDArray[np.uint64], seed: int) -> tuple[Array, Array]:
        """Directions to the narrow lights [N,L,3] and the irradiance [N,L,3] of each."""
        towards, irradiance = np.empty((2, len(keys), len(self._narrow), 3))
        for i, disc in enumerate(self._narrow):
            towards[:, i], irradiance[:, i] = disc.draw(uniforms((_DISC_STREAM, seed, i, keys), 2))
        return towards, irradiance

    def _places(self, faces: NDArray[np.int64], barycentric: Array) -> Array:
        corners = self._mesh.positions[self._mesh.faces[faces]]
        weights = np.concatenate([1.0 - barycentric.sum(axis=1, keepdims=True), barycentric], axis=1)
        return np.asarray(np.einsum("nk,nkc->nc", weights, corners))
