"""Light reflected at the surface, which is not part of Ŝ: the first event at x, seen from the eye, is a reflection.

The microsurface (`prt_bake.reflection.microfacet`) reflects light once. Light that a second facet would reflect is
lost; `energy_compensation` sends it inwards. Light that reaches x from the object itself counts as black: paths that
begin with a reflection at x and meet the object again are neither here nor in Ŝ.

Each sample draws one visible facet and one direction of each light, and combines the two for each light by multiple
importance sampling with the balance heuristic (Veach and Guibas 1995). The variance is bounded for sharp lobes under
wide skies and for wide lobes under small suns.
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
from prt_bake.reflection.finish import SurfacePoints
from prt_bake.reflection.lights import LightSource, light_sources
from prt_bake.reflection.microfacet import half_vectors, mirrored, reflection_density, visible_facets
from prt_bake.reflection.surface import SMOOTHEST, FrontPoints, ReflectingSurface

Array = NDArray[np.float64]

_FACET_STREAM, _LIGHT_STREAM = 0xA0, 0xA1

Numbers = Callable[[FrontPoints, int | None], Array]
"""Numbers in [0, 1) for N points: [N,2] for facets (None), [N,3] for the light of an index."""


class _Arrivals(NamedTuple):
    """Light from `directions` [M,3] at the points `rows` [M], if unoccluded: its reflected radiance [M,3]."""

    rows: NDArray[np.int64]
    directions: Array
    radiance: Array


class Reflector:
    """Estimates the light that the surface of an object reflects under a lighting."""

    def __init__(self, mesh: Mesh, lighting: Lighting, eta: float, visibility: Visibility | None = None) -> None:
        """Prepare an object of index `eta` in a world of index 1; `visibility` of the mesh is built unless given.

        Raises QueryError for an index that is not positive.
        """
        self._surface = ReflectingSurface(mesh, eta)
        if not self._surface.matched:
            self._lights = light_sources(lighting)
            self._visibility = visibility or Visibility(mesh)

    def reflected(self, points: SurfacePoints, keys: NDArray[np.uint64], seed: int) -> Array:
        """One unbiased sample of the radiance [N,3] reflected at each point towards its `outgoing`.

        It is as `sampled` computes it, and depends on the keys [N] and the seed alone.
        """

        def numbers(front: FrontPoints, light: int | None) -> Array:
            front_keys = keys[front.rows]
            if light is None:
                return uniforms((_FACET_STREAM, seed, front_keys), 2)
            return uniforms((_LIGHT_STREAM, seed, light, front_keys), 3)

        return self.sampled(points, numbers)

    def sampled(self, points: SurfacePoints, numbers: Numbers) -> Array:
        """Radiance [N,3] reflected at points towards their `outgoing`, by one facet and one direction of each light.

        `numbers` gives the random or quasi-random numbers. A face normal replaces an interface normal that faces away
        from the eye, as in walks. Directional lights without size are exact, and a mirror does not show them. An eye
        below a face sees black.
        """
        total = np.zeros((len(points.faces), 3))
        if self._surface.matched or not len(points.faces) or not self._lights:
            return total
        front = self._surface.front_points(points)
        arrivals = [self._by_facets(front, numbers(front, None))]
        rough = front.alpha >= SMOOTHEST
        if rough.any():
            front = front.subset(rough)
            for i, light in enumerate(self._lights):
                arrivals.append(self._by_light(front, light, numbers(front, i)))
        for arriving in arrivals:
            visible = self._visible(points, arriving)
            total[arriving.rows[visible]] += arriving.radiance[visible]
        return total

    def _by_facets(self, points: FrontPoints, numbers: Array) -> _Arrivals:
        """Light reflected by one visible facet of each point, sampled by numbers [N,2]."""
        rough = points.alpha >= SMOOTHEST
        facets = np.zeros_like(points.towards)
        facets[:, 2] = 1.0
        facets[rough] = visible_facets(points.towards[rough], points.alpha[rough], numbers[rough])
        local = mirrored(points.towards, facets)
        directions = to_world(local, points.normals, points.tangents)
        reflectance = self._surface.reflectance(points, facets, local, directions)
        density = reflection_density(points.towards, facets, np.maximum(points.alpha, SMOOTHEST))
        density[~rough] = math.inf
        chosen = np.flatnonzero(reflectance > 0.0)
        directions, density = directions[chosen], density[chosen]
        light = np.zeros((len(chosen), 3))
        for source in self._lights:
            radiance, light_density = source.evaluate(directions)
            light += radiance / (1.0 + light_density / density)[:, None]
        return _Arrivals(points.rows[chosen], directions, reflectance[chosen, None] * light)

    def _by_light(self, points: FrontPoints, light: LightSource, numbers: Array) -> _Arrivals:
        """Light reflected at each point from one direction of a light, sampled by numbers [N,3]."""
        directions, weight, density = light.draw(numbers)
        local = to_local(directions, points.normals, points.tangents)
        facets = half_vectors(points.towards, local)
        reflectance = self._surface.reflectance(points, facets, local, directions)
        chosen = np.flatnonzero((reflectance > 0.0) & (density > 0.0))
        facet_density = reflection_density(points.towards[chosen], facets[chosen], points.alpha[chosen])
        factor = reflectance[chosen] * facet_density / (1.0 + facet_density / density[chosen])
        return _Arrivals(points.rows[chosen], directions[chosen], factor[:, None] * weight[chosen])

    def _visible(self, points: SurfacePoints, arriving: _Arrivals) -> NDArray[np.int64]:
        """Indices of the arrivals that are not black and not occluded."""
        nonzero = np.flatnonzero(arriving.radiance.any(axis=1))
        rows = arriving.rows[nonzero]
        origins = self._surface.ray_origins(points.faces[rows], points.barycentric[rows])
        return nonzero[self._visibility.first_hits(origins, arriving.directions[nonzero]).faces < 0]
