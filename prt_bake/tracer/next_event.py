"""Sampling of next-event directions through a rough boundary.

Light from w refracts at the boundary and reaches an event inside along some v near w. Directions v are sampled from a
mixture of two densities. One is a von Mises–Fisher lobe about w, wide enough for the usual refraction. The other
refracts w at a sampled microfacet of the boundary near where v will hit it, as if the surface were a plane there. The
latter follows narrow interfaces, the former covers curved surfaces.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from prt_bake.geometry.embree import nearest_hit
from prt_bake.jit.kernel_functions import called_function, inlined_function
from prt_bake.mathematics.counter import uniform
from prt_bake.tracer.surface.boundary import facing_normal, normal_at, part_of
from prt_bake.tracer.surface.interface import microfacet_transport, refract_at_microfacet
from prt_bake.tracer.walk import frame

_REFRACTED_SHARE = 0.7


class NextEventSampling(NamedTuple):
    """Concentration `kappa` of the lobe, and number of iterations that search the boundary's normal (0: lobe only)."""

    kappa: float
    normal_steps: int


def next_event_sampling(alpha: float, eta: float) -> NextEventSampling:
    """Parameters for a GGX roughness and a relative index.

    `kappa` is fitted to the least variance per path on a sphere (eta 1.1–1.5, alpha 0.1–0.5, sigma_t 5 and 15).
    `normal_steps` is fitted to the highest efficiency on a sphere and on a concave mesh (eta 1.3, alpha 0.03–0.6): a
    wide interface does not repay the rays.
    """
    bend = 0.7 * (1.0 - 1.0 / max(eta, 1.0 / eta))
    width = alpha * abs(1.0 - 1.0 / eta)
    normal_steps = sum(width < limit for limit in (0.1, 0.05, 0.0125))
    return NextEventSampling((1.0 + alpha**2) / (bend * bend + 0.003), normal_steps)


@inlined_function()
def lobe_density(cosine: Any, kappa: Any) -> Any:
    """Density of a von Mises–Fisher lobe per solid angle."""
    return kappa / (2.0 * math.pi * (1.0 - math.exp(-2.0 * kappa))) * math.exp(kappa * (cosine - 1.0))


@inlined_function()
def sample_lobe(w: Any, kappa: Any, v: Any, stream: Any) -> None:
    """Sample a direction v from the von Mises–Fisher lobe about w."""
    cosine = 1.0 + math.log(1.0 - uniform(stream) * (1.0 - math.exp(-2.0 * kappa))) / kappa
    sine = math.sqrt(max(0.0, 1.0 - cosine * cosine))
    angle = 2.0 * math.pi * uniform(stream)
    a, b = sine * math.cos(angle), sine * math.sin(angle)
    sx, sy, sz, tx, ty, tz = frame(w[0], w[1], w[2])
    v[0], v[1], v[2] = (
        a * sx + b * tx + cosine * w[0],
        a * sy + b * ty + cosine * w[1],
        a * sz + b * tz + cosine * w[2],
    )


@inlined_function()
def _outermost_face(boundary: Any, p: Any, v: Any, skip: Any, ray: Any) -> Any:
    """The first face of the object itself along p + t v, past all inner parts; −1: none."""
    near = 0.0
    while True:
        face, t = nearest_hit(boundary.intersect, boundary.scene, ray, p, v, near, np.inf, skip)
        if face < 0 or part_of(boundary, face) == 0:
            return face
        near = t * (1.0 + 2e-7) + 1e-9


@called_function()
def boundary_normal(boundary: Any, normal_steps: Any, p: Any, w: Any, skip: Any, ray: Any, v: Any, normal: Any) -> bool:
    """Write the outward normal of the boundary near where light from w enters to reach p. False if there is none.

    Fixed-point iteration: the first guess is where p + t w leaves the object, the next where the ray refracted there
    does. `v` is scratch space [3].
    """
    for k in range(3):
        v[k] = w[k]
    found = False
    for step in range(normal_steps):
        face = _outermost_face(boundary, p, v, skip, ray)
        if face < 0:
            return found
        g = boundary.faces[face]
        if w[0] * g[0] + w[1] * g[1] + w[2] * g[2] <= 0.0:
            return found
        normal_at(boundary, face, np.float64(ray[15]), np.float64(ray[16]), normal)
        x, y, z = facing_normal(boundary, face, normal, w)
        normal[0], normal[1], normal[2] = -x, -y, -z
        found = True
        if step + 1 < normal_steps:
            cosine = w[0] * normal[0] + w[1] * normal[1] + w[2] * normal[2]
            eta = boundary.eta
            squared = 1.0 - (1.0 - cosine * cosine) / (eta * eta)
            if squared <= 0.0:
                return found
            along = math.sqrt(squared) - cosine / eta
            for k in range(3):
                v[k] = w[k] / eta + along * normal[k]
    return found


@called_function()
def sample_next_event(boundary: Any, kappa: Any, w: Any, has_normal: Any, normal: Any, v: Any, stream: Any) -> bool:
    """Sample a direction v to the boundary with `next_event_density`. False if the sample is void."""
    if not has_normal or uniform(stream) >= _REFRACTED_SHARE:
        sample_lobe(w, kappa, v, stream)
        return True
    sx, sy, sz, tx, ty, tz = frame(normal[0], normal[1], normal[2])
    ix, iy = w[0] * sx + w[1] * sy + w[2] * sz, w[0] * tx + w[1] * ty + w[2] * tz
    iz = w[0] * normal[0] + w[1] * normal[1] + w[2] * normal[2]
    ox, oy, oz = refract_at_microfacet(boundary.alpha, boundary.eta, ix, iy, iz, uniform(stream), uniform(stream))
    if oz >= 0.0:
        return False
    x, y, z = ox * sx + oy * tx + oz * normal[0], ox * sy + oy * ty + oz * normal[1], ox * sz + oy * tz + oz * normal[2]
    scale = -1.0 / math.sqrt(x * x + y * y + z * z)
    v[0], v[1], v[2] = x * scale, y * scale, z * scale
    return True


@called_function()
def next_event_density(boundary: Any, kappa: Any, w: Any, has_normal: Any, normal: Any, v: Any) -> Any:
    """Density of `sample_next_event` per solid angle of v, given the result of `boundary_normal` at the same point."""
    lobe = lobe_density(v[0] * w[0] + v[1] * w[1] + v[2] * w[2], kappa)
    if not has_normal:
        return lobe
    sx, sy, sz, tx, ty, tz = frame(normal[0], normal[1], normal[2])
    ix, iy = w[0] * sx + w[1] * sy + w[2] * sz, w[0] * tx + w[1] * ty + w[2] * tz
    iz = w[0] * normal[0] + w[1] * normal[1] + w[2] * normal[2]
    ox, oy = -(v[0] * sx + v[1] * sy + v[2] * sz), -(v[0] * tx + v[1] * ty + v[2] * tz)
    oz = -(v[0] * normal[0] + v[1] * normal[1] + v[2] * normal[2])
    refracted = 0.0
    if oz < 0.0:
        refracted, _reflectance = microfacet_transport(boundary.alpha, boundary.eta, ix, iy, iz, ox, oy, oz)
    return (1.0 - _REFRACTED_SHARE) * lobe + _REFRACTED_SHARE * refracted
