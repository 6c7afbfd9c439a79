"""Next-event estimation: the light that an event of a walk receives from given directions of incidence.

This module connects events straight to the light, for objects with an index-matched outer boundary. For a rough outer
boundary see `prt_bake.tracer.connect_rough`.
"""

import math
from typing import Any

import numpy as np

from prt_bake.jit.kernel_functions import called_function, inlined_function
from prt_bake.mathematics.counter import uniform
from prt_bake.tracer.surface.boundary import (
    PASS,
    alpha_at,
    facing_normal,
    interface_at,
    is_compensated,
    next_face,
    resolve_hit,
    sees_sky,
)
from prt_bake.tracer.surface.compensation import returned_density
from prt_bake.tracer.surface.interface import MATCHED, microfacet_transport, rough_density
from prt_bake.tracer.surface.nearby_faces import nearby_hit
from prt_bake.tracer.volume.media import MINORANT, PHASE_G, phase
from prt_bake.tracer.volume.tracking import attenuate
from prt_bake.tracer.walk import (
    BEFORE,
    BEHIND,
    CLEARANCE,
    DIRECTION,
    FACE,
    MASK,
    NORMAL,
    POSITION,
    SCATTERING,
    SCRATCH,
    SURFACE,
    THROUGHPUT,
    U,
    V,
    frame,
    region_of,
)

_ALWAYS_CONNECTED = 2.0
"""Scattering events within this many mean free paths of a face always connect."""


@inlined_function()
def connection_probability(boundary: Any, media: Any, state: Any, counts: Any) -> Any:
    """Probability with which a scattering event connects. Deep inside it falls like the transmittance to the
    boundary.
    """
    depth = media.regions[region_of(boundary, counts), MINORANT] * state[CLEARANCE]
    return 1.0 if depth <= _ALWAYS_CONNECTED else math.exp(_ALWAYS_CONNECTED - depth)


@inlined_function()
def march(
    boundary: Any,
    media: Any,
    p: Any,
    d: Any,
    face: Any,
    mask: Any,
    near: Any,
    far: Any,
    point: Any,
    ray: Any,
    stream: Any,
    transmittance: Any,
) -> bool:
    """Multiply transmittance [3] by that along p + t d from `near` to `far`, through index-matched boundaries.

    False if another boundary blocks the ray. At `near` the ray is on `face` (−1: none), in the parts of `mask`.
    """
    t = near
    while True:
        if face >= 0 and sees_sky(boundary, face, d):
            return True
        found, hit = next_face(boundary, ray, p, d, t, far, face)
        if found < 0:
            if far < np.inf:
                attenuate(media, boundary.region_of_mask[mask], p, d, t, far, point, stream, transmittance)
            return True
        found, _u, _v, before, after = resolve_hit(boundary, ray, p, d, hit, found, mask)
        kind, _eta = interface_at(boundary, found, before, after)
        if kind != PASS and kind != MATCHED:
            return False
        attenuate(media, boundary.region_of_mask[before], p, d, t, hit, point, stream, transmittance)
        if transmittance[0] + transmittance[1] + transmittance[2] == 0.0:
            return True
        face, mask, t = found, after, hit


@called_function()
def unscattered(boundary: Any, media: Any, state: Any, counts: Any, ray: Any, stream: Any, transmittance: Any) -> None:
    """Write the transmittance [3] of the whole object along the view into it, behind an index-matched boundary."""
    for c in range(3):
        transmittance[c] = 1.0
    p, d = state[POSITION : POSITION + 3], state[DIRECTION : DIRECTION + 3]
    point = state[SCRATCH : SCRATCH + 3]
    if not march(boundary, media, p, d, counts[FACE], counts[MASK], 0.0, np.inf, point, ray, stream, transmittance):
        for c in range(3):
            transmittance[c] = 0.0


@inlined_function()
def scattering_density(boundary: Any, media: Any, state: Any, counts: Any, event: Any, v: Any) -> Any:
    """Density per solid angle with which an event scatters along v: the phase function, or the cosine of a diffuse
    face.
    """
    d = state[DIRECTION : DIRECTION + 3]
    if event == SCATTERING:
        return phase(d[0] * v[0] + d[1] * v[1] + d[2] * v[2], media.regions[region_of(boundary, counts), PHASE_G])
    g = boundary.faces[counts[FACE]]
    nx, ny, nz = facing_normal(boundary, counts[FACE], state[NORMAL : NORMAL + 3], d)
    # Directions behind the face itself, which an interpolated normal allows, count as absorbed, as after `bounce`.
    if (v[0] * g[0] + v[1] * g[1] + v[2] * g[2]) * (d[0] * g[0] + d[1] * g[1] + d[2] * g[2]) >= 0.0:
        return 0.0
    return max(0.0, v[0] * nx + v[1] * ny + v[2] * nz) / math.pi


@inlined_function()
def interface_transport(
    boundary: Any, face: Any, normal: Any, alpha: Any, eta: Any, d: Any, v: Any, entering: Any
) -> Any:
    """f |cos| of the rough interface from flight d to v (both along the eye path), and approximately the density with
    which `cross` samples v. The balance heuristic is unbiased with any density.
    """
    g = boundary.faces[face]
    before = d[0] * g[0] + d[1] * g[1] + d[2] * g[2]
    after = v[0] * g[0] + v[1] * g[1] + v[2] * g[2]
    nx, ny, nz = facing_normal(boundary, face, normal, d)
    oz = v[0] * nx + v[1] * ny + v[2] * nz
    if (before * after > 0.0) != (oz < 0.0):
        return 0.0, 0.0
    sx, sy, sz, tx, ty, tz = frame(nx, ny, nz)
    ix, iy = -(d[0] * sx + d[1] * sy + d[2] * sz), -(d[0] * tx + d[1] * ty + d[2] * tz)
    iz = -(d[0] * nx + d[1] * ny + d[2] * nz)
    ox, oy = v[0] * sx + v[1] * sy + v[2] * sz, v[0] * tx + v[1] * ty + v[2] * tz
    value = rough_density(alpha, eta, ix, iy, iz, ox, oy, oz)
    returned = 0.0
    if is_compensated(boundary, face):
        returned = returned_density(boundary.losses, alpha, eta, iz, oz)
    if value + returned <= 0.0:
        return 0.0, 0.0
    density, reflectance = microfacet_transport(alpha, eta, ix, iy, iz, ox, oy, oz)
    if not entering:
        density *= reflectance if oz > 0.0 else 1.0 - reflectance
    value += returned
    density += returned
    return value, density


@called_function()
def _event_transport(boundary: Any, media: Any, state: Any, counts: Any, event: Any, w: Any) -> Any:
    """Scattered density towards w, and the mask of parts that contain a ray in that direction."""
    if event != SURFACE:
        return scattering_density(boundary, media, state, counts, event, w), counts[MASK]
    face = counts[FACE]
    d = state[DIRECTION : DIRECTION + 3]
    _kind, eta = interface_at(boundary, face, counts[BEFORE], counts[BEHIND])
    alpha = alpha_at(boundary, face, state[U], state[V])
    scattered, _density = interface_transport(boundary, face, state[NORMAL : NORMAL + 3], alpha, eta, d, w, False)
    g = boundary.faces[face]
    passes = (d[0] * g[0] + d[1] * g[1] + d[2] * g[2]) * (w[0] * g[0] + w[1] * g[1] + w[2] * g[2]) > 0.0
    return scattered, counts[BEHIND] if passes else counts[BEFORE]


@inlined_function()
def connect_straight(
    boundary: Any,
    media: Any,
    state: Any,
    counts: Any,
    event: Any,
    incident: Any,
    connections: Any,
    ray: Any,
    scratch: Any,
    stream: Any,
    value: Any,
) -> None:
    """Add to value [D,3] the light that an event receives from the directions incident [D,3].

    `event` is SCATTERING, REFLECTING, or SURFACE at a rough interface inside. It connects to `connections` of the D
    directions, evenly spaced from a random first one, each weighted by D / connections. `scratch` is space [3].
    """
    count = incident.shape[0]
    connected = min(count, connections)
    probability = connection_probability(boundary, media, state, counts) if event == SCATTERING else 1.0
    if probability < 1.0 and uniform(stream) >= probability:
        return
    first = 0 if connected == count else int(uniform(stream) * count)
    p = state[POSITION : POSITION + 3]
    d = state[DIRECTION : DIRECTION + 3]
    contribution = scratch[0:3]
    phase_g = media.regions[region_of(boundary, counts), PHASE_G]
    for j in range(connected):
        i = (first + j * count // connected) % count
        w = incident[i]
        mask = counts[MASK]
        if event == SCATTERING:
            scattered = phase(d[0] * w[0] + d[1] * w[1] + d[2] * w[2], phase_g)
        else:
            scattered, mask = _event_transport(boundary, media, state, counts, event, w)
        if scattered <= 0.0:
            continue
        for c in range(3):
            contribution[c] = scattered * count / (connected * probability)
        face, near = counts[FACE], 0.0
        if event == SCATTERING:
            face, near, mask = _cross_nearby(boundary, media, state, counts, w, stream, contribution)
            if near < 0.0:
                continue
        if march(
            boundary, media, p, w, face, mask, near, np.inf, state[SCRATCH : SCRATCH + 3], ray, stream, contribution
        ):
            for c in range(3):
                value[i, c] += state[THROUGHPUT + c] * contribution[c]


@inlined_function()
def _cross_nearby(boundary: Any, media: Any, state: Any, counts: Any, w: Any, stream: Any, contribution: Any) -> Any:
    """Follow a connection along w as far as the nearby faces tell without a ray: (face reached or −1, distance, mask).

    Multiplies contribution [3] by the transmittance up to a face that is reached. Deep connections play roulette; the
    distance is negative if one has ended.
    """
    p, mask = state[POSITION : POSITION + 3], counts[MASK]
    face, t, _u, _v, inside = nearby_hit(boundary, p, w, -1)
    region = region_of(boundary, counts)
    depth = t * media.regions[region, MINORANT]
    if face < 0 or not inside:
        return (-1, 0.0, mask) if _roulette(depth, stream, contribution) else (-1, -1.0, mask)
    if not sees_sky(boundary, face, w) and not _roulette(depth, stream, contribution):
        return -1, -1.0, mask
    attenuate(media, region, p, w, 0.0, t, state[SCRATCH : SCRATCH + 3], stream, contribution)
    return face, t, 0


@inlined_function()
def _roulette(depth: Any, stream: Any, contribution: Any) -> bool:
    """Russian roulette on a connection through at least `depth` mean free paths; survivors are reweighted."""
    if depth <= _ALWAYS_CONNECTED:
        return True
    probability = math.exp(_ALWAYS_CONNECTED - depth)
    if uniform(stream) >= probability:
        return False
    for c in range(3):
        contribution[c] /= probability
    return True
