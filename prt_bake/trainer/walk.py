"""The random walk that everything is estimated with: from x along −ωo into the object, until it leaves for good.

A walk is a row of numbers (`state`) that `begin` sets at x and three functions move on: `enter` lets it in, `advance`
flies to the next event (a scattering, the boundary, or the sky), `scatter` and `cross` choose what happens there. An
estimator is a loop over them that reads what it wants at each event.

The walker's side is decided by the face it meets: what is met from behind was flown through inside. A ray that slips
through an edge is therefore put right by the next face it meets, and energy is kept whatever the mesh.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from prt_bake.trainer.compiled import walk_function
from prt_bake.trainer.counter import uniform
from prt_bake.trainer.embree import nearest_hit
from prt_bake.trainer.interface import MATCHED, sample_interface
from prt_bake.trainer.media import free_flight, multiply_albedo, phase, phase_cosine

SCATTERING, SURFACE, SKY = 0, 1, 2
POSITION, DIRECTION, THROUGHPUT, NORMAL, PHASE, AT, LOST, BEGUN, ORIGIN, ARRIVED = 0, 3, 6, 9, 12, 13, 16, 17, 18, 21
STATE_SIZE = 24
FACE, INSIDE, EVENTS, SCATTERED = 0, 1, 2, 3
COUNTS_SIZE = 4
AHEAD = -1.0
"""In state[PHASE]: what the next arrival at the boundary receives is counted already."""
_LOOK_OUT_EVERY = 8
_WEIGHT_WINDOW = 0.1
CLEARANCE = 1e-6
"""How far a ray that starts on a face must fly before it may meet another one: some ten roundings of a position, so
that at a vertex no walk is handed to and fro between faces that all lie at distance 0."""


class Boundary(NamedTuple):
    """The object's surface as the kernels take it; lengths in units of its longest side, about its centre."""

    intersect: int
    scene: int
    positions: NDArray[np.float64]
    faces: NDArray[np.int64]
    face_normals: NDArray[np.float64]
    vertex_normals: NDArray[np.float64]
    interpolate_normals: bool
    kind: int
    alpha: float
    eta: float
    radius: float
    """A ball about the origin of this radius holds the object."""
    most_events: int
    """A walk ends after so many events; what it still carried is counted as lost and reported."""


@walk_function(inline="always")
def _towards_box(p: Any, d: Any, radius: Any) -> Any:
    """How far p + t d stays in the ball of the object (an upper bound for every crossing)."""
    along = p[0] * d[0] + p[1] * d[1] + p[2] * d[2]
    squared = p[0] * p[0] + p[1] * p[1] + p[2] * p[2] - radius * radius
    root = along * along - squared
    if root <= 0.0:
        return 0.0
    return max(0.0, -along + math.sqrt(root))


@walk_function()
def normal_at(boundary: Any, face: Any, u: Any, v: Any, normal: Any) -> None:
    """Write the interface's normal at (u, v) of a face: the face's own, or the interpolated one where it is asked
    for.
    """
    for k in range(3):
        normal[k] = boundary.face_normals[face, k]
    if not boundary.interpolate_normals:
        return
    a, b, c = boundary.faces[face, 0], boundary.faces[face, 1], boundary.faces[face, 2]
    n = boundary.vertex_normals
    x = (1.0 - u - v) * n[a, 0] + u * n[b, 0] + v * n[c, 0]
    y = (1.0 - u - v) * n[a, 1] + u * n[b, 1] + v * n[c, 1]
    z = (1.0 - u - v) * n[a, 2] + u * n[b, 2] + v * n[c, 2]
    length = math.sqrt(x * x + y * y + z * z)
    if length > 1e-6:
        normal[0], normal[1], normal[2] = x / length, y / length, z / length


@walk_function(inline="always")
def frame(nx: Any, ny: Any, nz: Any) -> Any:
    """Two unit vectors across n (Duff et al. 2017)."""
    sign = math.copysign(1.0, nz)
    a = -1.0 / (sign + nz)
    b = nx * ny * a
    return 1.0 + sign * nx * nx * a, sign * b, -sign * nx, b, sign + ny * ny * a, -ny


@walk_function()
def facing_normal(boundary: Any, face: Any, normal: Any, d: Any) -> Any:
    """The interface normal turned to the side that d comes from, and 1/eta or eta of the crossing.

    An interpolated normal that d sees from the wrong side gives way to the face's own.
    """
    g = boundary.face_normals[face]
    geometric = d[0] * g[0] + d[1] * g[1] + d[2] * g[2]
    sign = -1.0 if geometric > 0.0 else 1.0
    eta = 1.0 / boundary.eta if geometric > 0.0 else boundary.eta
    x, y, z = sign * normal[0], sign * normal[1], sign * normal[2]
    if -(d[0] * x + d[1] * y + d[2] * z) <= 1e-9:
        x, y, z = sign * g[0], sign * g[1], sign * g[2]
    return x, y, z, eta


@walk_function()
def cross(boundary: Any, state: Any, counts: Any, transmit_only: Any, stream: Any) -> bool:
    """Take the interface's event at the face that the walk has reached; False where the walk ends there.

    The direction of flight before it stays in state[ARRIVED].
    """
    d = state[DIRECTION : DIRECTION + 3]
    for k in range(3):
        state[ARRIVED + k] = d[k]
    counts[EVENTS] += 1
    state[PHASE] = 0.0
    if boundary.kind == MATCHED:
        counts[INSIDE] = 1 - counts[INSIDE]
        return True
    face = counts[FACE]
    nx, ny, nz, eta = facing_normal(boundary, face, state[NORMAL : NORMAL + 3], d)
    sx, sy, sz, tx, ty, tz = frame(nx, ny, nz)
    ix = -(d[0] * sx + d[1] * sy + d[2] * sz)
    iy = -(d[0] * tx + d[1] * ty + d[2] * tz)
    iz = -(d[0] * nx + d[1] * ny + d[2] * nz)
    ox, oy, oz, weight = sample_interface(boundary.kind, boundary.alpha, eta, ix, iy, iz, transmit_only, stream)
    if weight <= 0.0:
        return False
    g = boundary.face_normals[face]
    before = d[0] * g[0] + d[1] * g[1] + d[2] * g[2]
    x, y, z = ox * sx + oy * tx + oz * nx, ox * sy + oy * ty + oz * ny, ox * sz + oy * tz + oz * nz
    scale = 1.0 / math.sqrt(x * x + y * y + z * z)
    d[0], d[1], d[2] = x * scale, y * scale, z * scale
    after = d[0] * g[0] + d[1] * g[1] + d[2] * g[2]
    crossed = oz < 0.0
    if (before * after > 0.0) != crossed:
        return False
    if crossed:
        counts[INSIDE] = 1 - counts[INSIDE]
    for c in range(3):
        state[THROUGHPUT + c] *= weight
    return True


@walk_function()
def begin(boundary: Any, state: Any, counts: Any, position: Any, outgoing: Any, face: Any, u: Any, v: Any) -> None:
    """Set a walk of throughput 1 at `position` on `face`, seen from `outgoing`, before it is let in."""
    for k in range(3):
        state[POSITION + k] = position[k]
        state[DIRECTION + k] = -outgoing[k]
        state[THROUGHPUT + k] = 1.0
    state[LOST] = 0.0
    normal_at(boundary, face, u, v, state[NORMAL : NORMAL + 3])
    counts[FACE], counts[INSIDE], counts[EVENTS], counts[SCATTERED] = face, 0, 0, 0


@walk_function()
def enter(boundary: Any, state: Any, counts: Any, stream: Any) -> bool:
    """Let a walk in: the transmission inwards is its first weight. False where it ends there."""
    enters = cross(boundary, state, counts, True, stream)
    state[BEGUN] = state[THROUGHPUT]
    return enters


@walk_function()
def advance(boundary: Any, medium: Any, state: Any, counts: Any, ray: Any, stream: Any) -> Any:
    """Fly to the next event: SCATTERING at a point inside, SURFACE at a face, or SKY where nothing is met any more."""
    p = state[POSITION : POSITION + 3]
    d = state[DIRECTION : DIRECTION + 3]
    at = state[AT : AT + 3]
    near = CLEARANCE if counts[FACE] >= 0 else 0.0
    if counts[INSIDE] == 0:
        face, t = nearest_hit(boundary.intersect, boundary.scene, ray, p, d, near, np.inf, counts[FACE])
        if face < 0:
            return SKY
        if not _met_from_behind(boundary, face, d):
            _move_to_face(boundary, state, counts, ray, face)
            return SURFACE
        counts[INSIDE] = 1
    flight = free_flight(medium, p, d, _towards_box(p, d, boundary.radius), at, stream)
    far = flight
    if counts[EVENTS] % _LOOK_OUT_EVERY == 0:
        far = np.inf
    face, t = nearest_hit(boundary.intersect, boundary.scene, ray, p, d, near, max(far, near), counts[FACE])
    if face < 0 and far == np.inf:
        return SKY
    if face >= 0 and (t <= flight or not _met_from_behind(boundary, face, d)):
        _move_to_face(boundary, state, counts, ray, face)
        return SURFACE
    for k in range(3):
        p[k] += flight * d[k]
    counts[FACE] = -1
    counts[EVENTS] += 1
    counts[SCATTERED] += 1
    multiply_albedo(medium, p, state[THROUGHPUT : THROUGHPUT + 3])
    return SCATTERING


@walk_function(inline="always")
def _met_from_behind(boundary: Any, face: Any, d: Any) -> Any:
    g = boundary.face_normals[face]
    return d[0] * g[0] + d[1] * g[1] + d[2] * g[2] > 0.0


@walk_function()
def _move_to_face(boundary: Any, state: Any, counts: Any, ray: Any, face: Any) -> None:
    """Set the walk on the face that `ray` has met, by barycentric coordinates (more exact than p + t d)."""
    u, v = np.float64(ray[15]), np.float64(ray[16])
    a, b, c = boundary.faces[face, 0], boundary.faces[face, 1], boundary.faces[face, 2]
    for k in range(3):
        state[POSITION + k] = (
            (1.0 - u - v) * boundary.positions[a, k] + u * boundary.positions[b, k] + v * boundary.positions[c, k]
        )
    normal_at(boundary, face, u, v, state[NORMAL : NORMAL + 3])
    counts[FACE] = face
    counts[INSIDE] = 1 if _met_from_behind(boundary, face, state[DIRECTION : DIRECTION + 3]) else 0


@walk_function()
def scatter(medium: Any, state: Any, stream: Any) -> None:
    """Draw a new direction from the phase function; its density stays in state[PHASE], its place in
    state[ORIGIN].
    """
    d = state[DIRECTION : DIRECTION + 3]
    for k in range(3):
        state[ORIGIN + k] = state[POSITION + k]
    cosine = phase_cosine(medium.phase_g, uniform(stream))
    sine = math.sqrt(max(0.0, 1.0 - cosine * cosine))
    angle = 2.0 * math.pi * uniform(stream)
    sx, sy, sz, tx, ty, tz = frame(d[0], d[1], d[2])
    a, b = sine * math.cos(angle), sine * math.sin(angle)
    x, y, z = a * sx + b * tx + cosine * d[0], a * sy + b * ty + cosine * d[1], a * sz + b * tz + cosine * d[2]
    scale = 1.0 / math.sqrt(x * x + y * y + z * z)
    d[0], d[1], d[2] = x * scale, y * scale, z * scale
    state[PHASE] = phase(cosine, medium.phase_g)


@walk_function()
def goes_on(boundary: Any, state: Any, counts: Any, stream: Any) -> bool:
    """Unbiased roulette on walks that carry little of what they began with.

    Walks past `most_events` end, with what they carried noted as lost.
    """
    largest = max(state[THROUGHPUT], max(state[THROUGHPUT + 1], state[THROUGHPUT + 2]))
    if largest <= 0.0:
        return False
    if counts[EVENTS] >= boundary.most_events:
        state[LOST] = largest
        return False
    if largest < _WEIGHT_WINDOW * state[BEGUN]:
        survival = largest / (3.0 * _WEIGHT_WINDOW * state[BEGUN])
        if uniform(stream) >= survival:
            return False
        for c in range(3):
            state[THROUGHPUT + c] /= survival
    return True
