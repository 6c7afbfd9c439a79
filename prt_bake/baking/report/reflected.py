"""Reflected light that is missing in pictures of an asset: all of it, or the second reflection."""

import numpy as np
from numpy.typing import NDArray

from formats.mesh import Mesh
from prt_bake.geometry.camera import Visibility
from prt_bake.lights import environment
from prt_bake.lights.lighting import Lighting, Sky
from prt_bake.mathematics.random import hashed, uniforms
from prt_bake.mathematics.sphere import to_world
from prt_bake.reflection.finish import SurfacePoints
from prt_bake.reflection.microfacet import mirrored, visible_facets
from prt_bake.reflection.reflector import Reflector
from prt_bake.reflection.surface import SMOOTHEST, ReflectingSurface

Array = NDArray[np.float64]

SAMPLES = 256
"""Rays per point, in two half buffers."""
_STREAM, _SEED = 0xC4, 33


def reflected_at(
    mesh: Mesh,
    sky: NDArray[np.float32],
    up: str,
    eta: float,
    alpha: float,
    faces: NDArray[np.int64],
    barycentric: Array,
    outgoing: Array,
    seed: int,
) -> tuple[Array, Array]:
    """Radiance of the sky that reaches the eye at (u, v) [N,2] of faces [N] after one reflection, and after two.

    Both are [2,N,3], in half buffers of independent rays: the mean of the product of two half buffers has no noise.
    0 for an index of refraction `eta` of 1.
    """
    surface = ReflectingSurface(mesh, eta)
    once, twice = np.zeros((2, len(faces), 3)), np.zeros((2, len(faces), 3))
    if surface.matched:
        return once, twice
    seen = Visibility(mesh)
    reflector = Reflector(mesh, Lighting((Sky(sky, up, environment.rotation(0.0, up)),)), eta, seen)
    points = SurfacePoints(faces, barycentric, mesh.face_normals[faces], outgoing, np.full(len(faces), alpha))
    front = surface.front_points(points)
    origins = surface.ray_origins(faces[front.rows], barycentric[front.rows])
    for sample in range(SAMPLES):
        keys = hashed(_STREAM, seed, sample, np.arange(len(faces)))
        half = sample % 2
        once[half] += reflector.reflected(points, keys, _SEED)
        facets = np.zeros_like(front.towards)
        facets[:, 2] = 1.0
        if alpha >= SMOOTHEST:
            facets = visible_facets(front.towards, front.alpha, uniforms((_STREAM, keys[front.rows]), 2))
        local = mirrored(front.towards, facets)
        directions = to_world(local, front.normals, front.tangents)
        reflectance = surface.reflectance(front, facets, local, directions)
        hits = seen.first_hits(origins, directions)
        met = np.flatnonzero((hits.faces >= 0) & (reflectance > 0.0))
        normals, rough = mesh.face_normals[hits.faces[met]], np.full(len(met), alpha)
        second = SurfacePoints(hits.faces[met], hits.barycentric[met], normals, -directions[met], rough)
        again = reflector.reflected(second, keys[front.rows[met]], _SEED + 1)
        twice[half, front.rows[met]] += reflectance[met, None] * again
    return 2.0 / SAMPLES * once, 2.0 / SAMPLES * twice


def noise_free_rms(halves: Array, reference: Array) -> float:
    """Root mean square of the radiance in half buffers [2,N,3] without their noise, over that of `reference` [N,3]."""
    return float(np.sqrt(max(0.0, float((halves[0] * halves[1]).sum())) / (reference**2).sum()))
