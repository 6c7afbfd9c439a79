"""What a baked object's surface reflects, without noise: skies, directional lights, and the object itself once.

The microsurface is that of walks (`prt_bake.reflection.microfacet`). Each point sends a few rays from facets of a fixed
pattern, the points of a pixel different ones of one lattice, and a ray sees the sky averaged over the share of the lobe
that it stands for (Křivánek and Colbert 2008, "Real-time shading with filtered importance sampling"). Where it meets
the object again it sees the radiance that the asset sends along it: one bounce. What such a place reflects itself is
left out. Directional lights, and the suns of skies, are connected to, as `prt_bake.reflection.reflector` does it; wide
ones at points of the lattice.
"""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from formats.asset import Asset
from formats.errors import QueryError
from formats.scene.lights import DirectionalLight
from prt_bake.geometry.camera import Visibility
from prt_bake.lights import prefiltered
from prt_bake.lights.emitters import frame_across
from prt_bake.lights.lighting import Lighting
from prt_bake.lights.skies.prefiltered import prefilter
from prt_bake.lights.suns import split_lighting
from prt_bake.mathematics.sphere import to_world
from prt_bake.reflection.finish import interface_alpha, interface_normals
from prt_bake.reflection.microfacet import mirrored, reflection_density, visible_facets
from prt_bake.reflection.reflector import Reflector
from prt_bake.reflection.surface import SMOOTHEST, Points, ReflectingSurface
from prt_bake.shading.vertices import surface_radiance

Array = NDArray[np.float64]

RAYS_A_PIXEL = 32
"""Of a rough surface, over all points of a pixel."""
_FILTER = 1.5
"""Solid angle that a ray stands for, over its share of the lobe."""
_OF_HALVES = 0.25
"""What a lattice is off, over the difference of its halves: they are off by more than twice as much as the whole."""
_GOLDEN = 0.5 * (math.sqrt(5.0) - 1.0)
_SMALL_DISC = 0.1
"""Radius of a disc over the width of the lobe, alpha."""
_IN_MEMORY = 2 << 30


class _Finish(NamedTuple):
    """GGX alpha, one or a texture [H,W], the least of it, and whether the interface has interpolated normals."""

    alpha: Array
    least: float
    interpolated: bool


class SurfaceGloss:
    """An asset under a lighting, ready to be asked what its surface reflects."""

    def __init__(
        self,
        asset: Asset,
        lighting: Lighting,
        weights: Array,
        visibility: Visibility,
        points: int,
        roughness: float | Array | None = None,
    ) -> None:
        """Prepare for `points` points a pixel; weights: the light's coefficients as `light_of` has them.

        roughness: the GGX alpha in place of the asset's, one or a texture [H,W]. Raises QueryError where neither says
        it, and for a texture on a mesh without texture coordinates.
        """
        self._finish = _finish_of(asset, roughness)
        self._asset, self._weights, self._visibility = _in_memory(asset), weights, visibility
        self._surface = ReflectingSurface(asset.mesh, asset.eta)
        self._mirror = float(self._finish.alpha.max()) < SMOOTHEST
        self._rays = 1 if self._mirror else max(2, math.ceil(RAYS_A_PIXEL / points))
        self._points = points
        self._lighting = lighting
        # A mirror sees skies and discs where it looks.
        apart = lighting if self._mirror else split_lighting(lighting)
        skies, suns = ((), ()) if self._mirror else (apart.skies, _as_points(apart.suns, self._finish.least))
        self._skies = [prefilter(sky, self._finest()) for sky in skies if sky.image.any()]
        self._suns = tuple(sun for sun in suns if sun.irradiance.any())
        self._connected = Reflector(asset.mesh, Lighting((), self._suns), asset.eta, visibility) if self._suns else None

    def radiance(
        self, faces: NDArray[np.int64], barycentric: Array, outgoing: Array, keys: NDArray[np.int64]
    ) -> tuple[Array, Array]:
        """Radiance [N,3] reflected at (u, v) [N,2] of faces [N] towards `outgoing` [N,3], and a share of what one half
        of the rays finds more than the other [N,3]: averaged over a pixel's points, its size is one sigma to two.

        keys [N]: pixel · points + point of the pixel.
        """
        halves = np.zeros((2, len(faces), 3))
        normals = interface_normals(
            self._asset.mesh, faces, barycentric, "vertex" if self._finish.interpolated else "face"
        )
        alpha = interface_alpha(self._asset.mesh, faces, barycentric, self._finish.alpha)
        if not self._mirror:
            alpha = np.maximum(alpha, SMOOTHEST)
        points = self._surface.points(faces, normals, outgoing, alpha)
        starts = self._surface.starts(faces[points.rows], barycentric[points.rows])
        for ray in range(self._rays):
            numbers = _lattice(self._points * ray + keys[points.rows] % self._points, self._points * self._rays)
            halves[ray % 2, points.rows] += self._along_one_ray(points, starts, numbers)
        if self._rays == 1:
            halves[1] = halves[0]
        else:
            halves /= np.array([(self._rays + 1) // 2, self._rays // 2])[:, None, None]
        of_suns = self._of_suns(faces, barycentric, normals, outgoing, alpha, keys)
        differing = _OF_HALVES * (halves[0] - halves[1]) + 0.5 * (of_suns[0] - of_suns[1])
        return halves.mean(axis=0) + of_suns.mean(axis=0), differing

    def _finest(self) -> float:
        """The least solid angle that a ray stands for: of the facet's own normal, seen from straight above."""
        return 4.0 * math.pi * self._finish.least**2 * _FILTER / (self._rays * self._points)

    def _along_one_ray(self, points: Points, starts: Array, numbers: Array) -> Array:
        """What one facet of each point reflects [P,3], drawn by numbers [P,2]."""
        facets = np.zeros_like(points.towards)
        facets[:, 2] = 1.0
        if not self._mirror:
            facets = visible_facets(points.towards, points.alpha, numbers)
        local = mirrored(points.towards, facets)
        directions = to_world(local, points.normals, points.tangents)
        share = self._surface.share(points, facets, local, directions)
        sent = np.zeros((len(share), 3))
        lit = np.flatnonzero(share > 0.0)
        if not len(lit):
            return sent
        hits = self._visibility.first_hits(starts[lit], directions[lit])
        free, met = hits.faces < 0, hits.faces >= 0
        open_sky = lit[free]
        sent[open_sky] = self._sky(
            Points._make(part[open_sky] for part in points), facets[open_sky], directions[open_sky]
        )
        if met.any():
            sent[lit[met]] = surface_radiance(
                self._asset, self._weights, hits.faces[met], hits.barycentric[met], -directions[lit[met]]
            )
        return np.asarray(share[:, None] * sent)

    def _sky(self, points: Points, facets: Array, directions: Array) -> Array:
        if self._mirror:
            return self._lighting.radiance(directions)
        density = reflection_density(points.towards, facets, points.alpha)
        solid_angles = _FILTER / (self._rays * self._points * density)
        total = np.zeros(directions.shape)
        for sky in self._skies:
            total += prefiltered.radiance(sky, directions, solid_angles)
        return total

    def _of_suns(
        self,
        faces: NDArray[np.int64],
        barycentric: Array,
        normals: Array,
        outgoing: Array,
        alpha: Array,
        keys: NDArray[np.int64],
    ) -> Array:
        """By one half of the lattice and by the other [2,N,3], equal where suns have no size."""
        halves = np.zeros((2, len(faces), 3))
        if self._connected is None:
            return halves
        wide = any(sun.angular_diameter > 0.0 for sun in self._suns)
        rounds = 2 * math.ceil(self._rays / 2) if wide else 1
        for number in range(rounds):

            def drawn(points: Points, light: int | None, number: int = number) -> Array:
                return self._numbers(points, light, self._points * number + keys[points.rows] % self._points, rounds)

            halves[number % 2] += self._connected.sampled(faces, barycentric, normals, outgoing, alpha, drawn)
        if rounds == 1:
            halves[1] = halves[0]
            return halves
        return 2.0 / rounds * halves

    def _numbers(self, points: Points, light: int | None, which: NDArray[np.int64], rounds: int) -> Array:
        """Points `which` of a lattice, over the facets of points or the disc of a light."""
        numbers = _lattice(which, self._points * rounds)
        if light is None:
            return numbers
        # From where the normal leans to: turning object and light together changes nothing.
        across, other = frame_across(self._suns[light].direction)
        numbers[:, 1] += np.arctan2(points.normals @ other, points.normals @ across) / (2.0 * math.pi)
        return numbers


def _as_points(suns: tuple[DirectionalLight, ...], alpha: float) -> tuple[DirectionalLight, ...]:
    """Suns, those without a size whose discs are small beside the lobe: they are then exact to second order of that."""
    most = math.degrees(2.0 * _SMALL_DISC * alpha)
    return tuple(replace(sun, angular_diameter=0.0) if sun.angular_diameter <= most else sun for sun in suns)


def reflects(asset: Asset) -> bool:
    """Whether the surface of an asset reflects anything: its index differs from 1."""
    return not ReflectingSurface(asset.mesh, asset.eta).matched


def _finish_of(asset: Asset, roughness: float | Array | None) -> _Finish:
    said = asset.roughness if roughness is None else roughness
    if said is None:
        raise QueryError("reflection: the asset does not say how rough its surface is; give the roughness (GGX alpha)")
    alpha = np.asarray(said, np.float64)
    if alpha.ndim not in (0, 2) or not alpha.size:
        raise QueryError(f"reflection: a roughness of shape {list(alpha.shape)} where a number or [H, W] is expected")
    unfit = ~((alpha >= 0.0) & (alpha <= 1.0))
    if unfit.any():
        raise QueryError(f"reflection: a roughness of {alpha[unfit][0]:g} where a GGX alpha from 0 to 1 is expected")
    if alpha.ndim == 2 and asset.mesh.corner_uv is None:
        raise QueryError(
            "reflection: roughness is a texture, and the asset's mesh has no texture coordinates; give one number"
        )
    interpolated = asset.provenance.get("model", {}).get("normals") == "vertex"
    return _Finish(alpha, max(float(alpha.min()), SMOOTHEST), interpolated)


def _in_memory(asset: Asset) -> Asset:
    """Reflected rays meet vertices everywhere, time and again: coefficients of moderate size are read once."""
    stored = asset.coefficients
    if not hasattr(stored, "file") or math.prod(stored.shape) * stored.dtype.itemsize > _IN_MEMORY:
        return asset
    return replace(asset, coefficients=stored[:])


def _lattice(numbers: NDArray[np.int64], count: int) -> Array:
    """Of `count` points of a Fibonacci lattice in the unit square those with `numbers` [N], [N,2]."""
    return np.stack([(numbers + 0.5) / count, (numbers * _GOLDEN) % 1.0], axis=1)
