"""What errs in the final picture, each part measured alone on points of it: relative RMSE of the radiance seen there.

The points are drawn among those of the object that a camera sees. The truth of most parts is the network itself, asked
towards the eye under the whole sky, texel by texel; that of the network is the path tracer.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bakers.evaluation import values_at
from bakers.horizon import bend_to_horizon
from formats.errors import QueryError
from formats.mesh import Mesh
from prt_bake.baking.job.views import horizons, views_of
from prt_bake.baking.output.sink import said_by
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
"""Rows and columns of the sky that the network is asked for, each the mean of what lies in it."""
EXACT, SAMPLES, WALKS = 1024, 64, 4096
"""Directions of coefficients that are taken for exact, those of a bake, and walks of a reference."""
TRIES = 16
"""Rays a point that is wanted."""
_POINT_STREAM = 32


@dataclass(frozen=True)
class Part:
    """One thing that errs."""

    name: str
    radiance: float
    """Relative RMSE of the radiance in the picture."""
    how: str


@dataclass(frozen=True)
class Seen:
    """Points [N] of the object that an eye sees."""

    places: Array
    corners: Index
    """Vertices [N,3] of the face."""
    shares: Array
    """Of these in the point."""
    outgoing: Array
    faces: Index

    @property
    def barycentric(self) -> Array:
        """(u, v) [N,2] in the face."""
        return self.shares[:, 1:]


@dataclass(frozen=True)
class Texels:
    """A sky as so many directions [D,3] and what comes from each, radiance · solid angle [D,3]."""

    directions: Array
    weights: Array

    def coefficients(self, degree: int) -> Array:
        """b_lm [K,3]"""
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

    network: Ŝ as it is; band_limited: what is baked of it. walks: coefficients [N,K,3] and one sigma of each, by path
    tracing at positions and directions [N,3] with so many walks; without it the network's own error is not measured.
    """
    seen, texels = seen_points(mesh, view, points, seed), texels_of(sky, up)
    light = texels.coefficients(degree)

    def lit(coefficients: Array) -> Array:
        return np.asarray(np.einsum("nkc,kc->nc", coefficients, light))

    sharp = band_limited.exact() if hasattr(band_limited, "exact") else band_limited
    whole = _under(network.exact() if hasattr(network, "exact") else network, seen, texels)
    exact = fitted(sharp, seen.places, seen.outgoing, degree, EXACT, seed)
    few = fitted(sharp, seen.places, seen.outgoing, degree, SAMPLES, seed + 1)
    half = exact.astype(np.float16).astype(np.float64)
    baked = _Baked(sharp, mesh, view.eye, seen, rings, sectors, degree)
    at_corners = lit(baked.towards_eye(seed))
    in_bins = lit(baked.between_bins(EXACT, seed))
    rounded = baked if sharp is band_limited else _Baked(band_limited, mesh, view.eye, seen, rings, sectors, degree)
    together = lit(rounded.between_bins(SAMPLES, seed + 2))
    parts = [
        Part(f"harmonics of degree {degree}", relative(lit(exact) - whole, whole), "against every texel of the sky"),
        Part(f"{SAMPLES} directions a bin", relative(lit(few) - lit(exact), whole), f"against {EXACT} directions"),
        Part("between view bins", relative(_at(seen, in_bins - at_corners), whole), "against the very direction"),
        Part("between vertices", relative(_at(seen, at_corners) - lit(exact), whole), "against the very point"),
        Part("float16", relative(lit(half) - lit(exact), whole), "against float64"),
        Part("compression (gzip)", 0.0, "lossless"),
    ]
    if sharp is not band_limited:
        low = fitted(band_limited, seen.places, seen.outgoing, degree, EXACT, seed)
        parts.append(Part(band_limited.precision, relative(lit(low) - lit(exact), whole), "against float32 arithmetic"))
    if walks is not None:
        traced, sigma = walks(seen.places, seen.outgoing, WALKS)
        noise = np.einsum("nkc,kc->nc", sigma**2, light**2).sum()
        off = max(float(((lit(exact) - lit(traced)) ** 2).sum() - noise), 0.0)
        parts.append(
            Part("the network", float(np.sqrt(off / (whole**2).sum())), f"against {WALKS} walks, their noise out")
        )
    parts += _reflected(network, mesh, sky, up, seen, whole, seed)
    parts.sort(key=lambda part: -part.radiance)
    whole_bake = relative(_at(seen, together) - whole, whole)
    return [*parts, Part("all but the network together", whole_bake, "the picture of a bake, against every texel")]


def _reflected(
    network: Any, mesh: Mesh, sky: NDArray[np.float32], up: str, seen: Seen, whole: Array, seed: int
) -> list[Part]:
    """What pictures lack of the light that the surface reflects; nothing where it reflects none."""
    eta, roughness = said_by(network, "eta", 1.0), said_by(network, "roughness", None)
    if roughness is None or ReflectingSurface(mesh, eta).matched:
        return []
    once, twice = reflected_at(
        mesh, sky, up, eta, float(np.mean(roughness)), seen.faces, seen.barycentric, seen.outgoing, seed
    )
    return [
        Part("reflected light, without --reflection", noise_free_rms(once, whole), "once, by samples"),
        Part("reflected twice, with --reflection", noise_free_rms(twice, whole), "by samples, their noise out"),
    ]


def texels_of(sky: NDArray[np.float32], up: str) -> Texels:
    """The sky in at most TEXELS cells, each with all the light that comes from it."""
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


def seen_points(mesh: Mesh, view: cameras.Camera, points: int, seed: int) -> Seen:
    """Points drawn by the seed among those that the camera sees; raises QueryError where it sees nothing."""
    numbers = uniforms((_POINT_STREAM, seed, np.arange(TRIES * points)), 3)
    pixels = (numbers[:, 0] * view.width * view.height).astype(np.int64)
    origins, rays = cameras.pixel_rays(view, pixels, numbers[:, None, 1:]).rows()
    hits = cameras.Visibility(mesh).first_hits(origins, rays)
    facing = (rays * mesh.face_normals[hits.faces]).sum(axis=1) < 0.0
    met = np.flatnonzero((hits.faces >= 0) & facing)[:points]
    if not len(met):
        raise QueryError("the camera sees nothing of the object")
    corners, u = mesh.faces[hits.faces[met]].astype(np.int64), hits.barycentric[met]
    shares = np.concatenate([1.0 - u.sum(axis=1, keepdims=True), u], axis=1)
    return Seen(np.einsum("nk,nki->ni", shares, mesh.positions[corners]), corners, shares, -rays[met], hits.faces[met])


def _under(network: Any, seen: Seen, texels: Texels) -> Array:
    """Radiance [N,3] of the network under every texel."""
    incident, found = texels.directions[None], np.empty((len(seen.places), 3))
    step = max(1, (1 << 21) // len(texels.directions))
    for first in range(0, len(found), step):
        some = slice(first, first + step)
        rows = np.zeros(len(found[some]), np.int64)
        values = values_at(network, incident, rows, seen.places[some], seen.outgoing[some])
        found[some] = np.einsum("ndc,dc->nc", values.astype(np.float64), texels.weights)
    return found


def _at(seen: Seen, at_corners: Array) -> Array:
    """What is seen at the points [N,3] of what their corners [3·N,3] send."""
    return np.asarray(np.einsum("nk,nkc->nc", seen.shares, at_corners.reshape(-1, 3, 3)))


class _Baked:
    """What a bake has at the corners of points that an eye sees."""

    def __init__(
        self, transport: Any, mesh: Mesh, eye: Array, seen: Seen, rings: int, sectors: int, degree: int
    ) -> None:
        self._transport, self._mesh, self._degree = transport, mesh, degree
        self._vertices = seen.corners.reshape(-1)
        around = horizons(mesh)
        towards = eye - mesh.positions[self._vertices]
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        bent = [bend_to_horizon(d[None, None], around, int(v))[0] for v, d in zip(self._vertices, towards, strict=True)]
        self._outgoing = np.concatenate(bent)[:, 0]
        local = sphere.to_local(
            towards, mesh.normals[self._vertices], sphere.tangent_frame(mesh.normals)[self._vertices]
        )
        self._bins, self._weights = sphere.bin_weights(local, rings, sectors)
        self._views = views_of(mesh, rings, sectors)[1]

    def towards_eye(self, seed: int) -> Array:
        """Exact coefficients [3·N,K,3] in the very direction to the eye."""
        return self._fitted(self._vertices, self._outgoing, EXACT, seed)

    def between_bins(self, directions: int, seed: int) -> Array:
        """The same, interpolated between view bins that have so many directions each."""
        rows, columns = np.nonzero(self._weights)
        outgoing = {int(v): self._views(int(v), int(v) + 1)[0][0] for v in np.unique(self._vertices)}
        vertices, bins = self._vertices[rows], self._bins[rows, columns]
        towards = np.stack([outgoing[int(v)][b] for v, b in zip(vertices, bins, strict=True)])
        found = self._fitted(vertices, towards, directions, seed) * self._weights[rows, columns][:, None, None]
        added = np.zeros((len(self._vertices), *found.shape[1:]))
        np.add.at(added, rows, found)
        return added

    def _fitted(self, vertices: Index, outgoing: Array, directions: int, seed: int) -> Array:
        return fitted(self._transport, self._mesh.positions[vertices], outgoing, self._degree, directions, seed)
