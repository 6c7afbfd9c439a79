"""Error budget of a picture: the relative RMSE of the radiance that each approximation alone causes.

Errors are measured at random points of the object that a camera sees. The reference for most parts is the network,
evaluated towards the eye for every texel of the sky; the reference for the network is the path tracer.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bakers.evaluation import values_at
from bakers.horizon import clamp_to_horizon
from bakers.transport import transport_property
from formats.errors import QueryError
from formats.mesh import Mesh
from prt_bake.baking.job.views import horizons, views_of
from prt_bake.baking.report.bins import fitted, relative
from prt_bake.baking.report.reflected import noise_free_rms, reflected_at
from prt_bake.geometry import camera as cameras
from prt_bake.lights import environment
from prt_bake.mathematics import sh, sphere
from prt_bake.mathematics.random import uniforms
from prt_bake.reflection.surface import ReflectingSurface

Array = NDArray[np.float64]
Index = NDArray[np.int64]

TEXELS = 64, 128
"""Rows and columns of cells to which the sky is averaged for the network."""
EXACT, SAMPLES, WALKS = 1024, 64, 4096
"""Directions of reference coefficients, directions of a bake, and walks of a path-traced reference."""
TRIES = 16
"""Camera rays per requested point."""
_POINT_STREAM = 32


@dataclass(frozen=True)
class Part:
    """One source of error."""

    name: str
    radiance: float
    """Relative RMSE of the radiance in the picture."""
    how: str


@dataclass(frozen=True)
class VisiblePoints:
    """Points [N] of the object that an eye sees."""

    positions: Array
    corners: Index
    """Vertices [N,3] of the face."""
    shares: Array
    """Barycentric weights [N,3] of the vertices."""
    outgoing: Array
    faces: Index

    @property
    def barycentric(self) -> Array:
        """(u, v) [N,2] in the face."""
        return self.shares[:, 1:]


@dataclass(frozen=True)
class Texels:
    """A sky as directions [D,3] and weights, radiance · solid angle [D,3]."""

    directions: Array
    weights: Array

    def coefficients(self, degree: int) -> Array:
        """b_lm [K,3] of the sky."""
        return np.asarray(sh.evaluate(self.directions, degree).T @ self.weights)


def error_budget(
    network: Any,
    band_limited: Any,
    mesh: Mesh,
    sky: NDArray[np.float32],
    view: cameras.Camera,
    *,
    degree: int,
    rings: int,
    sectors: int,
    up: str,
    points: int,
    seed: int,
    walks: Callable[[Array, Array, int], tuple[Array, Array]] | None = None,
) -> list[Part]:
    """Parts of the error of the radiance at `points` points that `view` sees, the largest first.

    network: the transport without limits; band_limited: as it is baked. walks: path traces coefficients [N,K,3] and one
    sigma of each, from positions, directions [N,3] and a number of walks; without it the network's error is omitted.
    """
    seen, texels = visible_points(mesh, view, points, seed), texels_of(sky, up)
    light = texels.coefficients(degree)

    def radiance(coefficients: Array) -> Array:
        return np.asarray(np.einsum("nkc,kc->nc", coefficients, light))

    sharp = band_limited.exact() if hasattr(band_limited, "exact") else band_limited
    reference = _radiance_under(network.exact() if hasattr(network, "exact") else network, seen, texels)
    exact = fitted(sharp, seen.positions, seen.outgoing, degree, EXACT, seed)
    few = fitted(sharp, seen.positions, seen.outgoing, degree, SAMPLES, seed + 1)
    half = exact.astype(np.float16).astype(np.float64)
    baked = _Baked(sharp, mesh, view.eye, seen, rings, sectors, degree)
    at_corners = radiance(baked.towards_eye(seed))
    in_bins = radiance(baked.eye_bin_coordinates(EXACT, seed))
    rounded = baked if sharp is band_limited else _Baked(band_limited, mesh, view.eye, seen, rings, sectors, degree)
    all_parts = radiance(rounded.eye_bin_coordinates(SAMPLES, seed + 2))

    def part(name: str, difference: Array, how: str) -> Part:
        return Part(name, relative(difference, reference), how)

    parts = [
        part(f"harmonics of degree {degree}", radiance(exact) - reference, "against every texel of the sky"),
        part(f"{SAMPLES} directions a bin", radiance(few) - radiance(exact), f"against {EXACT} directions"),
        part("between view bins", _at(seen, in_bins - at_corners), "against the exact direction"),
        part("between vertices", _at(seen, at_corners) - radiance(exact), "against the exact point"),
        part("float16", radiance(half) - radiance(exact), "against float64"),
        Part("compression (gzip)", 0.0, "lossless"),
    ]
    if sharp is not band_limited:
        low = fitted(band_limited, seen.positions, seen.outgoing, degree, EXACT, seed)
        parts.append(part(band_limited.precision, radiance(low) - radiance(exact), "against float32 arithmetic"))
    if walks is not None:
        traced, sigma = walks(seen.positions, seen.outgoing, WALKS)
        noise = np.einsum("nkc,kc->nc", sigma**2, light**2).sum()
        squared = max(float(((radiance(exact) - radiance(traced)) ** 2).sum() - noise), 0.0)
        error = float(np.sqrt(squared / (reference**2).sum()))
        parts.append(Part("the network", error, f"against {WALKS} paths, noise subtracted"))
    parts += _reflected(network, mesh, sky, up, seen, reference, seed)
    parts.sort(key=lambda part: -part.radiance)
    picture = _at(seen, all_parts) - reference
    return [*parts, part("all but the network together", picture, "the picture of a bake, against every texel")]


def _reflected(
    network: Any, mesh: Mesh, sky: NDArray[np.float32], up: str, seen: VisiblePoints, reference: Array, seed: int
) -> list[Part]:
    """Reflected light that is missing in pictures; no parts for a surface that does not reflect."""
    eta, roughness = transport_property(network, "eta", 1.0), transport_property(network, "roughness", None)
    if roughness is None or ReflectingSurface(mesh, eta).matched:
        return []
    once, twice = reflected_at(
        mesh, sky, up, eta, float(np.mean(roughness)), seen.faces, seen.barycentric, seen.outgoing, seed
    )
    return [
        Part("reflected light, without --reflection", noise_free_rms(once, reference), "once, by samples"),
        Part("reflected twice, with --reflection", noise_free_rms(twice, reference), "by samples, noise subtracted"),
    ]


def texels_of(sky: NDArray[np.float32], up: str) -> Texels:
    """The sky averaged to at most TEXELS cells, with the light of all pixels."""
    height, width = sky.shape[:2]
    rows, columns = (
        np.unique(np.arange(many) * size // many) for many, size in zip(TEXELS, (height, width), strict=True)
    )
    v, u = (np.arange(height + 1) / height, (np.arange(width) + 0.5) / width)
    band = (np.cos(np.pi * v[:-1]) - np.cos(np.pi * v[1:])) * 2.0 * np.pi / width
    energy = sky.astype(np.float64) * band[:, None, None]
    energy = np.add.reduceat(np.add.reduceat(energy, rows, axis=0), columns, axis=1)
    centre_v = 0.5 * (v[rows] + v[np.append(rows[1:], height)])
    centre_u = 0.5 * (u[columns] + u[np.append(columns[1:], width) - 1])
    grid_u, grid_v = np.meshgrid(centre_u, centre_v)
    return Texels(environment.direction_of(grid_u, grid_v, up).reshape(-1, 3), energy.reshape(-1, 3))


def visible_points(mesh: Mesh, view: cameras.Camera, points: int, seed: int) -> VisiblePoints:
    """Random points that the camera sees; raises QueryError if it sees nothing of the object."""
    numbers = uniforms((_POINT_STREAM, seed, np.arange(TRIES * points)), 3)
    pixels = (numbers[:, 0] * view.width * view.height).astype(np.int64)
    origins, rays = cameras.pixel_rays(view, pixels, numbers[:, None, 1:]).rows()
    hits = cameras.Visibility(mesh).first_hits(origins, rays)
    facing = (rays * mesh.face_normals[hits.faces]).sum(axis=1) < 0.0
    visible = np.flatnonzero((hits.faces >= 0) & facing)[:points]
    if not len(visible):
        raise QueryError(f"view: the camera at {view.eye.tolist()} sees nothing of the object; move it or turn it")
    corners, u = mesh.faces[hits.faces[visible]].astype(np.int64), hits.barycentric[visible]
    shares = np.concatenate([1.0 - u.sum(axis=1, keepdims=True), u], axis=1)
    return VisiblePoints(
        np.einsum("nk,nki->ni", shares, mesh.positions[corners]), corners, shares, -rays[visible], hits.faces[visible]
    )


def _radiance_under(network: Any, seen: VisiblePoints, texels: Texels) -> Array:
    """Radiance [N,3] of the network under the sky."""
    incident, found = texels.directions[None], np.empty((len(seen.positions), 3))
    step = max(1, (1 << 21) // len(texels.directions))
    for first in range(0, len(found), step):
        some = slice(first, first + step)
        rows = np.zeros(len(found[some]), np.int64)
        values = values_at(network, incident, rows, seen.positions[some], seen.outgoing[some])
        found[some] = np.einsum("ndc,dc->nc", values.astype(np.float64), texels.weights)
    return found


def _at(seen: VisiblePoints, at_corners: Array) -> Array:
    """Radiance at the points [N,3], interpolated from their vertices [3·N,3]."""
    return np.asarray(np.einsum("nk,nkc->nc", seen.shares, at_corners.reshape(-1, 3, 3)))


class _Baked:
    """Coefficients of a bake at the vertices of visible points."""

    def __init__(
        self, transport: Any, mesh: Mesh, eye: Array, seen: VisiblePoints, rings: int, sectors: int, degree: int
    ) -> None:
        self._transport, self._mesh, self._degree = transport, mesh, degree
        self._vertices = seen.corners.reshape(-1)
        faces = horizons(mesh)
        towards = eye - mesh.positions[self._vertices]
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        self._outgoing = clamp_to_horizon(towards[:, None], faces, self._vertices)[0][:, 0]
        local = sphere.to_local(
            towards, mesh.normals[self._vertices], sphere.tangent_frame(mesh.normals)[self._vertices]
        )
        self._bins, self._weights = sphere.bin_weights(local, rings, sectors)
        self._views = views_of(mesh, rings, sectors)

    def towards_eye(self, seed: int) -> Array:
        """Reference coefficients [3·N,K,3] in the exact direction to the eye."""
        return self._fitted(self._vertices, self._outgoing, EXACT, seed)

    def eye_bin_coordinates(self, directions: int, seed: int) -> Array:
        """Coefficients interpolated between view bins, which have `directions` directions each."""
        rows, columns = np.nonzero(self._weights)
        distinct, inverse = np.unique(self._vertices, return_inverse=True)
        towards = self._views(distinct)[0][inverse[rows], self._bins[rows, columns]]
        found, shares = self._fitted(self._vertices[rows], towards, directions, seed), self._weights[rows, columns]
        added = np.zeros((len(self._vertices), *found.shape[1:]))
        np.add.at(added, rows, shares[:, None, None] * found)
        return added

    def _fitted(self, vertices: Index, outgoing: Array, directions: int, seed: int) -> Array:
        return fitted(self._transport, self._mesh.positions[vertices], outgoing, self._degree, directions, seed)
