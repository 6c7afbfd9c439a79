"""Light reflected at the surface itself, which Ŝ leaves out: the first event at x, seen from the eye, is a reflection.

It is reflected by the microsurface that walks are let in through (`prt_bake.reflection.microfacet`), once: what a
second facet would reflect is lost, with `energy_compensation` too, which sends that light inwards. Light that comes to
x off the object itself counts as black: paths that begin with a reflection at x and meet the object again are neither
here nor, by its definition, in Ŝ.

One sample looks where a visible facet reflects the eye's ray to, and once towards each light, and combines the two ways
for each light by the balance heuristic (Veach and Guibas 1995): both bounds hold, for the sharpest lobe under a wide
sky as for the widest lobe under the smallest sun.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from formats.mesh import Mesh
from prt_bake.geometry.camera import Visibility
from prt_bake.lights.lighting import Lighting
from prt_bake.mathematics.random import uniforms
from prt_bake.mathematics.sphere import to_local, to_world
from prt_bake.reflection.lights import LightSource, light_sources
from prt_bake.reflection.microfacet import half_vectors, mirrored, reflection_density, visible_facets
from prt_bake.reflection.surface import SMOOTHEST, Points, ReflectingSurface

Array = NDArray[np.float64]

_FACET_STREAM, _LIGHT_STREAM = 0xA0, 0xA1

Numbers = Callable[[Points, int | None], Array]
"""Numbers from 0 to 1 for points: [N,2] for their facets (None), [N,3] for the light of that number."""


class _Arrivals(NamedTuple):
    """Light that comes along `directions` [M,3] to the points `rows` [M], if nothing is in its way: the radiance [M,3]
    that it adds to what is reflected.
    """

    rows: NDArray[np.int64]
    directions: Array
    radiance: Array


class Reflector:
    """The surface of an object under a lighting, ready to be asked what it reflects."""

    def __init__(self, mesh: Mesh, lighting: Lighting, eta: float, visibility: Visibility | None = None) -> None:
        """Build for an object of index `eta` in a world of index 1; `visibility` is the mesh's, where there is one.

        Raises QueryError for an index that is not above 0.
        """
        self._surface = ReflectingSurface(mesh, eta)
        if not self._surface.matched:
            self._lights = light_sources(lighting)
            self._visibility = visibility or Visibility(mesh)

    def reflected(
        self,
        faces: NDArray[np.int64],
        barycentric: Array,
        normals: Array,
        outgoing: Array,
        alpha: Array,
        keys: NDArray[np.uint64],
        seed: int,
    ) -> Array:
        """Radiance [N,3] reflected at points of the surface towards `outgoing` [N,3]: one unbiased sample of each, as
        `sampled`; it depends on the keys [N] and the seed alone.
        """

        def drawn(points: Points, light: int | None) -> Array:
            keyed = keys[points.rows]
            if light is None:
                return uniforms((_FACET_STREAM, seed, keyed), 2)
            return uniforms((_LIGHT_STREAM, seed, light, keyed), 3)

        return self.sampled(faces, barycentric, normals, outgoing, alpha, drawn)

    def sampled(
        self,
        faces: NDArray[np.int64],
        barycentric: Array,
        normals: Array,
        outgoing: Array,
        alpha: Array,
        drawn: Numbers,
    ) -> Array:
        """Radiance [N,3] reflected at points of the surface towards `outgoing` [N,3], one facet and one direction of
        each light a point, at numbers from 0 to 1 that `drawn` says.

        faces [N] and barycentric (u, v) [N,2] say where, normals [N,3] are those of the interface (where one faces away
        from `outgoing` the face's own is taken, as walks do), alpha [N] is its GGX roughness. Directional lights
        without size are exact, and a mirror does not show them. An eye below its face sees nothing reflected.
        """
        total = np.zeros((len(faces), 3))
        if self._surface.matched or not len(faces) or not self._lights:
            return total
        points = self._surface.points(faces, normals, outgoing, np.asarray(alpha, np.float64))
        arrivals = [self._by_facets(points, drawn(points, None))]
        rough = points.alpha >= SMOOTHEST
        if rough.any():
            points = Points._make(part[rough] for part in points)
            for i, light in enumerate(self._lights):
                arrivals.append(self._by_light(points, light, drawn(points, i)))
        for arriving in arrivals:
            free = self._reaches(faces, barycentric, arriving)
            total[arriving.rows[free]] += arriving.radiance[free]
        return total

    def _by_facets(self, points: Points, numbers: Array) -> _Arrivals:
        """What a visible facet of each point reflects, drawn by numbers [N,2]."""
        rough = points.alpha >= SMOOTHEST
        facets = np.zeros_like(points.towards)
        facets[:, 2] = 1.0
        facets[rough] = visible_facets(points.towards[rough], points.alpha[rough], numbers[rough])
        local = mirrored(points.towards, facets)
        directions = to_world(local, points.normals, points.tangents)
        share = self._surface.share(points, facets, local, directions)
        density = reflection_density(points.towards, facets, np.maximum(points.alpha, SMOOTHEST))
        density[~rough] = math.inf
        chosen = np.flatnonzero(share > 0.0)
        directions, density = directions[chosen], density[chosen]
        light = np.zeros((len(chosen), 3))
        for source in self._lights:
            radiance, other = source.seen(directions)
            light += radiance / (1.0 + other / density)[:, None]
        return _Arrivals(points.rows[chosen], directions, share[chosen, None] * light)

    def _by_light(self, points: Points, light: LightSource, numbers: Array) -> _Arrivals:
        """What each point reflects of one direction of a light, drawn by numbers [N,3]."""
        directions, weight, density = light.draw(numbers)
        local = to_local(directions, points.normals, points.tangents)
        facets = half_vectors(points.towards, local)
        share = self._surface.share(points, facets, local, directions)
        chosen = np.flatnonzero((share > 0.0) & (density > 0.0))
        by_facets = reflection_density(points.towards[chosen], facets[chosen], points.alpha[chosen])
        share = share[chosen] * by_facets / (1.0 + by_facets / density[chosen])
        return _Arrivals(points.rows[chosen], directions[chosen], share[:, None] * weight[chosen])

    def _reaches(self, faces: NDArray[np.int64], barycentric: Array, arriving: _Arrivals) -> NDArray[np.int64]:
        """Which of the arrivals carry light and pass the object."""
        lit = np.flatnonzero(arriving.radiance.any(axis=1))
        rows = arriving.rows[lit]
        starts = self._surface.starts(faces[rows], barycentric[rows])
        return lit[self._visibility.first_hits(starts, arriving.directions[lit]).faces < 0]
