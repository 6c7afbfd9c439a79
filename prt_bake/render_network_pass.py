"""What a network tells of an object in a picture: from every point seen, directions of incidence and Ŝ towards each."""

import math
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from formats.mesh import Mesh
from prt_bake.emitters import Disc, LightSampler
from prt_bake.lighting import Lighting
from prt_bake.randomness import uniforms
from prt_bake.render_mixture import Counts, LobeMaker, draw

Array = NDArray[np.float64]

NARROW = 10.0
"""Degrees: over a disc of this diameter Ŝ changes so little that one direction a point says enough of it."""
_DISC_STREAM = 0xA6


class PairTransport(Protocol):
    """Answers Ŝ for points with directions of their own."""

    def evaluate_pairs(self, incident: Array, positions: Array, outgoing: Array) -> NDArray[np.floating]:
        """Ŝ [N,S,3] in 1/sr: incident [N,S,3], positions [N,3], outgoing [N,3]."""


class NetworkTracer:
    """A network under a lighting: an `ObjectTracer`.

    Directional lights up to NARROW across get a direction of their own at each point: without size they are exact, and
    no lobe would meet them. The rest of the light is drawn from as `counts` says.
    """

    def __init__(
        self, transport: PairTransport, mesh: Mesh, lighting: Lighting, counts: Counts, lobes: LobeMaker | None
    ) -> None:
        """`lobes` is asked where `counts` draws from lobes."""
        self.counts, self.points, self.samples = counts, counts.points, counts.samples
        self.cost = 2 * math.ceil(counts.samples / counts.points)
        self._transport, self._mesh, self._lobes = transport, mesh, lobes
        wide = tuple(sun for sun in lighting.suns if sun.angular_diameter > NARROW)
        self._narrow = [Disc(sun) for sun in lighting.suns if sun.angular_diameter <= NARROW]
        spread = bool(wide) or any(sky.image.any() for sky in lighting.skies)
        self._sampler = LightSampler(Lighting(lighting.skies, wide)) if spread else None

    def radiance(
        self, faces: NDArray[np.int64], barycentric: Array, outgoing: Array, keys: NDArray[np.uint64], seed: int
    ) -> tuple[Array, int]:
        """As `ObjectTracer.radiance`; samples are evaluations of the network."""
        total, evaluations = np.zeros((len(faces), 3)), 0
        positions, normals = self._places(faces, barycentric), self._mesh.face_normals[faces]
        for point in range(self.points):
            chosen = np.flatnonzero(keys % np.uint64(self.points) == point)
            if not len(chosen):
                continue
            where = positions[chosen], outgoing[chosen]
            directions, weights = self._incident(point, *where, normals[chosen], keys[chosen], seed)
            answers = self._transport.evaluate_pairs(directions, *where)
            total[chosen] = np.einsum("nsc,nsc->nc", np.asarray(answers, np.float64), weights)
            evaluations += answers.shape[0] * answers.shape[1]
        return total, evaluations

    def _incident(
        self, point: int, positions: Array, outgoing: Array, normals: Array, keys: NDArray[np.uint64], seed: int
    ) -> tuple[Array, Array]:
        """Directions [N,S,3] and radiance over density [N,S,3]."""
        directions, weights = [np.empty((len(keys), 0, 3))], [np.empty((len(keys), 0, 3))]
        if self._sampler is not None:
            lobe = None
            if self.counts.lobe[point]:
                assert self._lobes is not None
                lobe = self._lobes.lobe(positions, outgoing, normals)
            drawn = draw(self._sampler, lobe, self.counts, point, keys, seed)
            directions.append(drawn.directions)
            weights.append(drawn.weights)
        for i, disc in enumerate(self._narrow):
            towards, irradiance = disc.draw(uniforms((_DISC_STREAM, seed, i, keys), 2))
            directions.append(towards[:, None])
            weights.append(irradiance[:, None])
        return np.concatenate(directions, axis=1), np.concatenate(weights, axis=1)

    def _places(self, faces: NDArray[np.int64], barycentric: Array) -> Array:
        corners = self._mesh.positions[self._mesh.faces[faces]]
        weights = np.concatenate([1.0 - barycentric.sum(axis=1, keepdims=True), barycentric], axis=1)
        return np.asarray(np.einsum("nk,nkc->nc", weights, corners))
