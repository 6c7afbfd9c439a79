"""Connections: what a walk's event receives from given directions of incidence, without waiting for the walk to leave.

Here for objects whose own boundary is index-matched, where every event looks straight towards the light; through rough
boundaries of the object itself see `prt_bake.tracer.connect_rough`.
"""

import math
from typing import Any

import numpy as np

from prt_bake.jit.without_counts import called_function, walk_function
from prt_bake.mathematics.counter import uniform
from prt_bake.tracer.surface.boundary import (
    PASS,
    alpha_at,
    crossing,
    facing_normal,
    is_compensated,
    meet,
    next_face,
    sees_sky,
)
from prt_bake.tracer.surface.compensation import returned_density
from prt_bake.tracer.surface.interface import MATCHED, microfacet_transport, rough_density
from prt_bake.tracer.surface.nearby_faces import meet_nearby
from prt_bake.tracer.volume.media import MINORANT, PHASE_G, phase
from prt_bake.tracer.volume.tracking import attenuate
from prt_bake.tracer.walk import (
    AT,
    BEFORE,
    BEHIND,
    DIRECTION,
    FACE,
    MASK,
    NORMAL,
    POSITION,
    ROOM,
    SCATTERING,
    SURFACE,
    THROUGHPUT,
    U,
    V,
    frame,
    region_of,
)

_ALWAYS_LOOKED = 2.0
"""Events at less than so many mean free paths from any face always look at the light."""


@walk_function()
def look_probability(boundary: Any, media: Any, state: Any, counts: Any) -> Any:
    """With what probability a scattering event looks at the light: that of getting out, where it lies deep inside."""
    depth = media.regions[region_of(boundary, counts), MINORANT] * state[ROOM]
    return 1.0 if depth <= _ALWAYS_LOOKED else math.exp(_ALWAYS_LOOKED - depth)


@walk_function()
def march(
    boundary: Any,
    media: Any,
    p: Any,
    d: Any,
    face: Any,
    mask: Any,
    near: Any,
    far: Any,
    at: Any,
    ray: Any,
    stream: Any,
    kept: Any,
) -> bool:
    """Multiply kept [3] by the transmittance along p + t d from `near` to `far`, through index-matched boundaries.

    False where anything else stands in the way. At `near` the ray lies on `face` (−1: on none), with the walker's
    `mask` behind it.
    """
    t = near
    while True:
        if face >= 0 and sees_sky(boundary, face, d):
            return True
        found, hit = next_face(boundary, ray, p, d, t, far, face)
        if found < 0:
            if far < np.inf:
                attenuate(media, boundary.region_of_mask[mask], p, d, t, far, at, stream, kept)
            return True
        found, _u, _v, before, after = meet(boundary, ray, p, d, hit, found, mask)
        kind, _eta = crossing(boundary, found, before, after)
        if kind != PASS and kind != MATCHED:
            return False
        attenuate(media, boundary.region_of_mask[before], p, d, t, hit, at, stream, kept)
        if kept[0] + kept[1] + kept[2] == 0.0:
            return True
        face, mask, t = found, after, hit


@called_function()
def unscattered(boundary: Any, media: Any, state: Any, counts: Any, ray: Any, stream: Any, kept: Any) -> None:
    """Write into kept [3] the share of a view into an index-matched object that crosses it without any event."""
    for c in range(3):
        kept[c] = 1.0
    p, d = state[POSITION : POSITION + 3], state[DIRECTION : DIRECTION + 3]
    at = state[AT : AT + 3]
    if not march(boundary, media, p, d, counts[FACE], counts[MASK], 0.0, np.inf, at, ray, stream, kept):
        for c in range(3):
            kept[c] = 0.0


@walk_function()
def sent_by(boundary: Any, media: Any, state: Any, counts: Any, event: Any, v: Any) -> Any:
    """What an event sends along v per solid angle: the phase function, or the cosine law of a diffuse surface."""
    d = state[DIRECTION : DIRECTION + 3]
    if event == SCATTERING:
        return phase(d[0] * v[0] + d[1] * v[1] + d[2] * v[2], media.regions[region_of(boundary, counts), PHASE_G])
    g = boundary.faces[counts[FACE]]
    nx, ny, nz = facing_normal(boundary, counts[FACE], state[NORMAL : NORMAL + 3], d)
    # What an interpolated normal would send behind the face itself is lost, as by `bounce`, which flies into it.
    if (v[0] * g[0] + v[1] * g[1] + v[2] * g[2]) * (d[0] * g[0] + d[1] * g[1] + d[2] * g[2]) >= 0.0:
        return 0.0
    return max(0.0, v[0] * nx + v[1] * ny + v[2] * nz) / math.pi


@walk_function()
def sent_through(boundary: Any, face: Any, normal: Any, alpha: Any, eta: Any, d: Any, v: Any, entering: Any) -> Any:
    """f |cos| of the rough interface from flight d to v (both along the eye path), and about by what density `cross`
    draws v (the balance heuristic is unbiased with any).
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
def _sent_straight(boundary: Any, media: Any, state: Any, counts: Any, event: Any, w: Any) -> Any:
    """What the walk's event sends towards w, and the mask of the walker that flies there."""
    if event != SURFACE:
        return sent_by(boundary, media, state, counts, event, w), counts[MASK]
    face = counts[FACE]
    d = state[DIRECTION : DIRECTION + 3]
    _kind, eta = crossing(boundary, face, counts[BEFORE], counts[BEHIND])
    alpha = alpha_at(boundary, face, state[U], state[V])
    sent, _density = sent_through(boundary, face, state[NORMAL : NORMAL + 3], alpha, eta, d, w, False)
    g = boundary.faces[face]
    passes = (d[0] * g[0] + d[1] * g[1] + d[2] * g[2]) * (w[0] * g[0] + w[1] * g[1] + w[2] * g[2]) > 0.0
    return sent, counts[BEHIND] if passes else counts[BEFORE]


@walk_function()
def connect_straight(
    boundary: Any,
    media: Any,
    state: Any,
    counts: Any,
    event: Any,
    incident: Any,
    share: Any,
    ray: Any,
    room: Any,
    stream: Any,
    value: Any,
) -> None:
    """Add to value [D,3] what an event receives from the directions incident [D,3].

    `event` is SCATTERING, REFLECTING, or SURFACE at a rough interface inside. `share` of the directions are looked at
    in turn from a random first one, each weighted by D / looked at. `room` is for 3 numbers.
    """
    count = incident.shape[0]
    looked = min(count, share)
    chance = look_probability(boundary, media, state, counts) if event == SCATTERING else 1.0
    if chance < 1.0 and uniform(stream) >= chance:
        return
    first = 0 if looked == count else int(uniform(stream) * count)
    p = state[POSITION : POSITION + 3]
    d = state[DIRECTION : DIRECTION + 3]
    kept = room[0:3]
    phase_g = media.regions[region_of(boundary, counts), PHASE_G]
    for j in range(looked):
        i = (first + j * count // looked) % count
        w = incident[i]
        mask = counts[MASK]
        if event == SCATTERING:
            sent = phase(d[0] * w[0] + d[1] * w[1] + d[2] * w[2], phase_g)
        else:
            sent, mask = _sent_straight(boundary, media, state, counts, event, w)
        if sent <= 0.0:
            continue
        for c in range(3):
            kept[c] = sent * count / (looked * chance)
        face, near = counts[FACE], 0.0
        if event == SCATTERING:
            face, near, mask = _leave_nearby(boundary, media, state, counts, w, stream, kept)
            if near < 0.0:
                continue
        if march(boundary, media, p, w, face, mask, near, np.inf, state[AT : AT + 3], ray, stream, kept):
            for c in range(3):
                value[i, c] += state[THROUGHPUT + c] * kept[c]


@walk_function()
def _leave_nearby(boundary: Any, media: Any, state: Any, counts: Any, w: Any, stream: Any, kept: Any) -> Any:
    """Follow a connection from a scattering event along w as far as no ray is needed: (face reached or −1, distance,
    mask there), with kept [3] multiplied by the transmittance up to a face that is reached.

    What little gets through so far goes on by roulette; the distance is negative where it has ended.
    """
    p, mask = state[POSITION : POSITION + 3], counts[MASK]
    face, t, _u, _v, inside = meet_nearby(boundary, p, w, -1)
    region = region_of(boundary, counts)
    depth = t * media.regions[region, MINORANT]
    if face < 0 or not inside:
        return (-1, 0.0, mask) if _survives(depth, stream, kept) else (-1, -1.0, mask)
    if not sees_sky(boundary, face, w) and not _survives(depth, stream, kept):
        return -1, -1.0, mask
    attenuate(media, region, p, w, 0.0, t, state[AT : AT + 3], stream, kept)
    return face, t, 0


@walk_function()
def _survives(depth: Any, stream: Any, kept: Any) -> bool:
    """Roulette on a connection that passes at least so many mean free paths, weighted in kept [3]."""
    if depth <= _ALWAYS_LOOKED:
        return True
    chance = math.exp(_ALWAYS_LOOKED - depth)
    if uniform(stream) >= chance:
        return False
    for c in range(3):
        kept[c] /= chance
    return True
