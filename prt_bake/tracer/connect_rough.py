"""Connections through a rough boundary of the object.

Light reaches an event by two ways of sampling, weighted by the balance heuristic (Veach 1997): the walk's own next
arrival at the boundary looks through the interface, and the event itself aims at the boundary
(`prt_bake.tracer.next_event`). An event is a scattering, a diffuse surface, or the boundary sending the walk inwards:
refraction at x, internal reflection, re-entry. Interfaces further inside do not aim: what they send counts where it
arrives.
"""

from typing import Any

import numpy as np

from prt_bake.jit.without_counts import called_function, walk_function
from prt_bake.mathematics.counter import uniform
from prt_bake.tracer.connect import look_probability, march, sent_by, sent_through
from prt_bake.tracer.next_event import aim_density, draw_aim, look_ahead
from prt_bake.tracer.surface.boundary import (
    RAY_EPSILON,
    alpha_at,
    crossing,
    met_from_behind,
    normal_at,
    reach,
    sees_sky,
)
from prt_bake.tracer.surface.embree import nearest_hit
from prt_bake.tracer.surface.interface import ROUGH
from prt_bake.tracer.volume.tracking import attenuate
from prt_bake.tracer.walk import (
    AHEAD,
    ARRIVED,
    AT,
    BEFORE,
    BEHIND,
    DIRECTION,
    FACE,
    LOOKED,
    MASK,
    NORMAL,
    ORIGIN,
    ORIGIN_FACE,
    PHASE,
    POSITION,
    REFLECTING,
    SCATTERING,
    SURFACE,
    THROUGHPUT,
    U,
    V,
)

ENTERING = 4
"""The event at x, where every walk is let in; beside SCATTERING, REFLECTING and SURFACE."""


@walk_function()
def is_outermost(boundary: Any, before: Any, after: Any) -> Any:
    """Whether outside lies on either side of a face with these masks before and behind it."""
    return boundary.region_of_mask[before] == 0 or boundary.region_of_mask[after] == 0


@walk_function()
def _received(
    boundary: Any,
    face: Any,
    before: Any,
    after: Any,
    normal: Any,
    u: Any,
    v: Any,
    q: Any,
    d: Any,
    w: Any,
    ray: Any,
) -> Any:
    """f |cos| between a flight d that arrives at q on a face and light from w; 0 where the object hides the light."""
    g = boundary.faces[face]
    if w[0] * g[0] + w[1] * g[1] + w[2] * g[2] <= 0.0:
        return 0.0
    kind, eta = crossing(boundary, face, before, after)
    if kind != ROUGH:
        return 0.0
    through, _density = sent_through(boundary, face, normal, alpha_at(boundary, face, u, v), eta, d, w, False)
    if through > 0.0 and not sees_sky(boundary, face, w):
        near = RAY_EPSILON if boundary.nested else 0.0
        hidden, _t = nearest_hit(boundary.intersect, boundary.scene, ray, q, w, near, np.inf, face)
        if hidden >= 0:
            return 0.0
    return through


@called_function()
def connect_at_surface(
    boundary: Any, state: Any, counts: Any, incident: Any, share: Any, aims: Any, ray: Any, room: Any, value: Any
) -> None:
    """Add to value [D,3] what the walk's arrival at the object's boundary receives; counts[FACE] is the face reached.

    `share` of the directions had a chance to be aimed at from the event before. `room` is for 12 numbers.
    """
    if state[PHASE] == AHEAD or not is_outermost(boundary, counts[BEFORE], counts[BEHIND]):
        return
    count = incident.shape[0]
    fraction = min(count, share) / count * state[LOOKED]
    d = state[DIRECTION : DIRECTION + 3]
    p = state[POSITION : POSITION + 3]
    normal = state[NORMAL : NORMAL + 3]
    for i in range(count):
        w = incident[i]
        weight = _received(
            boundary, counts[FACE], counts[BEFORE], counts[BEHIND], normal, state[U], state[V], p, d, w, ray
        )
        if weight <= 0.0:
            continue
        if state[PHASE] > 0.0:
            has_normal = look_ahead(
                boundary, aims.looks, state[ORIGIN : ORIGIN + 3], w, counts[ORIGIN_FACE], ray, room[0:3], room[6:9]
            )
            lobe = aim_density(boundary, aims.kappa, w, has_normal, room[6:9], d)
            weight *= state[PHASE] / (state[PHASE] + fraction * lobe)
        for c in range(3):
            value[i, c] += state[THROUGHPUT + c] * weight


@called_function()
def connect_ahead(
    boundary: Any,
    media: Any,
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
    """Add to value [D,3] what a walk that the object's boundary has just sent inwards will receive where it meets that
    boundary again without an event in between, and mark it as done.

    That arrival is rare in a thick object and strong. Here it comes in every time, with the flight's transmittance.
    """
    count = incident.shape[0]
    looked = min(count, share)
    fraction = looked / count
    first = 0 if looked == count else int(uniform(stream) * count)
    d = state[DIRECTION : DIRECTION + 3]
    p = state[POSITION : POSITION + 3]
    v, q, normal, kept = room[0:3], room[3:6], room[6:9], room[9:12]
    density = _density_sent(boundary, state, counts, entering)
    state[PHASE] = AHEAD
    face, b1, b2, t, before, after = reach(boundary, ray, p, d, counts[FACE], counts[MASK])
    if face < 0 or not is_outermost(boundary, before, after):
        return
    for c in range(3):
        kept[c] = 1.0 / fraction
    _attenuate_to(boundary, media, state, counts, d, t, counts[MASK], before, ray, stream, kept)
    for k in range(3):
        q[k] = p[k] + t * d[k]
    for j in range(looked):
        i = (first + j * count // looked) % count
        w = incident[i]
        normal_at(boundary, face, b1, b2, normal)
        weight = _received(boundary, face, before, after, normal, b1, b2, q, d, w, ray)
        if weight <= 0.0:
            continue
        has_normal = look_ahead(boundary, aims.looks, p, w, counts[FACE], ray, v, normal)
        lobe = aim_density(boundary, aims.kappa, w, has_normal, normal, d)
        weight *= density / (density + fraction * lobe)
        for c in range(3):
            value[i, c] += state[THROUGHPUT + c] * weight * kept[c]


@walk_function()
def _density_sent(boundary: Any, state: Any, counts: Any, entering: Any) -> Any:
    """By what density the boundary has sent the walk from state[ARRIVED] along its present direction."""
    face = counts[FACE]
    d = state[DIRECTION : DIRECTION + 3]
    arrived = state[ARRIVED : ARRIVED + 3]
    _kind, eta = crossing(boundary, face, counts[BEFORE], counts[BEHIND])
    alpha = alpha_at(boundary, face, state[U], state[V])
    _value, density = sent_through(boundary, face, state[NORMAL : NORMAL + 3], alpha, eta, arrived, d, entering)
    return density


@called_function()
def _attenuate_to(
    boundary: Any,
    media: Any,
    state: Any,
    counts: Any,
    v: Any,
    t: Any,
    mask: Any,
    before: Any,
    ray: Any,
    stream: Any,
    kept: Any,
) -> None:
    """Multiply kept [3] by the transmittance from the walk's place along v to the distance t, where `reach` ended; it
    began with `mask` and ended with `before`.
    """
    p, at = state[POSITION : POSITION + 3], state[AT : AT + 3]
    if not boundary.nested:
        attenuate(media, boundary.region_of_mask[before], p, v, 0.0, t, at, stream, kept)
        return
    march(boundary, media, p, v, counts[FACE], mask, 0.0, t * (1.0 - 1e-6), at, ray, stream, kept)


@called_function()
def connect_aimed(
    boundary: Any,
    media: Any,
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
    """Add to value [D,3] what an event receives by aiming at the object's boundary about each direction.

    `event` is SCATTERING, REFLECTING, SURFACE (the walk has arrived at the object's boundary) or ENTERING. `room` is
    for 12 numbers: the aimed direction, where it meets the boundary, the normal there, and the transmittance.
    """
    count = incident.shape[0]
    looked = min(count, share)
    chance = look_probability(boundary, media, state, counts) if event == SCATTERING else 1.0
    state[LOOKED] = chance
    if chance < 1.0 and uniform(stream) >= chance:
        return
    fraction = looked / count * chance
    first = 0 if looked == count else int(uniform(stream) * count)
    d, p = state[DIRECTION : DIRECTION + 3], state[POSITION : POSITION + 3]
    v, q, normal, kept = room[0:3], room[3:6], room[6:9], room[9:12]
    inside = counts[MASK]
    if event == SURFACE or event == ENTERING:
        inside = counts[BEFORE] if met_from_behind(boundary, counts[FACE], d) else counts[BEHIND]
    for j in range(looked):
        i = (first + j * count // looked) % count
        w = incident[i]
        has_normal = look_ahead(boundary, aims.looks, p, w, counts[FACE], ray, v, normal)
        if not draw_aim(boundary, aims.kappa, w, has_normal, normal, v, stream):
            continue
        lobe = aim_density(boundary, aims.kappa, w, has_normal, normal, v)
        sent, density = _sent_inside(boundary, media, state, counts, event, v)
        if sent <= 0.0:
            continue
        face, b1, b2, t, before, after = reach(boundary, ray, p, v, counts[FACE], inside)
        if face < 0 or not is_outermost(boundary, before, after) or not met_from_behind(boundary, face, v):
            continue
        normal_at(boundary, face, b1, b2, normal)
        for k in range(3):
            q[k] = p[k] + t * v[k]
        through = _received(boundary, face, before, after, normal, b1, b2, q, v, w, ray)
        if through <= 0.0:
            continue
        for c in range(3):
            kept[c] = sent * through / (density + fraction * lobe)
        _attenuate_to(boundary, media, state, counts, v, t, inside, before, ray, stream, kept)
        for c in range(3):
            value[i, c] += state[THROUGHPUT + c] * kept[c]


@walk_function()
def _sent_inside(boundary: Any, media: Any, state: Any, counts: Any, event: Any, v: Any) -> Any:
    """What an event sends along v into the object, and by what density the walk would draw v."""
    if event == SCATTERING or event == REFLECTING:
        sent = sent_by(boundary, media, state, counts, event, v)
        return sent, sent
    face = counts[FACE]
    g = boundary.faces[face]
    if v[0] * g[0] + v[1] * g[1] + v[2] * g[2] >= 0.0:
        return 0.0, 0.0
    _kind, eta = crossing(boundary, face, counts[BEFORE], counts[BEHIND])
    alpha = alpha_at(boundary, face, state[U], state[V])
    return sent_through(
        boundary,
        face,
        state[NORMAL : NORMAL + 3],
        alpha,
        eta,
        state[DIRECTION : DIRECTION + 3],
        v,
        event == ENTERING,
    )
