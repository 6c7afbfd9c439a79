"""Light reflected at the surface of a baked object, without noise: skies, directional lights, and the object itself.

The microsurface is that of walks (`prt_bake.reflection.microfacet`). Each point traces a few rays from facets given by
a lattice, which the points of a pixel share. A ray looks up the sky averaged over its share of the lobe (Křivánek and
Colbert 2008, "Real-time shading with filtered importance sampling"). A ray that hits the object gets the asset's
radiance along it: one bounce, without the light that the hit point reflects. Directional lights and the suns of skies
are sampled by `prt_bake.reflection.reflector`, wide ones at points of the lattice.
"""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from formats.asset import Asset
from formats.errors import QueryError
from formats.mesh import texture_fault
from formats.scene.lights import DirectionalLight
from prt_bake.geometry.camera import Visibility
from prt_bake.lights.emitters import frame_across
from prt_bake.lights.lighting import Lighting
from prt_bake.lights.skies import prefiltered
from prt_bake.lights.sun_detection import split_lighting
from prt_bake.mathematics.sphere import to_world
from prt_bake.reflection.finish import Normals, SurfacePoints, chosen_normals, surface_points
from prt_bake.reflection.microfacet import mirrored, reflection_density, visible_facets
from prt_bake.reflection.reflector import Reflector
from prt_bake.reflection.surface import SMOOTHEST, FrontPoints, ReflectingSurface
from prt_bake.shading.vertices import surface_radiance
from prt_bake.shading.visible_points import VisiblePoints

Array = NDArray[np.float64]

RAYS_A_PIXEL = 32
"""Rays of a rough surface, over all points of a pixel."""
_FILTER = 1.5
"""Solid angle of a look-up over the ray's share of the lobe."""
_HALF_BUFFERS = 0.25
"""Error of a lattice over the difference of its half buffers, whose error is more than twice that of the lattice."""
_GOLDEN = 0.5 * (math.sqrt(5.0) - 1.0)
_SMALL_DISC = 0.1
"""Radius of a disc over the width of the lobe, alpha, up to which the disc becomes a point."""
_MAX_BYTES = 2 << 30


class _Finish(NamedTuple):
    """GGX alpha (a number or a texture [H,W]), its minimum, and the kind of the interface's normals."""

    alpha: Array
    min_alpha: float
    normals: Normals


class AssetReflection:
    """Computes the light that the surface of an asset reflects under a lighting."""

    def __init__(
        self,
        asset: Asset,
        lighting: Lighting,
        weights: Array,
        visibility: Visibility,
        points: int,
        roughness: float | Array | None = None,
        normals: Normals | None = None,
    ) -> None:
        """Prepare `points` points a pixel; weights: from `vertices.light_coefficients`.

        roughness: GGX alpha in place of the asset's, a number or a texture [H,W]. normals: "vertex" or "face"; by
        default as `chosen_normals`. Raises QueryError if no roughness is known, and for a texture on a mesh
        without texture coordinates.
        """
        self._finish = _finish_of(asset, roughness, normals)
        self._asset, self._weights, self._visibility = _in_memory(asset), weights, visibility
        self._surface = ReflectingSurface(asset.mesh, asset.eta)
        self._mirror = float(self._finish.alpha.max()) < SMOOTHEST
        self._rays = 1 if self._mirror else max(2, math.ceil(RAYS_A_PIXEL / points))
        self._points = points
        self._lighting = lighting
        # A mirror looks up skies and discs directly.
        split = lighting if self._mirror else split_lighting(lighting)
        skies, suns = ((), ()) if self._mirror else (split.skies, _as_points(split.suns, self._finish.min_alpha))
        finest = self._min_solid_angle()
        self._skies = [prefiltered.prefilter(sky.image, sky.to_object, finest) for sky in skies if sky.image.any()]
        self._suns = tuple(sun for sun in suns if sun.irradiance.any())
        self._connected = Reflector(asset.mesh, Lighting((), self._suns), asset.eta, visibility) if self._suns else None

    def radiance(self, visible: VisiblePoints) -> tuple[Array, Array]:
        """Radiance [N,3] reflected at the visible points towards the eye, and an error estimate [N,3].

        The error estimate is a scaled difference of two half buffers of the rays. Averaged over the points of a pixel,
        its size is one to two standard errors.
        """
        half_buffers = np.zeros((2, len(visible.faces), 3))
        points = surface_points(
            self._asset.mesh,
            visible.faces,
            visible.barycentric,
            visible.outgoing,
            self._finish.normals,
            self._finish.alpha,
        )
        if not self._mirror:
            points = points._replace(alpha=np.maximum(points.alpha, SMOOTHEST))
        front = self._surface.front_points(points)
        origins = self._surface.ray_origins(points.faces[front.rows], points.barycentric[front.rows])
        for ray in range(self._rays):
            numbers = _lattice(self._points * ray + visible.samples[front.rows], self._points * self._rays)
            half_buffers[ray % 2, front.rows] += self._trace(front, origins, numbers)
        if self._rays == 1:
            half_buffers[1] = half_buffers[0]
        else:
            half_buffers /= np.array([(self._rays + 1) // 2, self._rays // 2])[:, None, None]
        suns = self._sun_half_buffers(points, visible.samples)
        difference = _HALF_BUFFERS * (half_buffers[0] - half_buffers[1]) + 0.5 * (suns[0] - suns[1])
        return half_buffers.mean(axis=0) + suns.mean(axis=0), difference

    def _min_solid_angle(self) -> float:
        """The least solid angle of a ray: that of a facet along the normal, seen along the normal."""
        return 4.0 * math.pi * self._finish.min_alpha**2 * _FILTER / (self._rays * self._points)

    def _trace(self, points: FrontPoints, origins: Array, numbers: Array) -> Array:
        """Radiance [P,3] reflected by one facet of each point, sampled by numbers [P,2]."""
        facets = np.zeros_like(points.towards)
        facets[:, 2] = 1.0
        if not self._mirror:
            facets = visible_facets(points.towards, points.alpha, numbers)
        local = mirrored(points.towards, facets)
        directions = to_world(local, points.normals, points.tangents)
        reflectance = self._surface.reflectance(points, facets, local, directions)
        incident = np.zeros((len(reflectance), 3))
        traced = np.flatnonzero(reflectance > 0.0)
        if not len(traced):
            return incident
        hits = self._visibility.first_hits(origins[traced], directions[traced])
        met, unoccluded = hits.faces >= 0, traced[hits.faces < 0]
        incident[unoccluded] = self._sky(points.subset(unoccluded), facets[unoccluded], directions[unoccluded])
        if met.any():
            incident[traced[met]] = surface_radiance(
                self._asset, self._weights, hits.faces[met], hits.barycentric[met], -directions[traced[met]]
            )
        return np.asarray(reflectance[:, None] * incident)

    def _sky(self, points: FrontPoints, facets: Array, directions: Array) -> Array:
        if self._mirror:
            return self._lighting.radiance(directions)
        density = reflection_density(points.towards, facets, points.alpha)
        solid_angles = _FILTER / (self._rays * self._points * density)
        total = np.zeros(directions.shape)
        for sky in self._skies:
            total += prefiltered.radiance(sky, directions, solid_angles)
        return total

    def _sun_half_buffers(self, points: SurfacePoints, samples: NDArray[np.int64]) -> Array:
        """Reflected light of the suns in half buffers [2,N,3], which are equal for suns without size."""
        half_buffers = np.zeros((2, len(points.faces), 3))
        if self._connected is None:
            return half_buffers
        wide = any(sun.angular_diameter > 0.0 for sun in self._suns)
        rounds = 2 * math.ceil(self._rays / 2) if wide else 1
        for number in range(rounds):

            def numbers(front: FrontPoints, light: int | None, number: int = number) -> Array:
                return self._lattice_numbers(front, light, self._points * number + samples[front.rows], rounds)

            half_buffers[number % 2] += self._connected.sampled(points, numbers)
        if rounds == 1:
            half_buffers[1] = half_buffers[0]
            return half_buffers
        return 2.0 / rounds * half_buffers

    def _lattice_numbers(
        self, points: FrontPoints, light: int | None, members: NDArray[np.int64], rounds: int
    ) -> Array:
        """Lattice points with the numbers `members`, for facets or for the disc of a light."""
        numbers = _lattice(members, self._points * rounds)
        if light is None:
            return numbers
        # Relative to the azimuth of the normal: rotating object and light together changes nothing.
        across, other = frame_across(self._suns[light].direction)
        numbers[:, 1] += np.arctan2(points.normals @ other, points.normals @ across) / (2.0 * math.pi)
        return numbers


def _as_points(suns: tuple[DirectionalLight, ...], alpha: float) -> tuple[DirectionalLight, ...]:
    """The suns, without size if their disc is much smaller than the lobe; the error is of second order in the ratio."""
    limit = math.degrees(2.0 * _SMALL_DISC * alpha)
    return tuple(replace(sun, angular_diameter=0.0) if sun.angular_diameter <= limit else sun for sun in suns)


def reflects(asset: Asset) -> bool:
    """Whether the surface of an asset reflects light: its index differs from 1."""
    return not ReflectingSurface(asset.mesh, asset.eta).matched


def _finish_of(asset: Asset, roughness: float | Array | None, normals: Normals | None) -> _Finish:
    given = asset.roughness if roughness is None else roughness
    if given is None:
        raise QueryError("reflection: the asset has no roughness; give the roughness (GGX alpha)")
    alpha = np.asarray(given, np.float64)
    if alpha.ndim not in (0, 2) or not alpha.size:
        raise QueryError(f"reflection: expected a roughness that is a number or [H, W], found {list(alpha.shape)}")
    invalid = ~((alpha >= 0.0) & (alpha <= 1.0))
    if invalid.any():
        raise QueryError(f"reflection: expected a GGX alpha from 0 to 1, found {alpha[invalid][0]:g}")
    if alpha.ndim == 2 and asset.mesh.corner_uv is None:
        raise QueryError(
            "reflection: roughness is a texture, and the asset's mesh has no texture coordinates; give one number"
        )
    if alpha.ndim == 2 and (fault := texture_fault(asset.mesh)):
        raise QueryError(f"reflection: roughness is a texture, but {fault}, or give one number")
    return _Finish(alpha, max(float(alpha.min()), SMOOTHEST), chosen_normals(asset.mesh, normals))


def _in_memory(asset: Asset) -> Asset:
    """Read coefficients of moderate size once, since reflected rays hit vertices everywhere."""
    stored = asset.coefficients
    if not hasattr(stored, "file") or math.prod(stored.shape) * stored.dtype.itemsize > _MAX_BYTES:
        return asset
    return replace(asset, coefficients=stored[:])


def _lattice(numbers: NDArray[np.int64], count: int) -> Array:
    """The points `numbers` [N] of a Fibonacci lattice of `count` points in the unit square [N,2]."""
    return np.stack([(numbers + 0.5) / count, (numbers * _GOLDEN) % 1.0], axis=1)
