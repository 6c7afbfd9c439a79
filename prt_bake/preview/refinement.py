"""Progressive refinement: suns are shaded separately (`prt_bake.shading.sun_shading`) once the eye and the light rest.

This takes 0.1 to 0.2 ms per vertex, too long for a frame. The vertices that the eye may see are shaded in slices,
between the window's events.
"""

import math
import time
from collections.abc import Callable
from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from formats.asset import Asset
from formats.mesh import Mesh, signed_volume
from formats.mesh.edges import edges_of
from prt_bake.lights import environment
from prt_bake.shading.asset_light import AssetLight

Draw = Callable[[ArrayLike], NDArray[np.float32]]

_VERTICES_AT_ONCE = 128


class Refiner:
    """Refined radiance of one asset, for the latest eye and light."""

    def __init__(self, asset: Asset) -> None:
        self._asset = asset
        self._refinement: Refinement | None = None

    @cached_property
    def closed(self) -> bool:
        """Whether the mesh is closed, see `is_closed`."""
        return is_closed(self._asset.mesh)

    def reset(self) -> None:
        """Discard the refinement, since the light has changed."""
        self._refinement = None

    def radiance(self, eye: ArrayLike) -> NDArray[np.float32] | None:
        """Return the refined radiance [V,3] to this eye, or None if it is not finished."""
        refinement = self._refinement
        finished = refinement is not None and refinement.finished and refinement.is_for(eye)
        return refinement.radiance if refinement is not None and finished else None

    def refine(
        self, light: AssetLight, rotation: float, eye: ArrayLike, draw: Draw, seconds: float = math.inf
    ) -> NDArray[np.float32] | None:
        """Refine for about `seconds` and return `radiance(eye)`.

        Args:
            light: the light before its rotation.
            rotation: degrees.
            eye: [3], in object space.
            draw: returns the unrefined radiance [V,3] to an eye.
            seconds: time limit.

        Raises:
            QueryError: the eye is on the object or inside it.
        """
        refinement = self._refinement
        if refinement is None or not refinement.is_for(eye):
            rotated = _rotated(light, rotation, self._asset.up)
            refinement = Refinement(self._asset, rotated, np.array(eye, np.float64), draw(eye), self.closed)
            self._refinement = refinement
        refinement.refine(seconds)
        return self.radiance(eye)


class Refinement:
    """A refinement in progress for one eye and light; invisible vertices keep their unrefined radiance.

    Attributes:
        eye: [3], in object space.
        radiance: [V,3], refined so far.
    """

    def __init__(
        self, asset: Asset, light: AssetLight, eye: NDArray[np.float64], radiance: NDArray[np.float32], closed: bool
    ) -> None:
        """light: after its rotation. radiance: unrefined. closed: skip the vertices that face away from the eye."""
        from prt_bake.shading.vertices import eye_in_frames

        self.eye, self.radiance = eye, np.array(radiance)
        self._asset, self._light = asset, light
        visible = facing(asset.mesh, eye) if closed else np.ones(len(asset.valid), np.bool_)
        self._vertices = np.flatnonzero(asset.valid & visible)
        self._local = eye_in_frames(asset, eye, self._vertices)
        self._next = 0

    @property
    def finished(self) -> bool:
        """Whether all visible vertices are refined."""
        return self._next >= len(self._vertices)

    def is_for(self, eye: ArrayLike) -> bool:
        """Whether this is the refinement for `eye`."""
        return np.array_equal(self.eye, np.asarray(eye, np.float64))

    def refine(self, seconds: float = math.inf) -> None:
        """Refine more vertices for about `seconds`."""
        end = time.monotonic() + seconds
        while not self.finished:
            self._shade(slice(self._next, self._next + _VERTICES_AT_ONCE))
            self._next += _VERTICES_AT_ONCE
            if time.monotonic() >= end:
                return

    def _shade(self, rows: slice) -> None:
        from prt_bake.shading.vertices import radiance_towards

        vertices = self._vertices[rows]
        radiance, _ = radiance_towards(self._asset, self._light, vertices, self._local[rows])
        self.radiance[vertices] = np.maximum(radiance, 0.0)


def _rotated(light: AssetLight, rotation: float, up: str) -> AssetLight:
    matrix = environment.rotation(rotation, up)
    suns = tuple(replace(sun, direction=matrix @ sun.direction) for sun in light.suns)
    harmonics, whole = (environment.rotate_light(part, rotation, up) for part in (light.harmonics, light.whole))
    lobes = light.lobes and light.lobes.turned(matrix)
    return replace(light, harmonics=harmonics, suns=suns, whole=whole, lobes=lobes)


def is_closed(mesh: Mesh) -> bool:
    """Whether the mesh is closed, consistently oriented and outward: from outside, no face is seen from behind."""
    return edges_of(mesh.faces).closed and signed_volume(mesh) > 0.0


def facing(mesh: Mesh, eye: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return the mask [V] of vertices of faces that turn towards the eye."""
    front = np.einsum("fi,fi->f", mesh.face_normals, eye - mesh.positions[mesh.faces[:, 0]]) > 0.0
    mask = np.zeros(len(mesh.positions), np.bool_)
    mask[mesh.faces[front]] = True
    return mask
