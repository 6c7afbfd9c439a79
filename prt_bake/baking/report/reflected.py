"""Reflected light that is missing in pictures of an asset: all of it, or the second reflection."""

import numpy as np
from numpy.typing import NDArray

from formats.mesh import Mesh
from prt_bake.geometry.camera import Visibility
from prt_bake.lights import environment
from prt_bake.lights.lighting import Lighting, Sky
from prt_bake.mathematics.random import hashed, uniforms
from prt_bake.mathematics.sphere import to_world
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
    normals, rough = mesh.face_normals[faces], np.full(len(faces), alpha)
    points = surface.points(faces, normals, outgoing, rough)
    starts = surface.starts(faces[points.rows], barycentric[points.rows])
    for sample in range(SAMPLES):
        keys = hashed(_STREAM, seed, sample, np.arange(len(faces)))
        half = sample % 2
        once[half] += reflector.reflected(faces, barycentric, normals, outgoing, rough, keys, _SEED)
        facets = np.zeros_like(points.towards)
        facets[:, 2] = 1.0
        if alpha >= SMOOTHEST:
            facets = visible_facets(points.towards, points.alpha, uniforms((_STREAM, keys[points.rows]), 2))
        local = mirrored(points.towards, facets)
        directions = to_world(local, points.normals, points.tangents)
        share = surface.share(points, facets, local, directions)
        hits = seen.first_hits(starts, directions)
        met = np.flatnonzero((hits.faces >= 0) & (share > 0.0))
        again = reflector.reflected(
            hits.faces[met],
            hits.barycentric[met],
            mesh.face_normals[hits.faces[met]],
            -directions[met],
            np.full(len(met), alpha),
            keys[points.rows[met]],
            _SEED + 1,
        )
        twice[half, points.rows[met]] += share[met, None] * again
    return 2.0 / SAMPLES * once, 2.0 / SAMPLES * twice


def noise_free_rms(halves: Array, reference: Array) -> float:
    """Root mean square of the radiance in half buffers [2,N,3] without their noise, over that of `reference` [N,3]."""
    return float(np.sqrt(max(0.0, float((halves[0] * halves[1]).sum())) / (reference**2).sum()))
