"""The path tracer that a report compares a network with."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from formats.scene import Scene
from prt_bake.tracer.estimate import estimate_coefficients, estimate_transport

Array = NDArray[np.float64]


class Tracer(Protocol):
    """Unbiased noisy estimates of the truth; calls with different seeds are independent."""

    def transport(self, positions: Array, outgoing: Array, incident: Array, paths: int, seed: int) -> Array:
        """Ŝ [N,D,3] towards incident [N,D,3]."""

    def coefficients(self, positions: Array, outgoing: Array, paths: int, seed: int) -> Array:
        """Degree-2 a_lm [N,9,3]."""


@dataclass(frozen=True)
class PathTracer:
    """The path tracer as a `Tracer`; `connections` is the number of directions that each event connects to."""

    scene: Scene
    connections: int

    def transport(self, positions: Array, outgoing: Array, incident: Array, paths: int, seed: int) -> Array:
        """Ŝ [N,D,3] by `estimate_transport`."""
        return estimate_transport(
            self.scene, positions, outgoing, incident, paths, seed, connections=self.connections
        ).mean

    def coefficients(self, positions: Array, outgoing: Array, paths: int, seed: int) -> Array:
        """Degree-2 a_lm [N,9,3] by `estimate_coefficients`."""
        return estimate_coefficients(self.scene, positions, outgoing, 2, paths, seed).mean
