"""The random walk behind every estimate: from x along −ωo into the object, until it leaves for good.

`begin` writes a walk's initial state at x. `enter` transmits it into the object. `advance` flies to the next event: a
scattering, a dielectric boundary, a diffuse surface, or the sky. `scatter`, `cross` and `bounce` sample the event. An
estimator is a loop over these functions. Index-matched boundaries are no events: `advance` flies through them.

The face that a walk hits decides on which side of it the walk was: a face hit from behind was reached from inside. The
next hit thus corrects a ray that slipped through an edge, and energy is conserved on any mesh.
"""

import math
from typing import Any

import numpy as np

from prt_bake.jit.kernel_functions import called_function, inlined_function
from prt_bake.mathematics.counter import uniform
from prt_bake.tracer.surface.boundary import (
    DIFFUSE,
    OPAQUE,
    PASS,
    alpha_at,
    facing_normal,
    hits_back,
    interface_at,
    is_compensated,
    mask_before,
    next_face,
    normal_at,
    part_of,
    point_on_face,
    reflectance_at,
    resolve_hit,
    sees_sky,
)
from prt_bake.tracer.surface.compensation import sample_compensated
from prt_bake.tracer.surface.interface import MATCHED, ROUGH, sample_interface
from prt_bake.tracer.surface.nearby_faces import clearance_at, nearby_hit
from prt_bake.tracer.volume.media import CHROMATIC, MAJORANT, PHASE_G, multiply_albedo, phase, phase_cosine
from prt_bake.tracer.volume.tracking import flight_by_channel, free_flight

SCATTERING, SURFACE, SKY, REFLECTING = 0, 1, 2, 3
POSITION, DIRECTION, THROUGHPUT, NORMAL, DENSITY, SCRATCH, LOST, INITIAL, ORIGIN, INCOMING = (
    0,
    3,
    6,
    9,
    12,
    13,
    16,
    17,
    18,
    21,
)
U, V, CONNECTION_PROBABILITY, CLEARANCE = 24, 25, 26, 27
STATE_SIZE = 32
"""Fields of `state` (float64). DENSITY: of the sampled direction, per solid angle. SCRATCH: space for a point. LOST:
throughput of a truncated walk. INITIAL: throughput after entering. ORIGIN: where the present flight began. INCOMING:
direction of flight before the last dielectric boundary. U, V: barycentric coordinates on the face.
CONNECTION_PROBABILITY: with which the last event connected to the light. CLEARANCE: no face is nearer than this."""
FACE, MASK, EVENTS, SCATTERED, BEFORE, BEHIND, ORIGIN_FACE = 0, 1, 2, 3, 4, 5, 6
COUNTS_SIZE = 8
"""Fields of `counts` (int64): face (−1: none), mask of the parts that contain the walk, events, events that scatter,
the masks before and behind the face, and the face where the present flight began."""
ALREADY_COUNTED = -1.0
"""Value of state[DENSITY]: the contribution of the next arrival at the object's boundary is already counted."""
_ESCAPE_CHECK_EVERY = 8
_WEIGHT_WINDOW = 0.1


@inlined_function()
def _distance_in_ball(p: Any, d: Any, radius: Any) -> Any:
    """Distance at which p + t d leaves the object's bounding ball."""
    along = p[0] * d[0] + p[1] * d[1] + p[2] * d[2]
    squared = p[0] * p[0] + p[1] * p[1] + p[2] * p[2] - radius * radius
    root = along * along - squared
    if root <= 0.0:
        return 0.0
    return max(0.0, -along + math.sqrt(root))


@inlined_function()
def frame(nx: Any, ny: Any, nz: Any) -> Any:
    """Two unit vectors orthogonal to n and to each other (Duff et al. 2017)."""
    sign = math.copysign(1.0, nz)
    a = -1.0 / (sign + nz)
    b = nx * ny * a
    return 1.0 + sign * nx * nx * a, sign * b, -sign * nx, b, sign + ny * ny * a, -ny


@inlined_function()
def region_of(boundary: Any, counts: Any) -> Any:
    """The region that contains the walk."""
    return boundary.region_of_mask[counts[MASK]]


@called_function()
def begin(
    boundary: Any, state: Any, counts: Any, position: Any, outgoing: Any, face: Any, u: Any, v: Any, mask: Any
) -> None:
    """Write the state of a walk of throughput 1 that starts at `position` on `face` along −`outgoing`, outside.

    `mask` holds the inner parts that contain x too (`containing_parts`).
    """
    for k in range(3):
        state[POSITION + k] = position[k]
        state[DIRECTION + k] = -outgoing[k]
        state[THROUGHPUT + k] = 1.0
    state[LOST], state[DENSITY], state[U], state[V], state[CLEARANCE] = 0.0, 0.0, u, v, 0.0
    normal_at(boundary, face, u, v, state[NORMAL : NORMAL + 3])
    counts[FACE], counts[MASK], counts[EVENTS], counts[SCATTERED] = face, mask, 0, 0
    counts[BEFORE], counts[BEHIND], counts[ORIGIN_FACE] = mask, mask | 1 << part_of(boundary, face), -1


@called_function()
def view_clearance(boundary: Any, position: Any, outgoing: Any, face: Any, inward: Any, ray: Any) -> Any:
    """Distance from x along −ωo to the next face, behind an index-matched boundary; else 0. It is the initial
    clearance.

    `inward` is scratch space [3].
    """
    if boundary.kind != MATCHED:
        return 0.0
    for k in range(3):
        inward[k] = -outgoing[k]
    met, t = next_face(boundary, ray, position, inward, 0.0, np.inf, face)
    return t if met >= 0 and hits_back(boundary, met, inward) else 0.0


@inlined_function()
def enter(boundary: Any, state: Any, counts: Any, stream: Any) -> bool:
    """Transmit a walk into the object and weight it by the transmittance at x. False if it ends there."""
    kind, _eta = interface_at(boundary, counts[FACE], counts[BEFORE], counts[BEHIND])
    enters = True
    if kind == MATCHED:
        counts[MASK] = counts[BEHIND]
        for k in range(3):
            state[INCOMING + k] = state[DIRECTION + k]
    elif kind == DIFFUSE:
        # A diffuse part coincides with the object's surface: no light passes below it.
        enters = False
    else:
        enters = cross(boundary, state, counts, True, stream)
    state[INITIAL] = max(state[THROUGHPUT], max(state[THROUGHPUT + 1], state[THROUGHPUT + 2]))
    return enters


@inlined_function()
def advance(boundary: Any, media: Any, state: Any, counts: Any, ray: Any, stream: Any) -> Any:
    """Fly to the next event: SCATTERING in a medium, SURFACE at a dielectric boundary, REFLECTING at a diffuse surface,
    or SKY outside.
    """
    p = state[POSITION : POSITION + 3]
    while True:
        region = region_of(boundary, counts)
        majorant = media.regions[region, MAJORANT]
        if counts[FACE] >= 0 and sees_sky(boundary, counts[FACE], state[DIRECTION : DIRECTION + 3]):
            return SKY
        if majorant <= 0.0:
            flight, face = _to_next_face(boundary, state, counts, ray)
        elif media.regions[region, CHROMATIC] != 0.0:
            flight, face = _fly_by_channel(boundary, media, region, state, counts, ray, stream)
        else:
            flight, face = _fly(boundary, media, region, state, counts, ray, stream)
        if face >= 0:
            d = state[DIRECTION : DIRECTION + 3]
            face, u, v, before, after = resolve_hit(boundary, ray, p, d, flight, face, counts[MASK])
            if boundary.region_of_mask[before] != region:
                counts[MASK] = before
                continue
            kind = _arrive(boundary, state, counts, face, u, v, before, after)
            if kind == OPAQUE:
                for c in range(3):
                    state[THROUGHPUT + c] = 0.0
                return SKY
            if kind == DIFFUSE:
                counts[EVENTS] += 1
                counts[SCATTERED] += 1
                return REFLECTING
            if kind >= 0:
                return SURFACE
            continue
        if flight == np.inf:
            return SKY
        d = state[DIRECTION : DIRECTION + 3]
        for k in range(3):
            p[k] += flight * d[k]
        state[CLEARANCE] = clearance_at(boundary, p)
        counts[FACE] = -1
        counts[EVENTS] += 1
        counts[SCATTERED] += 1
        multiply_albedo(media, region, p, state[THROUGHPUT : THROUGHPUT + 3])
        return SCATTERING


@inlined_function()
def _to_next_face(boundary: Any, state: Any, counts: Any, ray: Any) -> Any:
    """Distance and face of the next hit through a vacuum; (inf, −1) for the sky."""
    p, d = state[POSITION : POSITION + 3], state[DIRECTION : DIRECTION + 3]
    face, t = next_face(boundary, ray, p, d, 0.0, np.inf, counts[FACE])
    return t, face


@inlined_function()
def _fly(boundary: Any, media: Any, region: Any, state: Any, counts: Any, ray: Any, stream: Any) -> Any:
    """(Distance, −1) for a scattering event, (distance, face) for a face hit before it, or (inf, −1) for the sky."""
    p = state[POSITION : POSITION + 3]
    d = state[DIRECTION : DIRECTION + 3]
    ball = _distance_in_ball(p, d, boundary.radius)
    flight = free_flight(media, region, p, d, ball, state[SCRATCH : SCRATCH + 3], stream)
    if flight < state[CLEARANCE]:
        return flight, -1
    face, t, u, v, inside = nearby_hit(boundary, p, d, counts[FACE])
    if inside and flight < t:
        return flight, -1
    if inside and face >= 0:
        ray[15], ray[16] = u, v
        return t, face
    far = flight
    if counts[EVENTS] % _ESCAPE_CHECK_EVERY == 0:
        far = np.inf
    face, t = next_face(boundary, ray, p, d, 0.0, far, counts[FACE])
    if face < 0:
        return (np.inf if far == np.inf else flight), -1
    if t <= flight or boundary.region_of_mask[mask_before(boundary, face, d, counts[MASK])] != region:
        return t, face
    return flight, -1


@called_function()
def _fly_by_channel(boundary: Any, media: Any, region: Any, state: Any, counts: Any, ray: Any, stream: Any) -> Any:
    """`_fly` for extinction that differs between channels. Arrivals at a face are weighted too, so it traces first."""
    p = state[POSITION : POSITION + 3]
    d = state[DIRECTION : DIRECTION + 3]
    face, t = next_face(boundary, ray, p, d, 0.0, np.inf, counts[FACE])
    if face < 0:
        return np.inf, -1
    if boundary.region_of_mask[mask_before(boundary, face, d, counts[MASK])] != region:
        return t, face
    flight = flight_by_channel(
        media, region, p, d, t, state[THROUGHPUT : THROUGHPUT + 3], state[SCRATCH : SCRATCH + 3], stream
    )
    if flight < t:
        return flight, -1
    return t, face


@inlined_function()
def _arrive(boundary: Any, state: Any, counts: Any, face: Any, u: Any, v: Any, before: Any, after: Any) -> Any:
    """Move the walk to (u, v) of a face, which is more exact than p + t d. Returns the kind of interface there, PASS if
    the walk flies straight on.
    """
    point_on_face(boundary, face, u, v, state[POSITION : POSITION + 3])
    state[CLEARANCE] = 0.0
    kind, _eta = interface_at(boundary, face, before, after)
    counts[FACE] = face
    if kind == PASS or kind == MATCHED:
        counts[MASK] = after
        return PASS
    counts[MASK], counts[BEFORE], counts[BEHIND] = before, before, after
    state[U], state[V] = u, v
    normal_at(boundary, face, u, v, state[NORMAL : NORMAL + 3])
    if kind == DIFFUSE:
        part = boundary.region_of_mask[after] - 1
        for k in range(3):
            state[THROUGHPUT + k] *= reflectance_at(boundary, face, part, u, v, k)
    return kind


@called_function()
def cross(boundary: Any, state: Any, counts: Any, transmit_only: Any, stream: Any) -> bool:
    """Sample reflection or refraction at the dielectric boundary that the walk has reached. False if it ends there.

    Keeps the direction of flight before the event in state[INCOMING].
    """
    d = state[DIRECTION : DIRECTION + 3]
    for k in range(3):
        state[INCOMING + k] = d[k]
    counts[EVENTS] += 1
    state[DENSITY] = 0.0
    face = counts[FACE]
    kind, eta = interface_at(boundary, face, counts[BEFORE], counts[BEHIND])
    if kind == ROUGH:
        counts[SCATTERED] += 1
    nx, ny, nz = facing_normal(boundary, face, state[NORMAL : NORMAL + 3], d)
    sx, sy, sz, tx, ty, tz = frame(nx, ny, nz)
    ix = -(d[0] * sx + d[1] * sy + d[2] * sz)
    iy = -(d[0] * tx + d[1] * ty + d[2] * tz)
    iz = -(d[0] * nx + d[1] * ny + d[2] * nz)
    alpha = alpha_at(boundary, face, state[U], state[V])
    if kind == ROUGH and is_compensated(boundary, face):
        ox, oy, oz, weight = sample_compensated(boundary.losses, alpha, eta, ix, iy, iz, transmit_only, stream)
    else:
        ox, oy, oz, weight = sample_interface(kind, alpha, eta, ix, iy, iz, transmit_only, stream)
    if weight <= 0.0:
        return False
    g = boundary.faces[face]
    before = d[0] * g[0] + d[1] * g[1] + d[2] * g[2]
    x, y, z = ox * sx + oy * tx + oz * nx, ox * sy + oy * ty + oz * ny, ox * sz + oy * tz + oz * nz
    scale = 1.0 / math.sqrt(x * x + y * y + z * z)
    d[0], d[1], d[2] = x * scale, y * scale, z * scale
    behind = d[0] * g[0] + d[1] * g[1] + d[2] * g[2]
    crossed = oz < 0.0
    if (before * behind > 0.0) != crossed:
        return False
    if crossed:
        counts[MASK] = counts[BEHIND]
    for c in range(3):
        state[THROUGHPUT + c] *= weight
    return True


@inlined_function()
def _set_direction(state: Any, counts: Any, x: Any, y: Any, z: Any, density: Any) -> None:
    """Set the direction of flight to (x, y, z), sampled with `density`, and record where the flight begins."""
    scale = 1.0 / math.sqrt(x * x + y * y + z * z)
    state[DIRECTION], state[DIRECTION + 1], state[DIRECTION + 2] = x * scale, y * scale, z * scale
    state[DENSITY] = density
    for k in range(3):
        state[ORIGIN + k] = state[POSITION + k]
    counts[ORIGIN_FACE] = counts[FACE]


@inlined_function()
def scatter(boundary: Any, media: Any, state: Any, counts: Any, stream: Any) -> None:
    """Sample a direction from the phase function; its density goes to state[DENSITY], its origin to state[ORIGIN]."""
    d = state[DIRECTION : DIRECTION + 3]
    g = media.regions[region_of(boundary, counts), PHASE_G]
    cosine = phase_cosine(g, uniform(stream))
    sine = math.sqrt(max(0.0, 1.0 - cosine * cosine))
    angle = 2.0 * math.pi * uniform(stream)
    sx, sy, sz, tx, ty, tz = frame(d[0], d[1], d[2])
    a, b = sine * math.cos(angle), sine * math.sin(angle)
    _set_direction(
        state,
        counts,
        a * sx + b * tx + cosine * d[0],
        a * sy + b * ty + cosine * d[1],
        a * sz + b * tz + cosine * d[2],
        phase(cosine, g),
    )


@called_function()
def bounce(boundary: Any, state: Any, counts: Any, stream: Any) -> None:
    """Sample a cosine-distributed direction at a diffuse surface; density and origin are stored as by `scatter`."""
    nx, ny, nz = facing_normal(boundary, counts[FACE], state[NORMAL : NORMAL + 3], state[DIRECTION : DIRECTION + 3])
    squared = uniform(stream)
    r, cosine = math.sqrt(squared), math.sqrt(1.0 - squared)
    angle = 2.0 * math.pi * uniform(stream)
    sx, sy, sz, tx, ty, tz = frame(nx, ny, nz)
    a, b = r * math.cos(angle), r * math.sin(angle)
    _set_direction(
        state,
        counts,
        a * sx + b * tx + cosine * nx,
        a * sy + b * ty + cosine * ny,
        a * sz + b * tz + cosine * nz,
        cosine / math.pi,
    )


@inlined_function()
def survives_roulette(boundary: Any, state: Any, counts: Any, stream: Any) -> bool:
    """Russian roulette on walks whose throughput has fallen far below the initial one. False if the walk ends.

    After `most_events` events a walk is truncated and its throughput is recorded as lost.
    """
    largest = max(state[THROUGHPUT], max(state[THROUGHPUT + 1], state[THROUGHPUT + 2]))
    if largest <= 0.0:
        return False
    if counts[EVENTS] >= boundary.most_events:
        state[LOST] = largest
        return False
    if largest < _WEIGHT_WINDOW * state[INITIAL]:
        survival = largest / (3.0 * _WEIGHT_WINDOW * state[INITIAL])
        if uniform(stream) >= survival:
            return False
        for c in range(3):
            state[THROUGHPUT + c] /= survival
    return True
