"""Connections through a rough boundary.

Light reaches an event by two ways of sampling, weighted by the balance heuristic (Veach 1997): the walk's own next
arrival at the boundary looks through the interface, and the event itself aims at the boundary (`prt_bake.trainer.aim`).
An event is a scattering, or the boundary sending the walk inwards: refraction at x, internal reflection, re-entry.
"""

from typing import Any

import numpy as np

from prt_bake.trainer.aim import aim_density, draw_aim, look_ahead
from prt_bake.trainer.compiled import walk_function
from prt_bake.trainer.counter import uniform
from prt_bake.trainer.embree import nearest_hit
from prt_bake.trainer.interface import microfacet_transport, rough_density
from prt_bake.trainer.media import phase, transmittance
from prt_bake.trainer.walk import (
    AHEAD,
    ARRIVED,
    AT,
    CLEARANCE,
    DIRECTION,
    FACE,
    NORMAL,
    ORIGIN,
    PHASE,
    POSITION,
    THROUGHPUT,
    facing_normal,
    frame,
    normal_at,
)

SCATTERED_HERE, CROSSING, ENTERING = 0, 1, 2


@walk_function()
def _sent(boundary: Any, face: Any, normal: Any, d: Any, v: Any, entering: Any) -> Any:
    """f |cos| of the rough interface from flight d to v (both along the eye path), and by what density `cross` draws
    v.
    """
    g = boundary.face_normals[face]
    before = d[0] * g[0] + d[1] * g[1] + d[2] * g[2]
    after = v[0] * g[0] + v[1] * g[1] + v[2] * g[2]
    nx, ny, nz, eta = facing_normal(boundary, face, normal, d)
    oz = v[0] * nx + v[1] * ny + v[2] * nz
    if (before * after > 0.0) != (oz < 0.0):
        return 0.0, 0.0
    sx, sy, sz, tx, ty, tz = frame(nx, ny, nz)
    ix, iy = -(d[0] * sx + d[1] * sy + d[2] * sz), -(d[0] * tx + d[1] * ty + d[2] * tz)
    iz = -(d[0] * nx + d[1] * ny + d[2] * nz)
    ox, oy = v[0] * sx + v[1] * sy + v[2] * sz, v[0] * tx + v[1] * ty + v[2] * tz
    value = rough_density(boundary.alpha, eta, ix, iy, iz, ox, oy, oz)
    if value <= 0.0:
        return 0.0, 0.0
    density, reflectance = microfacet_transport(boundary.alpha, eta, ix, iy, iz, ox, oy, oz)
    if not entering:
        density *= reflectance if oz > 0.0 else 1.0 - reflectance
    return value, density


@walk_function()
def _received(boundary: Any, face: Any, normal: Any, q: Any, d: Any, w: Any, ray: Any) -> Any:
    """f |cos| between a flight d that arrives at q on a face and light from w; 0 where the object hides the light."""
    g = boundary.face_normals[face]
    if w[0] * g[0] + w[1] * g[1] + w[2] * g[2] <= 0.0:
        return 0.0
    through, _density = _sent(boundary, face, normal, d, w, False)
    if through > 0.0:
        hidden, _t = nearest_hit(boundary.intersect, boundary.scene, ray, q, w, 0.0, np.inf, face)
        if hidden >= 0:
            return 0.0
    return through


@walk_function()
def connect_at_surface(
    boundary: Any, state: Any, counts: Any, incident: Any, share: Any, aims: Any, ray: Any, room: Any, value: Any
) -> None:
    """Add to value [D,3] what the walk's arrival at a rough boundary receives; counts[FACE] is the face reached.

    `share` of the directions had a chance to be aimed at from the event before. `room` is for 9 numbers.
    """
    if state[PHASE] == AHEAD:
        return
    count = incident.shape[0]
    fraction = min(count, share) / count
    d = state[DIRECTION : DIRECTION + 3]
    p = state[POSITION : POSITION + 3]
    for i in range(count):
        w = incident[i]
        weight = _received(boundary, counts[FACE], state[NORMAL : NORMAL + 3], p, d, w, ray)
        if weight <= 0.0:
            continue
        if state[PHASE] > 0.0:
            has_normal = look_ahead(boundary, aims.looks, state[ORIGIN : ORIGIN + 3], w, -1, ray, room[0:3], room[6:9])
            lobe = aim_density(boundary, aims.kappa, w, has_normal, room[6:9], d)
            weight *= state[PHASE] / (state[PHASE] + fraction * lobe)
        for c in range(3):
            value[i, c] += state[THROUGHPUT + c] * weight


@walk_function()
def connect_ahead(
    boundary: Any,
    medium: Any,
    state: Any,
    counts: Any,
    incident: Any,
    share: Any,
    aims: Any,
    ray: Any,
    room: Any,
    entering: Any,
    stream: Any,
    value: Any,
) -> None:
    """Add to value [D,3] what a walk that the boundary has just sent inwards will receive where it meets the boundary
    again without a scattering event, and mark it as done.

    That arrival is rare in a thick object and strong. Here it comes in every time, with the flight's transmittance.
    """
    count = incident.shape[0]
    looked = min(count, share)
    fraction = looked / count
    first = 0 if looked == count else int(uniform(stream) * count)
    d = state[DIRECTION : DIRECTION + 3]
    p = state[POSITION : POSITION + 3]
    v, q, normal = room[0:3], room[3:6], room[6:9]
    _value, density = _sent(
        boundary, counts[FACE], state[NORMAL : NORMAL + 3], state[ARRIVED : ARRIVED + 3], d, entering
    )
    state[PHASE] = AHEAD
    face, t = nearest_hit(boundary.intersect, boundary.scene, ray, p, d, CLEARANCE, np.inf, counts[FACE])
    if face < 0:
        return
    b1, b2 = np.float64(ray[15]), np.float64(ray[16])
    kept = 1.0 / fraction
    g = boundary.face_normals[face]
    if d[0] * g[0] + d[1] * g[1] + d[2] * g[2] > 0.0:
        kept *= transmittance(medium, p, d, 0.0, t, state[AT : AT + 3], stream)
    for k in range(3):
        q[k] = p[k] + t * d[k]
    for j in range(looked):
        i = (first + j * count // looked) % count
        w = incident[i]
        normal_at(boundary, face, b1, b2, normal)
        weight = _received(boundary, face, normal, q, d, w, ray) * kept
        if weight <= 0.0:
            continue
        has_normal = look_ahead(boundary, aims.looks, p, w, counts[FACE], ray, v, normal)
        lobe = aim_density(boundary, aims.kappa, w, has_normal, normal, d)
        weight *= density / (density + fraction * lobe)
        for c in range(3):
            value[i, c] += state[THROUGHPUT + c] * weight


@walk_function()
def connect_aimed(
    boundary: Any,
    medium: Any,
    state: Any,
    counts: Any,
    incident: Any,
    share: Any,
    aims: Any,
    ray: Any,
    room: Any,
    event: Any,
    stream: Any,
    value: Any,
) -> None:
    """Add to value [D,3] what an event receives by aiming at the boundary about each direction.

    `event` is SCATTERED_HERE, CROSSING (the walk has arrived at the boundary) or ENTERING (the same at x, where every
    walk is let in). `room` is for 9 numbers: the aimed direction, where it meets the boundary, and the normal
    there.
    """
    count = incident.shape[0]
    looked = min(count, share)
    fraction = looked / count
    first = 0 if looked == count else int(uniform(stream) * count)
    near = 0.0 if event == SCATTERED_HERE else CLEARANCE
    d = state[DIRECTION : DIRECTION + 3]
    p = state[POSITION : POSITION + 3]
    v, q, normal = room[0:3], room[3:6], room[6:9]
    for j in range(looked):
        i = (first + j * count // looked) % count
        w = incident[i]
        has_normal = look_ahead(boundary, aims.looks, p, w, counts[FACE], ray, v, normal)
        if not draw_aim(boundary, aims.kappa, w, has_normal, normal, v, stream):
            continue
        lobe = aim_density(boundary, aims.kappa, w, has_normal, normal, v)
        if event == SCATTERED_HERE:
            sent = phase(d[0] * v[0] + d[1] * v[1] + d[2] * v[2], medium.phase_g)
            density = sent
        else:
            g = boundary.face_normals[counts[FACE]]
            if v[0] * g[0] + v[1] * g[1] + v[2] * g[2] >= 0.0:
                continue
            sent, density = _sent(boundary, counts[FACE], state[NORMAL : NORMAL + 3], d, v, event == ENTERING)
            if sent <= 0.0:
                continue
        face, t = nearest_hit(boundary.intersect, boundary.scene, ray, p, v, near, np.inf, counts[FACE])
        if face < 0:
            continue
        g = boundary.face_normals[face]
        if v[0] * g[0] + v[1] * g[1] + v[2] * g[2] <= 0.0:
            continue
        normal_at(boundary, face, np.float64(ray[15]), np.float64(ray[16]), normal)
        for k in range(3):
            q[k] = p[k] + t * v[k]
        through = _received(boundary, face, normal, q, v, w, ray)
        if through <= 0.0:
            continue
        kept = transmittance(medium, p, v, 0.0, t, state[AT : AT + 3], stream)
        weight = sent * through * kept / (density + fraction * lobe)
        for c in range(3):
            value[i, c] += state[THROUGHPUT + c] * weight
