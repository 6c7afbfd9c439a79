"""Suns met apart (`prt_bake.shading.suns`) at the vertices that an eye may see, some at a time between two events.

It takes 0.1 to 0.2 ms a vertex: too long for a frame, and short enough to wait for once the eye and the light stand
still.
"""

import math
import time
from collections.abc import Callable
from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from formats.asset import Asset
from formats.mesh import Mesh
from prt_bake.lights import environment
from prt_bake.shading.suns import SunsApart

Draw = Callable[[ArrayLike], NDArray[np.float32]]

_VERTICES_AT_ONCE = 128


class Refiner:
    """What one asset sends to one eye under one light, once it is settled."""

    def __init__(self, asset: Asset) -> None:
        self._asset = asset
        self._refinement: Refinement | None = None

    @cached_property
    def closed(self) -> bool:
        """Whether no face of the object is seen from behind but from inside."""
        return is_closed(self._asset.mesh)

    def forget(self) -> None:
        """Another light shines."""
        self._refinement = None

    def radiance(self, eye: ArrayLike) -> NDArray[np.float32] | None:
        """Radiance [V,3] to this eye, None where it is not settled."""
        settling = self._refinement
        return settling.radiance if settling is not None and settling.ready and settling.sees(eye) else None

    def refine(
        self, light: SunsApart, rotation: float, eye: ArrayLike, draw: Draw, seconds: float = math.inf
    ) -> NDArray[np.float32] | None:
        """`radiance` after about so many seconds more of work. light: before it is turned by `rotation` degrees. draw:
        gives the radiance to begin with. Raises QueryError for an eye on the object or inside it.
        """
        settling = self._refinement
        if settling is None or not settling.sees(eye):
            turned = _turned(light, rotation, self._asset.up)
            settling = Refinement(self._asset, turned, np.array(eye, np.float64), draw(eye), self.closed)
            self._refinement = settling
        settling.refine(seconds)
        return self.radiance(eye)


class Refinement:
    """Radiance [V,3] that `shade` gives for an eye, on its way; vertices that cannot be seen keep what they had.

    Attributes:
        eye: where it is seen from.
        radiance: as far as it has come.
    """

    def __init__(
        self, asset: Asset, light: SunsApart, eye: NDArray[np.float64], radiance: NDArray[np.float32], seen: bool
    ) -> None:
        """light: turned. radiance: what to start from. seen: only vertices that the eye may see, of a closed object."""
        from prt_bake.shading.vertices import between_bins

        self.eye, self.radiance = eye, np.array(radiance)
        self._asset, self._light = asset, light
        may_be_seen = facing(asset.mesh, eye) if seen else np.ones(len(asset.valid), np.bool_)
        self._vertices = np.flatnonzero(asset.valid & may_be_seen)
        self._at = between_bins(asset, eye, self._vertices)
        self._next = 0

    @property
    def ready(self) -> bool:
        """Whether all vertices are there."""
        return self._next >= len(self._vertices)

    def sees(self, eye: ArrayLike) -> bool:
        """Whether it is for this eye."""
        return np.array_equal(self.eye, np.asarray(eye, np.float64))

    def refine(self, seconds: float = math.inf) -> None:
        """Work for about so long, or to the end."""
        end = time.monotonic() + seconds
        while not self.ready:
            self._meet(slice(self._next, self._next + _VERTICES_AT_ONCE))
            self._next += _VERTICES_AT_ONCE
            if time.monotonic() >= end:
                return

    def _meet(self, some: slice) -> None:
        from prt_bake.shading.reconstruction import reconstruct
        from prt_bake.shading.suns import sun_radiance

        vertices, at = self._vertices[some], type(self._at)._make(field[some] for field in self._at)
        asset = self._asset
        radiance = reconstruct(asset.coefficients, vertices, at, asset.sectors, self._light.harmonics)
        radiance += sun_radiance(asset, self._light.suns, vertices, at)
        self.radiance[vertices] = np.maximum(radiance, 0.0)


def _turned(light: SunsApart, rotation: float, up: str) -> SunsApart:
    turn = environment.rotation(rotation, up)
    suns = tuple(replace(sun, direction=turn @ sun.direction) for sun in light.suns)
    return replace(light, harmonics=environment.rotate_light(light.harmonics, rotation, up), suns=suns)


def is_closed(mesh: Mesh) -> bool:
    """Whether faces run along every edge as often one way as the other, and look outwards: then no face is seen from
    behind but from inside.
    """
    faces = mesh.faces.astype(np.int64)
    starts, ends = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    there, back = (np.sort(a * len(mesh.positions) + b) for a, b in ((starts, ends), (ends, starts)))
    if not np.array_equal(there, back):
        return False
    corners = mesh.positions[faces] - mesh.center
    return float(np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))) > 0.0


def facing(mesh: Mesh, eye: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Vertices [V] of the faces whose outer side the eye is on."""
    towards = np.einsum("fi,fi->f", mesh.face_normals, eye - mesh.positions[mesh.faces[:, 0]]) > 0.0
    seen = np.zeros(len(mesh.positions), np.bool_)
    seen[mesh.faces[towards]] = True
    return seen
