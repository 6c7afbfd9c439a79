"""Next-event estimation through a rough outer boundary.

Two sampling techniques are combined by the balance heuristic (Veach 1997). The walk's next arrival at the boundary
connects to the light through the interface, and the event before it samples a direction to the boundary
(`prt_bake.tracer.next_event`). Such an event is a scattering, a diffuse surface, or the boundary itself where it sends
the walk inwards: refraction at x, internal reflection, re-entry. Interfaces further inside sample no such direction:
their light counts at the next arrival.
"""

from typing import Any

import numpy as np

from prt_bake.geometry.embree import nearest_hit
from prt_bake.jit.kernel_functions import called_function, inlined_function
from prt_bake.mathematics.counter import uniform
from prt_bake.tracer.connect import connection_probability, interface_transport, march, scattering_density
from prt_bake.tracer.next_event import boundary_normal, next_event_density, sample_next_event
from prt_bake.tracer.surface.boundary import (
    RAY_EPSILON,
    alpha_at,
    hits_back,
    interface_at,
    next_interface,
    normal_at,
    sees_sky,
)
from prt_bake.tracer.surface.interface import ROUGH
from prt_bake.tracer.volume.tracking import attenuate
from prt_bake.tracer.walk import (
    ALREADY_COUNTED,
    BEFORE,
    BEHIND,
    CONNECTION_PROBABILITY,
    DENSITY,
    DIRECTION,
    FACE,
    INCOMING,
    MASK,
    NORMAL,
    ORIGIN,
    ORIGIN_FACE,
    POSITION,
    REFLECTING,
    SCATTERING,
    SCRATCH,
    SURFACE,
    THROUGHPUT,
    U,
    V,
)

ENTERING = 4
"""The event at x, where walks enter; one more kind beside SCATTERING, REFLECTING and SURFACE."""


@inlined_function()
def is_outermost(boundary: Any, before: Any, after: Any) -> Any:
    """Whether a face with these masks before and behind it borders on the outside."""
    return boundary.region_of_mask[before] == 0 or boundary.region_of_mask[after] == 0


@inlined_function()
def _transport_to_light(
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
    """f |cos| between a flight d that arrives at q on a face and light from w; 0 if the object occludes the light."""
    g = boundary.faces[face]
    if w[0] * g[0] + w[1] * g[1] + w[2] * g[2] <= 0.0:
        return 0.0
    kind, eta = interface_at(boundary, face, before, after)
    if kind != ROUGH:
        return 0.0
    through, _density = interface_transport(boundary, face, normal, alpha_at(boundary, face, u, v), eta, d, w, False)
    if through > 0.0 and not sees_sky(boundary, face, w):
        near = RAY_EPSILON if boundary.nested else 0.0
        hidden, _t = nearest_hit(boundary.intersect, boundary.scene, ray, q, w, near, np.inf, face)
        if hidden >= 0:
            return 0.0
    return through


@called_function()
def connect_arrival(
    boundary: Any,
    state: Any,
    counts: Any,
    incident: Any,
    connections: Any,
    next_event: Any,
    ray: Any,
    scratch: Any,
    value: Any,
) -> None:
    """Add to value [D,3] the light that the walk receives at its arrival on the object's boundary, face counts[FACE].

    The event before connected to `connections` of the D directions. `scratch` is space [12].
    """
    if state[DENSITY] == ALREADY_COUNTED or not is_outermost(boundary, counts[BEFORE], counts[BEHIND]):
        return
    count = incident.shape[0]
    fraction = min(count, connections) / count * state[CONNECTION_PROBABILITY]
    d = state[DIRECTION : DIRECTION + 3]
    p = state[POSITION : POSITION + 3]
    normal = state[NORMAL : NORMAL + 3]
    for i in range(count):
        w = incident[i]
        weight = _transport_to_light(
            boundary, counts[FACE], counts[BEFORE], counts[BEHIND], normal, state[U], state[V], p, d, w, ray
        )
        if weight <= 0.0:
            continue
        if state[DENSITY] > 0.0:
            has_normal = boundary_normal(
                boundary,
                next_event.normal_steps,
                state[ORIGIN : ORIGIN + 3],
                w,
                counts[ORIGIN_FACE],
                ray,
                scratch[0:3],
                scratch[6:9],
            )
            light_density = next_event_density(boundary, next_event.kappa, w, has_normal, scratch[6:9], d)
            weight *= state[DENSITY] / (state[DENSITY] + fraction * light_density)
        for c in range(3):
            value[i, c] += state[THROUGHPUT + c] * weight


@called_function()
def connect_next_arrival(
    boundary: Any,
    media: Any,
    state: Any,
    counts: Any,
    incident: Any,
    connections: Any,
    next_event: Any,
    ray: Any,
    scratch: Any,
    entering: Any,
    stream: Any,
    value: Any,
) -> None:
    """Add to value [D,3] the expected light of a walk's unscattered return to the object's boundary, which has just
    sent it inwards, and mark that return as counted.

    In a thick object such a return is rare and strong. Here every walk counts it, times the transmittance of the
    flight.
    """
    count = incident.shape[0]
    connected = min(count, connections)
    fraction = connected / count
    first = 0 if connected == count else int(uniform(stream) * count)
    d = state[DIRECTION : DIRECTION + 3]
    p = state[POSITION : POSITION + 3]
    v, q, normal, transmittance = scratch[0:3], scratch[3:6], scratch[6:9], scratch[9:12]
    density = _crossing_density(boundary, state, counts, entering)
    state[DENSITY] = ALREADY_COUNTED
    face, b1, b2, t, before, after = next_interface(boundary, ray, p, d, counts[FACE], counts[MASK])
    if face < 0 or not is_outermost(boundary, before, after):
        return
    for c in range(3):
        transmittance[c] = 1.0 / fraction
    _attenuate_to(boundary, media, state, counts, d, t, counts[MASK], before, ray, stream, transmittance)
    for k in range(3):
        q[k] = p[k] + t * d[k]
    for j in range(connected):
        i = (first + j * count // connected) % count
        w = incident[i]
        normal_at(boundary, face, b1, b2, normal)
        weight = _transport_to_light(boundary, face, before, after, normal, b1, b2, q, d, w, ray)
        if weight <= 0.0:
            continue
        has_normal = boundary_normal(boundary, next_event.normal_steps, p, w, counts[FACE], ray, v, normal)
        light_density = next_event_density(boundary, next_event.kappa, w, has_normal, normal, d)
        weight *= density / (density + fraction * light_density)
        for c in range(3):
            value[i, c] += state[THROUGHPUT + c] * weight * transmittance[c]


@inlined_function()
def _crossing_density(boundary: Any, state: Any, counts: Any, entering: Any) -> Any:
    """Density with which the boundary sampled the present direction of flight from state[INCOMING]."""
    face = counts[FACE]
    d = state[DIRECTION : DIRECTION + 3]
    arrived = state[INCOMING : INCOMING + 3]
    _kind, eta = interface_at(boundary, face, counts[BEFORE], counts[BEHIND])
    alpha = alpha_at(boundary, face, state[U], state[V])
    _value, density = interface_transport(boundary, face, state[NORMAL : NORMAL + 3], alpha, eta, arrived, d, entering)
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
    transmittance: Any,
) -> None:
    """Multiply transmittance [3] by that from the walk's position along v to the distance t that `next_interface`
    found, from inside the parts of `mask` to inside those of `before`.
    """
    p, point = state[POSITION : POSITION + 3], state[SCRATCH : SCRATCH + 3]
    if not boundary.nested:
        attenuate(media, boundary.region_of_mask[before], p, v, 0.0, t, point, stream, transmittance)
        return
    march(boundary, media, p, v, counts[FACE], mask, 0.0, t * (1.0 - 1e-6), point, ray, stream, transmittance)


@called_function()
def connect_next_event(
    boundary: Any,
    media: Any,
    state: Any,
    counts: Any,
    incident: Any,
    connections: Any,
    next_event: Any,
    ray: Any,
    scratch: Any,
    event: Any,
    stream: Any,
    value: Any,
) -> None:
    """Add to value [D,3] the light that an event receives through the object's boundary by next-event estimation.

    `event` is SCATTERING, REFLECTING, SURFACE (the walk has arrived at the object's boundary) or ENTERING. `scratch` is
    space [12] for the sampled direction, the point on the boundary, the normal there, and the contribution.
    """
    count = incident.shape[0]
    connected = min(count, connections)
    probability = connection_probability(boundary, media, state, counts) if event == SCATTERING else 1.0
    state[CONNECTION_PROBABILITY] = probability
    if probability < 1.0 and uniform(stream) >= probability:
        return
    fraction = connected / count * probability
    first = 0 if connected == count else int(uniform(stream) * count)
    d, p = state[DIRECTION : DIRECTION + 3], state[POSITION : POSITION + 3]
    v, q, normal, contribution = scratch[0:3], scratch[3:6], scratch[6:9], scratch[9:12]
    inside = counts[MASK]
    if event == SURFACE or event == ENTERING:
        inside = counts[BEFORE] if hits_back(boundary, counts[FACE], d) else counts[BEHIND]
    for j in range(connected):
        i = (first + j * count // connected) % count
        w = incident[i]
        has_normal = boundary_normal(boundary, next_event.normal_steps, p, w, counts[FACE], ray, v, normal)
        if not sample_next_event(boundary, next_event.kappa, w, has_normal, normal, v, stream):
            continue
        light_density = next_event_density(boundary, next_event.kappa, w, has_normal, normal, v)
        scattered, density = _transport_inwards(boundary, media, state, counts, event, v)
        if scattered <= 0.0:
            continue
        face, b1, b2, t, before, after = next_interface(boundary, ray, p, v, counts[FACE], inside)
        if face < 0 or not is_outermost(boundary, before, after) or not hits_back(boundary, face, v):
            continue
        normal_at(boundary, face, b1, b2, normal)
        for k in range(3):
            q[k] = p[k] + t * v[k]
        through = _transport_to_light(boundary, face, before, after, normal, b1, b2, q, v, w, ray)
        if through <= 0.0:
            continue
        for c in range(3):
            contribution[c] = scattered * through / (density + fraction * light_density)
        _attenuate_to(boundary, media, state, counts, v, t, inside, before, ray, stream, contribution)
        for c in range(3):
            value[i, c] += state[THROUGHPUT + c] * contribution[c]


@inlined_function()
def _transport_inwards(boundary: Any, media: Any, state: Any, counts: Any, event: Any, v: Any) -> Any:
    """Scattered density along v into the object, and the density with which the walk samples v."""
    if event == SCATTERING or event == REFLECTING:
        scattered = scattering_density(boundary, media, state, counts, event, v)
        return scattered, scattered
    face = counts[FACE]
    g = boundary.faces[face]
    if v[0] * g[0] + v[1] * g[1] + v[2] * g[2] >= 0.0:
        return 0.0, 0.0
    _kind, eta = interface_at(boundary, face, counts[BEFORE], counts[BEHIND])
    alpha = alpha_at(boundary, face, state[U], state[V])
    return interface_transport(
        boundary,
        face,
        state[NORMAL : NORMAL + 3],
        alpha,
        eta,
        state[DIRECTION : DIRECTION + 3],
        v,
        event == ENTERING,
    )
